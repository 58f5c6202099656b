"""Autocorrelation times, R-hat, and verdicts that are earned."""

import arviz as az
import numpy as np
import pytest

from bayeskin.inference import Limits
from bayeskin.inference.convergence import assess, autocorrelation_steps, split_rhat
from bayeskin.types import Array


def autoregressive(shape: tuple[int, ...], phi: float, rng: np.random.Generator) -> Array:
    """Chains (E, n, W, D) whose autocorrelation time is (1 + phi) / (1 - phi) steps."""
    noise = rng.standard_normal(shape)
    out = np.empty(shape)
    out[:, 0] = noise[:, 0]
    for i in range(1, shape[1]):
        out[:, i] = phi * out[:, i - 1] + np.sqrt(1 - phi**2) * noise[:, i]
    return out


def test_the_autocorrelation_time_is_that_of_the_process() -> None:
    chains = autoregressive((2, 3000, 20, 2), 0.8, np.random.default_rng(0))
    assert autocorrelation_steps(chains) == pytest.approx(9.0, rel=0.15)


def test_a_walker_that_moves_in_some_coordinates_counts_in_these() -> None:
    """A move in a subspace leaves the other coordinates as they are."""
    chains = autoregressive((1, 3000, 20, 2), 0.8, np.random.default_rng(3))
    chains[0, :, 0, 1] = 0.3
    assert autocorrelation_steps(chains) == pytest.approx(9.0, rel=0.2)


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_rhat_is_arviz_s(shift: float) -> None:
    draws = np.random.default_rng(0).standard_normal((4, 501)) ** 3
    draws[0] += shift
    assert split_rhat(draws) == pytest.approx(float(az.rhat(draws, method="rank")), abs=2e-4)


def judged(chains: Array, log_prob: Array | None = None) -> tuple[bool, str]:
    names = tuple("abc"[: chains.shape[3]])
    log_prob = -0.5 * (chains**2).sum(axis=3) if log_prob is None else log_prob
    verdict = assess(chains, log_prob, names, Limits()).verdict
    return verdict.trusted, verdict.reasons[0]


def test_a_verdict_is_trust_only_if_every_criterion_holds() -> None:
    rng = np.random.default_rng(1)
    good = autoregressive((4, 2000, 20, 2), 0.8, rng)
    assert judged(good)[0]
    trusted, reason = judged(good[:, :400])
    assert (trusted, "autocorrelation lengths" in reason) == (False, True)
    trusted, reason = judged(good[:, :, :2])
    assert (trusted, "effective samples" in reason) == (False, True)
    apart = good + np.array([0.6, 0, 0, 0])[:, None, None, None] * np.array([0.0, 1.0])
    trusted, reason = judged(apart)
    assert (trusted, "R-hat across 4 ensembles" in reason, "for b" in reason) == (False, True, True)
    assert not judged(good[:1])[0]
    assert not judged(np.where(np.arange(2) == 1, 1.0, good))[0]  # a parameter that does not move


def test_walkers_of_one_ensemble_do_not_hide_that_ensembles_disagree() -> None:
    """Each walker explores only its ensemble's mode: all agree within an ensemble, and none across."""
    chains = autoregressive((2, 2000, 20, 1), 0.5, np.random.default_rng(2))
    chains[1] += 3.0
    assert not judged(chains)[0]


def test_stuck_walkers_are_named() -> None:
    chains = autoregressive((2, 2000, 20, 2), 0.5, np.random.default_rng(3))
    chains[1, :, 4] = chains[1, 0, 4]
    low = -0.5 * (chains**2).sum(axis=3)
    low[0, :, 7] -= 40.0
    convergence = assess(chains, low, ("a", "b"), Limits())
    assert convergence.stuck == ((0, 7), (1, 4))
    assert "2 stuck walkers, ensemble 0 walker 7" in convergence.verdict.reasons[0]
    low[0, :, 7] += 40.0
    alone = assess(chains, low, ("a", "b"), Limits()).verdict
    assert "1 stuck walker, ensemble 1 walker 4; none" in "".join(alone.reasons)


def test_burn_in_leaves_the_start_behind() -> None:
    chains = autoregressive((2, 3000, 20, 1), 0.9, np.random.default_rng(4))
    chains += 30 * np.exp(-np.arange(3000) / 20.0)[:, None, None]
    convergence = assess(chains, -0.5 * (chains**2).sum(axis=3), ("a",), Limits())
    assert 100 < convergence.burn_in < 600
    assert convergence.rhat[0] < 1.01
