"""Several recordings of one skin: one axis of time, one likelihood, and the agreement between them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toys import closed_form_reduced, stand_in_model
from toys.closed_form_reduced import BASE, EDGES_S, MOTION, NO_WORD, NOISE_N, TRUTH, recorded

from bayeskin import storage
from bayeskin.config import Config
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ModelRun
from bayeskin.forward.joint import JointForward
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.noise_model import noise_chain, noise_space
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.each_recording import in_each_recording, in_one_recording
from bayeskin.mismatch.agreement import agreements
from bayeskin.mismatch.answers import answer, read_answer
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.tasks import FitTask, Task
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.recordings.join import PAUSE_S, join_bins, join_jumps, join_motions, join_samples, spans_of
from bayeskin.types import BinnedForce, PadMotion, ParameterSpace, Prediction, Recording, Simulation
from bayeskin.types.joint import own_name, plain_name, recording_of, values_in
from bayeskin.workflow import maximum
from bayeskin.workflow.engine import Run, Silent

SHORT = PadMotion(np.array([0.0, 3.0, 8.0, 30.0]), 1e-3 * np.array([0.0, 0.0, 5.0, 5.0]))


def samples(motion: PadMotion, name: str, interval_s: float) -> Recording:
    time_s = np.arange(0.0, motion.time_s[-1] + 1e-9, interval_s)
    return Recording(time_s, motion.at(time_s), np.sin(time_s), name, name * 8, (f"note of {name}",))


def joined(parts: Sequence[BinnedForce], motions: Sequence[PadMotion]) -> tuple[BinnedForce, PadMotion]:
    """Bins and protocols on the common axis of time."""
    recordings = [samples(motion, name, 0.1) for motion, name in zip(motions, "ABC", strict=False)]
    spans = spans_of(recordings, motions)
    return join_bins(parts, spans), join_motions(motions, spans)


def second_space() -> ParameterSpace:
    """The priors of two recordings, each with its own initial pressure."""
    pressure = next(p for p in BASE.parameters if p.name == "p_init")
    return ParameterSpace((*BASE.parameters, dataclasses.replace(pressure, name="p_init@2")))


def context_of(patch: pytest.MonkeyPatch, first: BinnedForce, second: BinnedForce) -> DiagnosisContext:
    """The context of two recordings of the toy."""
    alone = closed_form_reduced.bench(patch, first)
    binned, motion = joined((first, second), (MOTION, MOTION))
    jumps = join_jumps((NO_WORD, NO_WORD), binned.spans)
    return DiagnosisContext(
        binned, jumps, motion, JointForward((alone.forward, alone.forward)), second_space(), 1
    )


def asked(context: DiagnosisContext, tasks: Sequence[Task]) -> list[object]:
    """Answers tasks through JSON, as worker processes do."""
    return [read_answer(context, task, json.loads(json.dumps(answer(context, task)))) for task in tasks]


@given(st.text(st.characters(exclude_characters="@"), min_size=1), st.integers(0, 99))
def test_the_name_of_an_own_value_says_its_plain_name_and_its_recording(name: str, number: int) -> None:
    own = own_name(name, number)
    assert (plain_name(own), recording_of(own)) == (name, number)


def test_a_recording_has_its_own_values_and_those_that_are_shared() -> None:
    values = {"E_c": 1.0, "p_init": 2.0, "p_init@2": 3.0, "p_init@3": 4.0}
    assert values_in(values, 0) == {"E_c": 1.0, "p_init": 2.0}
    assert values_in(values, 2) == {"E_c": 1.0, "p_init": 4.0}


def test_recordings_that_are_joined_are_parted_again() -> None:
    motions = (MOTION, SHORT)
    recordings = [samples(MOTION, "first", 0.1), samples(SHORT, "second", 0.05)]
    first, second = recorded(1), recorded(2)
    kept = 60  # bins of the second, which ends earlier
    second = BinnedForce(
        second.edges_s[: kept + 1], second.force_n[:kept], second.variance_n2[:kept],
        second.correlation[: kept - 1], np.minimum(second.phase[:kept], 3), second.phases[:4],
    )  # fmt: skip
    spans = spans_of(recordings, motions)
    assert spans[1].start_s - spans[0].end_s >= PAUSE_S
    for part, motion in zip(join_motions(motions, spans).parts, motions, strict=True):
        np.testing.assert_allclose(part.time_s, motion.time_s, atol=1e-9)
        np.testing.assert_array_equal(part.displacement_m, motion.displacement_m)
    whole = join_samples(recordings, spans)
    for span, recording in zip(spans, recordings, strict=True):
        part = whole.part(span)
        np.testing.assert_allclose(part.time_s, recording.time_s, atol=1e-9)
        np.testing.assert_array_equal(part.force_n, recording.force_n)
    for part_bins, bins in zip(join_bins((first, second), spans).parts, (first, second), strict=True):
        for name in ("edges_s", "force_n", "variance_n2", "correlation", "phase"):
            np.testing.assert_allclose(getattr(part_bins, name), getattr(bins, name), atol=1e-9)
        assert [phase.kind for phase in part_bins.phases] == [phase.kind for phase in bins.phases]


def test_the_likelihood_of_two_recordings_is_the_product_of_their_likelihoods() -> None:
    first, second = recorded(1), recorded(2, offset=0.0)
    binned, _ = joined((first, second), (MOTION, MOTION))
    chain = noise_chain(binned, by_kind=False)
    assert noise_space(chain.kinds).names == ("sd_noise", "sd_noise@2", "tau_noise", "nu_noise")
    force_n = 0.9 * first.force_n, 1.1 * second.force_n
    total = 0.0
    for part, mean_n, sd_n in zip((first, second), force_n, (1e-3, 3e-3), strict=True):
        alone = Prediction(mean_n[None], np.zeros((1, len(mean_n), 1)), np.zeros((1, len(mean_n))))
        noise = np.array([[sd_n, 2.0, 8.0]])
        total += float(log_likelihood(noise_chain(part, by_kind=False), alone, noise)[0])
    mean_n = np.concatenate([force_n[0], [0.0], force_n[1]])[None]
    prediction = Prediction(mean_n, np.zeros((*mean_n.shape, 1)), np.zeros(mean_n.shape))
    together = log_likelihood(chain, prediction, np.array([[1e-3, 3e-3, 2.0, 8.0]]))[0]
    assert together == pytest.approx(total, rel=1e-9)


def test_a_joint_run_is_the_run_of_each_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    context = context_of(monkeypatch, recorded(1), recorded(2))
    theta = {**TRUTH, "p_init@2": -200.0, "stiffness_rate": -1e-3, "stiffness_time": 300.0}
    run = context.run(["stiffness-drift"], theta)
    assert isinstance(run, ModelRun)
    assert run.slopes_n is not None
    names = context.space(["stiffness-drift"]).names
    for number, bins in enumerate(context.binned.slices):
        own = context.alone[number]
        alone = own.run(["stiffness-drift"], values_in(theta, number))
        assert isinstance(alone, ModelRun)
        assert alone.slopes_n is not None
        np.testing.assert_array_equal(run.force_n[bins], alone.force_n)
        for column, name in enumerate(own.space(["stiffness-drift"]).names):
            joint_name = own_name(name, number) if name == "p_init" else name
            joint = run.slopes_n[bins, names.index(joint_name)]
            np.testing.assert_array_equal(joint, alone.slopes_n[:, column])
        other = own_name("p_init", 1 - number)
        assert not run.slopes_n[bins, names.index(other)].any()


def test_the_full_run_of_a_recording_is_kept_before_the_next_one_begins(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    motions, theta = (MOTION, SHORT), {**TRUTH, "p_init@2": -200.0}
    recordings = [samples(motion, name, 0.1) for motion, name in zip(motions, "AB", strict=True)]
    joint = join_motions(motions, spans_of(recordings, motions))
    storage.save(tmp_path / "recording" / "motion.h5", joint)
    run, received = Run(Config.model_construct(), tmp_path / "a.toml", tmp_path, Silent()), list[PadMotion]()

    def simulated(spec: ModelSpec, motion: PadMotion, *more: Any, **options: Any) -> Simulation:
        received.append(motion)
        if len(received) == 2:
            raise KeyboardInterrupt
        return stand_in_model.simulate(spec, motion, *more, **options)

    monkeypatch.setattr(maximum, "model_spec", lambda _: ModelSpec())
    monkeypatch.setattr(maximum, "simulate", simulated)
    with pytest.raises(KeyboardInterrupt):
        maximum._FullModel(run)(theta)
    simulation = maximum._FullModel(run)(theta)
    assert [len(motion.time_s) for motion in received] == [len(m.time_s) for m in (MOTION, SHORT, SHORT)]
    again = maximum._FullModel(run)(theta)
    assert len(received) == 3
    for name in ("time_s", "force_n", "gradient_n"):
        np.testing.assert_array_equal(getattr(again, name), getattr(simulation, name))


def test_each_recording_has_its_own_instrument_and_both_have_one_skin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = context_of(monkeypatch, recorded(1), recorded(2))
    drift, skin = context.known["sensor-drift"], context.known["stiffness-drift"]
    assert {plain_name(p.name) for p in drift.parameters} == {
        p.name for p in catalogue()["sensor-drift"].parameters
    }
    assert len(drift.parameters) == 2 * len(catalogue()["sensor-drift"].parameters)
    assert skin == catalogue()["stiffness-drift"]
    shared = dataclasses.replace(context, shared=("sensor-drift",))
    assert shared.known["sensor-drift"] == catalogue()["sensor-drift"]


@pytest.mark.parametrize("name", ["sensor-drift", "device-friction", "backlash", "clock-delay"])
def test_the_instrument_acts_on_each_recording_alone(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    context = context_of(monkeypatch, recorded(1), recorded(2))
    mechanism = context.known[name]
    middle = (
        mechanism.parameters,
        ParameterSpace(mechanism.parameters).from_unit(np.linspace(0.3, 0.7, len(mechanism.parameters))),
    )
    own = {p.name: float(value) for p, value in zip(*middle, strict=True)}
    values = {**context.neutral, **TRUTH, "p_init@2": 100.0, **own}
    run = context.run((), values)
    assert isinstance(run, ModelRun)
    whole = context.observe((), (name,), [run])
    together = whole.predict_mean(np.array([values[p] for p in whole.space.names]))[0]
    for number, bins in enumerate(context.binned.slices):
        alone, mine = context.alone[number], values_in(values, number)
        part_run = alone.run((), mine)
        assert isinstance(part_run, ModelRun)
        part = alone.observe((), (name,), [part_run])
        expected = part.predict_mean(np.array([mine[p] for p in part.space.names]))[0]
        np.testing.assert_allclose(together[bins], expected, rtol=1e-9, atol=1e-12)


def test_a_mechanism_of_each_recording_is_that_of_one_recording() -> None:
    friction = catalogue()["device-friction"]
    back = in_one_recording(in_each_recording(friction, ["A", "B"]))
    assert (back.parameters[0].name, dict(back.neutral)) == (
        friction.parameters[0].name, dict(friction.neutral)
    )  # fmt: skip


def joint_fit(context: DiagnosisContext) -> SetFit:
    start = {**context.neutral, **TRUTH, "p_init@2": TRUTH["p_init"], **context.noise}
    (fit,) = asked(context, [FitTask((), start, 9)])
    assert isinstance(fit, SetFit)
    return fit


def test_two_recordings_of_one_skin_agree_and_narrow_its_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    context = context_of(monkeypatch, recorded(1), recorded(2))
    fit = joint_fit(context)
    rows = agreements(lambda tasks: asked(context, tasks), context, fit)
    assert [row.name for row in rows] == ["A", "B"]
    for row in rows:
        assert row.tension is not None
        assert not row.contradicts
        assert row.rms_n == pytest.approx(NOISE_N, rel=0.25)
    start = {**context.neutral, **TRUTH, **context.alone[0].noise}
    (alone,) = asked(context, [FitTask((), start, 9, recording=0)])
    assert isinstance(alone, SetFit)
    for name, sd in rows[0].sd_alone.items():
        column = alone.fit.log_posterior.names.index(name)
        assert sd == pytest.approx(np.sqrt(12.0 * alone.fit.covariance[column, column]), rel=0.3)
        # Two recordings of the same protocol, with the same noise, say the same about the skin.
        assert rows[0].widens[name] == pytest.approx(rows[1].widens[name], rel=0.2)
    assert max(rows[0].widens.values()) == pytest.approx(np.sqrt(2.0), rel=0.1)
    # The error of the load cell's calibration is common to both, so the moduli gain less.
    for name in ("k_c", "k_s"):
        column = fit.fit.log_posterior.names.index(name)
        assert fit.fit.covariance[column, column] < 0.7 * alone.fit.covariance[column, column]


def test_a_recording_of_another_skin_contradicts(monkeypatch: pytest.MonkeyPatch) -> None:
    first = recorded(1)
    other = recorded(2)
    stiffer = dataclasses.replace(other, force_n=1.5 * other.force_n)
    context = context_of(monkeypatch, first, stiffer)
    rows = agreements(lambda tasks: asked(context, tasks), context, joint_fit(context))
    assert any(row.contradicts for row in rows)


def test_there_is_no_agreement_of_a_single_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    context = closed_form_reduced.bench(monkeypatch, recorded(1))
    start = {**context.neutral, **TRUTH, **context.noise}
    (fit,) = asked(context, [FitTask((), start, 4)])
    assert isinstance(fit, SetFit)
    assert agreements(lambda tasks: asked(context, tasks), context, fit) == []
    assert len(EDGES_S) - 1 == len(fit.fit.force_n)
