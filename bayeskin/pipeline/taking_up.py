"""The full model takes up what a search on its surrogate has found: a fit of its own, the posterior there.

A first run of the model's own mesh shows by how much the coarsest bricks are off. These, whose runs are quick
and carry their derivatives, are fitted with that difference added, then the model's own mesh with their
derivatives. Where much is left, others of these fits begin at other tops of the surrogate that promise more.
Without mechanisms the slopes of the base's surrogate come first, and last where they are good enough. Sampled
and taken apart is the posterior of the surrogate corrected by the runs of the model's own mesh; located is
the mismatch beside the best of these runs. The article's formulation and models of one's own keep the
surrogate's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import inference
from bayeskin.inference import LogPosterior
from bayeskin.inference.straighten import Shear, find_shear
from bayeskin.mismatch.blocked import errors_left_out
from bayeskin.mismatch.contributions import Contribution, Force, contributions
from bayeskin.mismatch.corrected import CorrectedSurrogate, FullRun, Undiminished
from bayeskin.mismatch.discrepancy import Discrepancy, discrepancy
from bayeskin.mismatch.fit import Fit, fit_near, hopeful, much_left, other_tops, restored, stored
from bayeskin.mismatch.form import Form, propose_form
from bayeskin.mismatch.full_fit import BEHIND, FullFit, at_run, fit_full
from bayeskin.mismatch.locate import Located, locate
from bayeskin.mismatch.resample import LEGS, Resampled, resample
from bayeskin.mismatch.search import weight
from bayeskin.mismatch.verdict import Evidence
from bayeskin.mismatch.wrapper import Sure
from bayeskin.pipeline.engine import Run, Silent
from bayeskin.pipeline.reported import FullForce
from bayeskin.pipeline.workbench import Workbench, opened, workbench
from bayeskin.surrogates import effects_among
from bayeskin.types import Array, Surrogate
from bayeskin.workers import Lost, run_parallel

COARSE_RUNS, BASE_RUNS = 8, 4  # at most, with mechanisms and without
FULL_RUNS = 4  # at most, of the model's own mesh with the coarse one's slopes
OTHER_TOPS = 1  # at most, from which the coarse mesh is fitted, too, where they promise more than it found
DIRECT_RUNS = 2  # at most, of the model's own mesh with the slopes of the base's surrogate
PREDICTIVE_DRAWS = 300

FullResult = FullFit | str | None  # of the full model, or why its first run failed; None where none is made


@dataclass(frozen=True)
class Remainder:
    """What a set leaves over: a discrepancy, and the form that is proposed for it."""

    discrepancy: Discrepancy
    form: Form


@dataclass(frozen=True)
class TakenUp:
    """What follows a search's fit on the whole recording.

    full : the full model's fit; full_weight : logarithm of the set's weight by it, None without that;
    draws : of the posterior; band_n : edges of its predictive band of 90 %, (m,) each;
    left_out_n : RMS error of phases that the fit is made without, None where there is but one;
    evidence : of the best run, with the noise that is no mismatch; located : windows that it leaves;
    parts : what each mechanism contributes; remainder : what is left
    """

    full: FullResult
    full_weight: float | None
    draws: Resampled
    band_n: tuple[Array, Array]
    left_out_n: float | None
    evidence: Evidence
    located: Located
    parts: tuple[Contribution, ...]
    remainder: Remainder


def take_up(
    run: Run, whole: Sequence[Fit], noise: Mapping[str, float], begun: Sequence[Fit], until_s: float | None
) -> tuple[list[TakenUp], list[FullResult]]:
    """Fits to the whole recording, and those of fits to its beginning up to a time; in two processes.

    `noise` among its values has the noise that is no mismatch.
    """
    apart: list[partial[Any]] = [partial(_whole_apart, run.config_path, stored(one), noise) for one in whole]
    apart += [partial(_begun_apart, run.config_path, stored(one), until_s) for one in begun]
    found = _in_two_processes(apart, [*whole, *begun])
    return found[: len(whole)], found[len(whole) :]


def take_up_rivals(
    run: Run, rivals: Sequence[Fit], noise: Mapping[str, float], full_weight: float | None
) -> list[TakenUp | float | None]:
    """What follows each rival where it has more weight than `full_weight` (None: any has) by the full model;
    elsewhere that weight, as far as it was worth going, None where the full model failed."""
    ahead = -np.inf if full_weight is None else full_weight
    apart = [partial(_whole_apart, run.config_path, stored(one), noise, ahead) for one in rivals]
    return _in_two_processes(apart, rivals)


def _in_two_processes(apart: Sequence[partial[Any]], fits: Sequence[Fit]) -> list[Any]:
    """What tasks, one of each fit, return; those of the most mechanisms, which take the longest, go first."""
    order = sorted(range(len(apart)), key=lambda i: -len(fits[i].names))
    done = {order[i]: found for i, found in run_parallel(_call, [apart[i] for i in order], 2)}
    return [apart[i]() if isinstance(done[i], Lost) else done[i] for i in range(len(apart))]


def _call(task: partial[Any]) -> Any:
    return task()


def _whole_apart(
    source: Path, plain: Mapping[str, Any], noise: Mapping[str, float], ahead: float | None = None
) -> TakenUp | float | None:
    """In a process of its own: mechanisms have no copies. `ahead` of rivals only, as in `take_up_rivals`."""
    bench = workbench(opened(source, Silent()))
    seed, build = bench.run.config.seed, partial(bench.posterior, None)
    alone, found = build(()), restored(plain, build(plain["names"]))
    straight = find_shear(alone)
    shear = straight.among(alone.names, found.log_posterior.names) if straight else None
    at_least = -np.inf if ahead is None else ahead - weight(found) + found.value
    full, corrected = _full(bench, found, shear, at_least)
    force: Force = partial(_surrogate_force, bench)
    full_weight, sure, there, unsure = None, found, found, found.log_posterior
    if corrected is not None and isinstance(full, FullFit):
        found = fit_near(found.names, _about(bench, found, corrected), full.theta, shear)
        # An error that is let go takes up what is missing, which no phase left out and no window would show.
        sure = replace(found, log_posterior=_about(bench, found, Sure(corrected)))
        there = at_run(sure, full)
        unsure = _about(bench, found, Undiminished(corrected))
        # Mechanisms have to be worth what a run has shown, the model without them what is promised.
        full_weight = weight(found) + (full.value - found.value if found.names else 0.0)
        force = _coarse(bench)
    if ahead is not None and (full_weight is None or full_weight <= ahead):
        return full_weight
    force_names = there.log_posterior.surrogate.space.names
    quiet = {name: noise[name] for name in there.log_posterior.names if name not in force_names}
    there = replace(there, theta={**there.theta, **quiet})
    left = discrepancy(there, bench.motion)
    refuted = not found.names and much_left(found.log_posterior, found.theta)
    wide = found if unsure is found.log_posterior else fit_near(found.names, unsure, found.theta, shear)
    draws = resample(wide, shear, seed, LEGS[:1] if refuted else LEGS)
    some = inference.evenly(draws.draws, PREDICTIVE_DRAWS)
    bands = inference.bands(unsure, some, np.random.default_rng(seed))
    return TakenUp(
        full, full_weight, draws, bands.interval(0.9),
        _left_out(sure, shear), Evidence(left.without_log_evidence, left.log_evidence),
        locate(there, noise, seed),
        tuple(contributions(found.names, found.theta, force, bench.known)),
        Remainder(left, propose_form(there, bench.motion, seed)),
    )  # fmt: skip


def _about(bench: Workbench, found: Fit, surrogate: Surrogate) -> LogPosterior:
    """The posterior by a surrogate of the full model on its mesh, however unsure."""
    return replace(found.log_posterior, surrogate=surrogate, sure_within_n=None)


def _left_out(found: Fit, shear: Shear | None) -> float | None:
    fitted = found.log_posterior.chain.bins
    if len(np.unique(found.log_posterior.binned.phase[fitted])) < 2:
        return None
    return float(np.sqrt(np.mean(errors_left_out(found, shear) ** 2)))


def _begun_apart(source: Path, plain: Mapping[str, Any], until_s: float | None) -> FullResult:
    bench = workbench(opened(source, Silent()))
    found, straight = restored(plain, bench.posterior(until_s, plain["names"])), None
    if found.names:
        alone = bench.posterior(until_s, ())
        straight = find_shear(alone)
        straight = straight.among(alone.names, found.log_posterior.names) if straight else None
    return _full(bench, found, straight)[0]


def _full(
    bench: Workbench, found: Fit, shear: Shear | None, at_least: float = -np.inf
) -> tuple[FullResult, CorrectedSurrogate | None]:
    """The full model's own fit from a search's, and the surrogate about it; `at_least` as for `fit_full`."""
    if bench.spec.observation != "reaction":
        return None, None
    beyond = [bench.known[name] for name in found.names if bench.known[name].act.bind is None]
    exact = [p.name for mechanism in beyond for p in mechanism.parameters]
    coarse, fine = _coarse(bench), FullForce(bench.spec, bench.motion, bench.binned.edges_s)
    coarse_runs: dict[tuple[float, ...], tuple[Array, Array] | str] = {}
    fine_runs: dict[tuple[float, ...], Array | str] = {}

    def quick(theta: Mapping[str, float], changes: Mapping[str, float]) -> tuple[Array, Array] | str:
        key = tuple(theta[name] for name in changes)
        if key not in coarse_runs:
            coarse_runs[key] = coarse.with_slopes((found.names, theta), changes)
        return coarse_runs[key]

    def alone(theta: Mapping[str, float], changes: Mapping[str, float]) -> tuple[Array, None] | str:
        key = tuple(theta[name] for name in changes)
        if key not in fine_runs:
            fine_runs[key] = fine((found.names, theta))
        force = fine_runs[key]
        return force if isinstance(force, str) else (force, None)

    def lifted(
        start: Mapping[str, float], theta: Mapping[str, float], changes: Mapping[str, float]
    ) -> tuple[Array, Array] | str:
        """The coarse mesh, with what the model's own adds at `start` where both can be run."""
        here, there, own = quick(theta, changes), quick(start, changes), alone(start, changes)
        if isinstance(here, str) or isinstance(there, str) or isinstance(own, str):
            return here
        return here[0] + own[0] - there[0], here[1] * nearest_factor(there[0], own[0])

    def whole(theta: Mapping[str, float], changes: Mapping[str, float]) -> tuple[Array, Array] | str:
        slopes, own = quick(theta, changes), alone(theta, changes)
        if isinstance(slopes, str) or isinstance(own, str):
            return slopes if isinstance(slopes, str) else str(own)
        return own[0], slopes[1] * nearest_factor(slopes[0], own[0])

    def made() -> list[FullRun]:
        return [FullRun(np.array(key), force, None) for key, force in fine_runs.items()
                if not isinstance(force, str)]  # fmt: skip

    plain = replace(found.log_posterior, surrogate=bench.surrogate(found.names))
    fitted = partial(
        fit_full, plain, exact=exact, seed=bench.run.config.seed,
        several=len(effects_among(bench.effects, found.names)) > 1, at_least=at_least,
    )  # fmt: skip
    start = found.theta
    if not found.names:
        direct = fitted(start, alone, rounds=DIRECT_RUNS)
        if not isinstance(direct, str):
            if direct[0].settled:
                return direct
            start = direct[0].theta
    first = fitted(start, partial(lifted, start), rounds=COARSE_RUNS if found.names else BASE_RUNS)
    if found.names:
        for top in other_tops(found, shear, bench.run.config.seed, OTHER_TOPS):
            beat = at_least if isinstance(first, str) else max(first[0].value, at_least)
            explained = not isinstance(first, str) and not much_left(found.log_posterior, first[0].theta)
            if explained or hopeful(top) <= beat:
                break
            other = fitted(top.theta, partial(lifted, top.theta), rounds=COARSE_RUNS, at_least=beat)
            if isinstance(first, str) or (not isinstance(other, str) and other[0].value > first[0].value):
                first = other
    if not isinstance(first, str) and first[0].value < at_least - BEHIND:
        return first
    last = fitted(start if isinstance(first, str) else first[0].theta, whole, rounds=FULL_RUNS, given=made())
    again = fitted(start, whole, rounds=1)  # no new run
    if not isinstance(again, str) and (isinstance(last, str) or again[0].value > last[0].value):
        last = fitted(start, whole, rounds=FULL_RUNS, given=made())
    if isinstance(last, str):
        return last, None
    return replace(last[0], runs=len(fine_runs)), last[1]


def nearest_factor(coarse_n: Array, own_n: Array) -> float:
    """On a coarse force that brings it nearest to the model's own."""
    return float(coarse_n @ own_n / (coarse_n @ coarse_n))


def _coarse(bench: Workbench) -> FullForce:
    return FullForce(bench.spec.coarsest, bench.motion, bench.binned.edges_s)


def _surrogate_force(bench: Workbench, case: tuple[Sequence[str], Mapping[str, float]]) -> Array:
    """Mean force (m,) of the surrogate with a set, at the values that its posterior knows."""
    log_posterior = bench.posterior(None, case[0])
    values = log_posterior.from_sampling(log_posterior.vector(case[1]))
    return log_posterior.predict_mean(values)[0]
