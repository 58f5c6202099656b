"""Fits a set of mechanisms in a trust region; the forward model solves all of its mechanisms together.

Each run of the model comes with its derivatives, which give the posterior near the run (`tangent`). For the
noise, and for mechanisms that act on the force alone, this posterior is exact. Each round maximises the
posterior that all runs so far give, within a trust region of the forward model's parameters. It then runs the
model at the maximum. The next round starts from this run if the posterior has risen. A run without a gain
still improves the posterior of the next rounds.

The method is that of Conn, Gould & Toint, Trust-Region Methods (2000), chapter 6.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayeskin.forward.interface import ModelRun
from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import Top, gauss_newton
from bayeskin.inference.problem import HELD
from bayeskin.inference.reparametrisation import Shear, shear_at
from bayeskin.inference.score_test import with_less_noise
from bayeskin.mismatch.evidence import evidence
from bayeskin.mismatch.fit import Fit, stored
from bayeskin.mismatch.tangent import POWER
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array


@dataclass(frozen=True)
class TrustSettings:
    """Settings of a fit in a trust region.

    first, largest, smallest : half width of the region at the start, its largest value, and the value below
        which the fit ends; as shares of the prior's width
    kept, expanded : shares of the promised gain that a step must reach so that the region does not shrink,
        and so that it grows
    shrinks, grows : factors on the half width
    moved : share of its half width from which a parameter has moved far; the region shrinks and grows along
        such parameters
    enough : promised gain [nats] below which a fit is settled
    runs : largest number of runs
    climb, held : rounds of Gauss-Newton in a trust region, and with the forward model's parameters held
    """

    first: float = 0.2
    largest: float = 0.5
    smallest: float = 0.004
    kept: float = 0.3
    expanded: float = 0.8
    shrinks: float = 0.3
    moved: float = 0.5
    grows: float = 2.0
    enough: float = 0.3
    runs: int = 9
    climb: int = 15
    held: int = 6


# Returns for a set and values by name a run with derivatives, or the message of a run that failed.
Skin = Callable[[Sequence[str], Mapping[str, float]], ModelRun | str]
Local = Callable[[Sequence[str], Sequence[ModelRun]], LogPosterior]  # returns a set's posterior near runs


@dataclass(frozen=True)
class SetFit:
    """A fit of a set by the forward model.

    run : the run at which the fit ended; runs : number of runs that the fit took
    settled : whether hardly any gain is still promised
    correction_n (m,) : force [N] that was added to each run, because the forward model is off by it near by
    """

    fit: Fit
    run: ModelRun
    runs: int
    settled: bool
    correction_n: Array


def as_json(set_fit: SetFit) -> dict[str, Any]:
    """Returns a fit in JSON's types."""
    assert set_fit.run.slopes_n is not None
    run = {
        "theta": set_fit.run.theta.tolist(), "force_n": set_fit.run.force_n.tolist(),
        "slopes_n": set_fit.run.slopes_n.tolist(),
    }  # fmt: skip
    return {
        "fit": stored(set_fit.fit), "run": run, "runs": set_fit.runs, "settled": set_fit.settled,
        "off_n": set_fit.correction_n.tolist(),
    }  # fmt: skip


def fit_set(
    names: Sequence[str], start: Mapping[str, float], skin: Skin, local: Local,
    settings: TrustSettings = TrustSettings(), correction_n: Array | None = None,
    first: ModelRun | None = None,
) -> SetFit | str:  # fmt: skip
    """Returns the fit of a set that is reached from `start`; if the first run fails, its message.

    start : values of all parameters by name, SI
    skin : runs the forward model; local : returns the posterior near runs
    correction_n (m,) : force [N] that is added to each run
    first : the run at `start`, without the correction, where it exists already
    """

    def corrected(run: ModelRun | str) -> ModelRun | str:
        if isinstance(run, str) or correction_n is None:
            return run
        return replace(run, force_n=run.force_n + correction_n)

    run = corrected(skin(names, start) if first is None else first)
    if isinstance(run, str):
        return run
    runs, posterior = [run], local(names, [run])
    vector, value = _at_run(posterior, np.clip(posterior.vector(start), *posterior.bounds), settings.held)
    (low, high), solved = posterior.bounds, solved_columns(posterior)
    reach = np.where(solved, settings.first, 1.0)
    settled, run_count = False, 1
    while run_count < settings.runs and reach.min() >= settings.smallest:
        ridge = shear_at(posterior, vector, POWER)
        proposal, promised = _highest(
            posterior, in_box(posterior, vector, reach), vector, settings.climb, ridge
        )
        moved = (np.abs(proposal - vector) / (high - low))[: len(reach)]
        moved_far = np.logical_and(solved, moved >= settings.moved * reach)
        promised -= value
        if promised < settings.enough:
            settled = True
            break
        run_count += 1
        new_run = corrected(skin(names, posterior.named(posterior.from_sampling(proposal))))
        gain = -np.inf
        if not isinstance(new_run, str):
            runs.append(new_run)
            posterior = local(names, runs)
            proposal, new_value = _at_run(posterior, proposal, settings.held)
            gain = new_value - value
        if gain > 0.0 and not isinstance(new_run, str):
            run, vector, value = new_run, proposal, new_value
        if gain < settings.kept * promised:
            reach[moved_far if moved_far.any() else solved] *= settings.shrinks
        elif gain > settings.expanded * promised:
            reach[moved_far] = np.minimum(settings.grows * reach[moved_far], settings.largest)
    correction_n = np.zeros_like(run.force_n) if correction_n is None else correction_n
    return SetFit(_fit(names, local(names, [run]), vector), run, run_count, settled, correction_n)


def _at_run(posterior: LogPosterior, vector: Array, rounds: int) -> tuple[Array, float]:
    """Returns the most probable point (D,) with the forward model's parameters held, and its log density."""
    return _highest(posterior, within(posterior, vector, 0.0), vector, rounds)


def _highest(
    posterior: LogPosterior, near: LogPosterior, vector: Array, rounds: int, ridge: Shear | None = None
) -> tuple[Array, float]:
    """Returns the most probable point (D,) of a part of the posterior, and its log density.

    One climb starts with the noise at `vector`, and another one with a smaller noise. Otherwise noise that
    has explained the misfit of an earlier run would remain.

    near : the posterior in a smaller box; ridge : ridge of the moduli, which steps may follow
    """
    starts = [vector, with_less_noise(posterior, vector)]
    tops = [gauss_newton(near, np.clip(start, *near.bounds), ridge, rounds) for start in starts]
    best = np.clip(max(tops, key=lambda top: top.value).vector, *posterior.bounds)
    return best, float(posterior.log_prob(best[None])[0])


def _fit(names: Sequence[str], posterior: LogPosterior, vector: Array) -> Fit:
    """Returns the fit at a point (D,) of a posterior."""
    top: Top = gauss_newton(posterior, vector, None, 0)
    theta = posterior.named(posterior.from_sampling(top.vector))
    return Fit(tuple(names), posterior, theta, top.value, *evidence(posterior, top), top.latent)


def within(about: LogPosterior, vector: Array, reach: float) -> LogPosterior:
    """Returns the same posterior with the forward model's parameters limited to values near a point (D,).

    reach : largest distance on either side, as a share of the prior's width
    """
    return in_box(about, vector, np.where(solved_columns(about), reach, 1.0))


def in_box(about: LogPosterior, vector: Array, reach: Array) -> LogPosterior:
    """Returns the same posterior in a smaller box with a point (D,) at its centre.

    reach (d,) : largest distance on either side, as a share of the prior's width, for each parameter of the
        surrogate
    """
    space, (low, high) = about.surrogate.space, about.bounds
    low, high, centre = low[: space.dim], high[: space.dim], vector[: space.dim]
    half_width = np.maximum(reach, HELD) * (high - low)
    lower, upper = (space.from_line(np.clip(centre + sign * half_width, low, high)) for sign in (-1.0, 1.0))
    prior = about.material or space
    narrowed = tuple(
        replace(p, lower=float(max(a, p.lower)), upper=float(min(b, p.upper)))
        for p, a, b in zip(prior.parameters, lower, upper, strict=True)
    )
    return replace(about, material=replace(prior, parameters=narrowed))


def solved_columns(about: LogPosterior) -> Array:
    """Returns which of the surrogate's parameters belong to the forward model, (d,)."""
    inner = set(innermost(about.surrogate).space.names)
    return np.array([name in inner for name in about.surrogate.space.names])
