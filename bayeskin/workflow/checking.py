"""The posterior checked by the full model at its own draws, and the surrogate refined there if it fails."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayeskin import inference
from bayeskin.inference import LogPosterior, Posterior, Verdict, Weighed
from bayeskin.types import Array, Design
from bayeskin.workflow.engine import Run
from bayeskin.workflow.refining import Refining, full_runs, points_like


@dataclass(frozen=True)
class Checked:
    """A posterior, what it is of, and what the full model said of it and of those before it."""

    log_posterior: LogPosterior
    posterior: Posterior
    rounds: tuple[Weighed, ...]


def checked_posterior(
    run: Run, log_posterior: LogPosterior, draws_of: Callable[[LogPosterior], Posterior]
) -> Checked:
    """Draws weighed by the full model; where it is elsewhere, they join the design and all is done again.

    At most ``check.rounds`` times. Draws that have not converged teach nothing about where the posterior
    is: they are weighed, and join no design.
    """
    config, rounds = run.config.check, list[Weighed]()
    refining = Refining(run, log_posterior.binned, "map", "map")
    while True:
        posterior = draws_of(log_posterior)
        if config.draws == 0:
            return Checked(log_posterior, posterior, ())
        weighed, runs = _weighed(run, log_posterior, posterior, refining.design, len(rounds))
        rounds.append(weighed)
        run.reporter.log(f"sample: {weighed.verdict.reasons[0]}")
        done = weighed.verdict.trusted or len(rounds) > config.rounds or not runs.ok.any()
        if done or not posterior.convergence.verdict.trusted:
            if len(rounds) > 1:
                refining.save("sample")
            return Checked(log_posterior, posterior, tuple(rounds))
        run.reporter.log("sample: the surrogate is off where the posterior is; these runs join the design")
        log_posterior = dataclasses.replace(log_posterior, surrogate=refining.learn(runs))


def _weighed(
    run: Run, log_posterior: LogPosterior, posterior: Posterior, like: Design, turn: int
) -> tuple[Weighed, Design]:
    few = inference.evenly(posterior.flat, run.config.check.draws)
    points = points_like(like, log_posterior.split(few)[0])
    runs = full_runs(run, f"check {turn + 1} of the posterior", points)
    force_n = np.where(runs.ok[:, None], runs.force_n, np.nan)
    return inference.weigh(log_posterior, few, force_n), runs


def with_full_model(verdict: Verdict, checked: Checked) -> Verdict:
    """The verdict with one more criterion: that the full model's posterior is the surrogate's."""
    if not checked.rounds:
        return verdict
    found = checked.rounds[-1].verdict
    if found.trusted:
        return Verdict(verdict.trusted, (*verdict.reasons, *found.reasons))
    return Verdict(False, (*found.reasons, *verdict.reasons))


def says_something(weighed: Weighed) -> bool:
    """Whether the weights of a round describe a posterior: not where one draw, or none, has them all."""
    return weighed.effective > 1.0


def said_of(weighed: Weighed) -> dict[str, Any]:
    """One round for summary and report."""
    finite: Array = weighed.log_ratio[np.isfinite(weighed.log_ratio)]
    return {
        "draws": len(weighed.theta),
        "failed": len(weighed.theta) - len(finite),
        "effective": weighed.effective,
        "largest_weight": float(weighed.weights.max()),
        "khat": weighed.khat,
        "sd_of_log_ratio": float(finite.std()) if len(finite) else None,
        "trusted": weighed.verdict.trusted,
        "message": weighed.verdict.reasons[0],
    }


def corrected_table(checked: Checked) -> dict[str, dict[str, Any]] | None:
    """By parameter the full model's quantiles by the last weights, and how far the mean moved."""
    if not checked.rounds or not says_something(checked.rounds[-1]):
        return None
    found = inference.corrected(checked.rounds[-1], checked.posterior.flat)
    table = {}
    for one in found:
        low, median, high = one.quantiles
        table[one.name] = {
            "median": median, "low_90": low, "high_90": high,
            "shift_sd": one.shift_sd, "shift_error_sd": one.shift_error_sd,
        }  # fmt: skip
    return table
