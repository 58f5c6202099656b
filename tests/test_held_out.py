"""Fits to the beginning of a recording know nothing of what follows, and predict it; on a toy."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from toys import closed_form_reduced
from toys.closed_form_reduced import TRUTH

from bayeskin.mismatch.answers import answer, read_answer
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.held_out import Beginning, end_of_second_hold, fit_beginning
from bayeskin.mismatch.tasks import Task
from bayeskin.mismatch.trust_region import SetFit, fit_set
from bayeskin.types import Phase

SPLIT_S = 50.0
OFFSET = ("force-offset",)
VALUES = {"F0": -0.03}


def fitted(bench: DiagnosisContext, names: Sequence[str]) -> SetFit:
    fitted = fit_set(names, {**bench.noise, **TRUTH, **VALUES}, bench.run, bench.posterior)
    assert isinstance(fitted, SetFit)
    return fitted


def begun(
    bench: DiagnosisContext, sets: Sequence[SetFit], split_s: float | None = SPLIT_S
) -> Beginning | None:
    def ask(tasks: Sequence[Task]) -> list[object]:
        return [read_answer(bench, task, answer(bench, task)) for task in tasks]

    return fit_beginning(ask, sets, split_s)


def test_what_follows_does_not_count_and_is_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = closed_form_reduced.recorded(3, **VALUES)
    later = recorded.time_s > SPLIT_S
    bench = closed_form_reduced.bench(monkeypatch, recorded)
    sets = [fitted(bench, names) for names in ((), OFFSET)]
    beginnings = begun(bench, sets)
    assert beginnings is not None
    assert beginnings.best.names == OFFSET
    left_n = [
        (recorded.force_n - prediction.force_n)[later] for prediction in (beginnings.base, beginnings.best)
    ]
    before, after = (np.sqrt(np.mean(np.square(prediction))) for prediction in left_n)
    assert after < 3.0 * closed_form_reduced.NOISE_N
    assert after < 0.5 * before
    force_n = np.where(later, recorded.force_n + 0.1, recorded.force_n)
    other = closed_form_reduced.bench(monkeypatch, dataclasses.replace(recorded, force_n=force_n))
    same = begun(other, sets)
    assert same is not None
    assert same.best.theta == pytest.approx(beginnings.best.theta)
    assert same.best.log_evidence == pytest.approx(beginnings.best.log_evidence)


def test_nothing_is_held_out_of_a_test_without_a_third_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = closed_form_reduced.recorded(3)
    bench = closed_form_reduced.bench(monkeypatch, recorded)
    assert end_of_second_hold(recorded) is None
    assert begun(bench, [fitted(bench, ())], None) is None
    longer = (*recorded.phases, Phase("hold", 2, 66.0, 70.0))
    assert end_of_second_hold(dataclasses.replace(recorded, phases=longer)) == SPLIT_S
