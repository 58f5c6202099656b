"""Checks the posterior with the full model at its own draws, and refines the surrogate if the check fails."""

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
    """A posterior with its log-posterior, and the full model's checks of it and of earlier posteriors."""

    log_posterior: LogPosterior
    posterior: Posterior
    rounds: tuple[Weighed, ...]


def checked_posterior(
    run: Run, log_posterior: LogPosterior, draws_of: Callable[[LogPosterior], Posterior]
) -> Checked:
    """Returns a posterior whose draws were weighed by the full model.

    Where the full model's posterior is elsewhere, the draws join the design, the surrogate is trained again
    and sampled again, at most ``check.rounds`` times. Draws of chains that have not converged do not show
    where the posterior is. They are weighed, but do not join the design.
    """
    config, rounds = run.config.check, list[Weighed]()
    refining = Refining(run, log_posterior.binned, "map", "map")
    while True:
        posterior = draws_of(log_posterior)
        if config.draws == 0:
            return Checked(log_posterior, posterior, ())
        weighed, runs = _weighed_draws(run, log_posterior, posterior, refining.design, len(rounds))
        rounds.append(weighed)
        run.reporter.log(f"sample: {weighed.verdict.reasons[0]}")
        finished = weighed.verdict.trusted or len(rounds) > config.rounds or not runs.ok.any()
        if finished or not posterior.convergence.verdict.trusted:
            if len(rounds) > 1:
                refining.save("sample")
            return Checked(log_posterior, posterior, tuple(rounds))
        run.reporter.log(
            "sample: the surrogate is not accurate where the posterior is; these runs join the design"
        )
        log_posterior = dataclasses.replace(log_posterior, surrogate=refining.learn(runs))


def _weighed_draws(
    run: Run, log_posterior: LogPosterior, posterior: Posterior, like: Design, turn: int
) -> tuple[Weighed, Design]:
    """Returns the weights of some posterior draws, and the full model's runs at them."""
    draws = inference.evenly(posterior.flat, run.config.check.draws)
    points = points_like(like, log_posterior.split(draws)[0])
    runs = full_runs(run, f"check {turn + 1} of the posterior", points)
    force_n = np.where(runs.ok[:, None], runs.force_n, np.nan)
    return inference.weigh(log_posterior, draws, force_n), runs


def with_full_model(verdict: Verdict, checked: Checked) -> Verdict:
    """Returns the verdict with one more criterion: the full model's posterior equals the surrogate's."""
    if not checked.rounds:
        return verdict
    check = checked.rounds[-1].verdict
    if check.trusted:
        return Verdict(verdict.trusted, (*verdict.reasons, *check.reasons))
    return Verdict(False, (*check.reasons, *verdict.reasons))


def says_something(weighed: Weighed) -> bool:
    """Returns whether the weights of a round describe a posterior.

    They do not where one draw has all the weight, or where no draw has any.
    """
    return weighed.effective > 1.0


def said_of(weighed: Weighed) -> dict[str, Any]:
    """Returns one round as plain values, for the summary and the report."""
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
    """Returns for each parameter the full model's quantiles and the shift of the mean, by the last weights.

    Returns None where no round has weights that describe a posterior.
    """
    if not checked.rounds or not says_something(checked.rounds[-1]):
        return None
    corrections = inference.corrected(checked.rounds[-1], checked.posterior.flat)
    table = {}
    for parameter in corrections:
        low, median, high = parameter.quantiles
        table[parameter.name] = {
            "median": median, "low_90": low, "high_90": high,
            "shift_sd": parameter.shift_sd, "shift_error_sd": parameter.shift_error_sd,
        }  # fmt: skip
    return table
