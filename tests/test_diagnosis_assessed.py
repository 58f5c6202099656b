"""Tests of an assessed explanation: errors of fits, fits without and with mechanisms, the full model."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from toys import closed_form_model
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, toy_problem

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch import assess as assessing
from bayeskin.mismatch.assess import FullModelCheck, assess
from bayeskin.mismatch.emulate import EmulatedPosterior
from bayeskin.mismatch.explain import Explanation
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.held_out import Beginning
from bayeskin.mismatch.hypotheses import Evidences, Judgement
from bayeskin.mismatch.misfit import explained_share, misfit_n
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.resample import PosteriorDraws
from bayeskin.mismatch.search_record import Check, SearchResult
from bayeskin.mismatch.trust_region import SetFit

ALONE = toy_problem(1)
BINNED = ALONE.binned
SET = ("force-offset",)
SPLIT_S = 60.0


def test_the_misfit_is_the_rms_of_the_bins_from_a_time_on() -> None:
    late = BINNED.time_s > SPLIT_S
    force_n = BINNED.force_n - np.where(late, 5e-3, 2e-3)
    assert misfit_n(BINNED, force_n, SPLIT_S) == pytest.approx(5e-3)
    assert misfit_n(BINNED, force_n) == pytest.approx(np.sqrt(np.mean(np.where(late, 5e-3, 2e-3) ** 2)))


def test_half_the_misfit_is_three_quarters_explained() -> None:
    assert explained_share(BINNED, BINNED.force_n + 2e-3, BINNED.force_n - 1e-3) == pytest.approx(0.75)
    assert explained_share(BINNED, BINNED.force_n + 2e-3, BINNED.force_n + 2e-3) == pytest.approx(0.0)


def fitted(*names: str, **values: float) -> Fit:
    """Returns a fit of the toy, as if it had been found at these values."""
    surrogate: Any = ToySurrogate()
    if names:
        mechanisms = tuple(catalogue()[name] for name in names)
        surrogate = ObservedSurrogate(surrogate, mechanisms, closed_form_model.MOTION)
    log_posterior = dataclasses.replace(ALONE, surrogate=surrogate)
    theta = {name: {**TRUTH, **NOISE, "F0": -0.04, **values}[name] for name in log_posterior.names}
    return Fit(names, log_posterior, theta, 0.0, 0.0, 1e-6 * np.eye(log_posterior.dim), np.zeros(3))


def drawn(fit: Fit, spread: float) -> PosteriorDraws:
    """Returns draws that lie within a share of the fit's values."""
    point = fit.log_posterior.from_sampling(fit.log_posterior.vector(fit.theta))
    factor = 1.0 + spread * np.random.default_rng(1).uniform(-1.0, 1.0, (50, len(point)))
    return PosteriorDraws(fit.log_posterior.names, point * factor, 1.0, 100.0, True)


def explained(best: tuple[str, ...], check: Check | None, beginning: Beginning | None = None) -> Explanation:
    """Returns an explanation whose most probable set is `best`."""
    fits = {names: SetFit(fitted(*names), None, 3, True, np.zeros(1)) for names in ((), SET)}  # type: ignore[arg-type]
    evidences = {
        names: Evidences(0.0 if names == best else -50.0, -60.0) for names in fits if len(names) <= len(best)
    }
    result = SearchResult(fits, {} if check is None else {best: check}, evidences, ())
    emulated = fitted(*best, E_c=1.01e5)
    posterior = EmulatedPosterior(emulated, drawn(emulated, 1e-3), 30, 1e-4, True)
    judgement = Judgement("named" if best else "nothing-missing", (), 0.0, 0.0)
    return Explanation(result, judgement, 0.5, SPLIT_S, beginning, posterior)


def context() -> Any:
    """Returns what an assessment needs of the context: the instrument adds 1 mN to the skin's force."""
    return SimpleNamespace(
        seed=1, binned=BINNED, motion=closed_form_model.MOTION, known=catalogue(),
        reported=lambda names, theta: np.full(len(BINNED.force_n), 0.0 if not names else -0.04),
        reported_of=lambda names, theta, full_n: full_n + 1e-3,
    )  # fmt: skip


def test_without_mechanisms_both_fits_share_the_posterior() -> None:
    explanation = explained((), None)
    diagnosis = assess(context(), explanation)
    before, after = diagnosis.before, diagnosis.after
    assert before.fit is explanation.search.fits[()].fit
    assert after.fit is explanation.emulated.fit
    assert before.drawn is after.drawn is explanation.emulated.draws
    assert before.band_n is after.band_n
    assert before.located.residual_n.tolist() != after.located.residual_n.tolist()  # each of its own fit
    assert before.held_out_n is None
    assert before.held_out_misfit_n(SPLIT_S) is None
    assert (diagnosis.contributions, diagnosis.remainder) == ([], None)
    assert diagnosis.full_model == "no full run was made"


def test_each_fit_has_its_own_draws_and_its_own_fit_to_the_beginning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    base_draws = drawn(fitted(), 5e-2)
    monkeypatch.setattr(assessing, "draws_near_run", lambda fit, seed: base_draws)
    beginning = Beginning(fitted(E_s=2.1e4), fitted(*SET, E_s=1.9e4))
    check = Check(np.zeros(5), BINNED.force_n + 2e-3, 4e-4)
    diagnosis = assess(context(), explained(SET, check, beginning))
    before, after = diagnosis.before, diagnosis.after
    assert before.drawn is base_draws
    assert after.drawn is not base_draws
    widths = [float(np.mean(fit.band_n[1] - fit.band_n[0])) for fit in (before, after)]
    assert widths[0] > widths[1]
    assert before.held_out_misfit_n(SPLIT_S) == misfit_n(BINNED, beginning.base.force_n, SPLIT_S)
    assert after.held_out_misfit_n(SPLIT_S) == misfit_n(BINNED, beginning.best.force_n, SPLIT_S)
    assert after.held_out_misfit_n(None) is None
    assert [part.name for part in diagnosis.contributions] == ["force-offset"]
    assert diagnosis.contributions[0].size_n == pytest.approx(0.04)
    assert diagnosis.full_model == FullModelCheck(4e-4, pytest.approx(3e-3))


def test_the_noise_of_the_best_fit_locates_the_windows_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """The base model's own fit takes its mismatch for noise, which would hide the windows."""
    noise = []
    locate = assessing.locate
    monkeypatch.setattr(
        assessing,
        "locate",
        lambda fit, values, seed: noise.append(values["sd_hold"]) or locate(fit, values, seed),
    )
    monkeypatch.setattr(assessing, "draws_near_run", lambda fit, seed: drawn(fit, 1e-3))
    explanation = explained(SET, None)
    noisy = explanation.search.fits[()].fit
    noisy.theta["sd_hold"] = 0.5  # type: ignore[index]
    assess(context(), explanation)
    assert noise == [NOISE["sd_hold"]] * 2


def test_a_full_run_that_failed_says_why() -> None:
    assert assess(context(), explained((), Check(np.zeros(5), "it folds", np.inf))).full_model == "it folds"
