"""The experiment that tells look-alikes apart is the one from which most is learnt about which is true."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import toy
from scipy.stats import norm
from toy_inference import NOISE, SCALE, TRUTH, ToySurrogate, empty_recording

from bayeskin.errors import InputError
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import Mechanism
from bayeskin.mechanisms.mechanism import Instrument, Place, added
from bayeskin.mechanisms.viscous_drag import speed_of
from bayeskin.mismatch.experiments import DRAWS, Experiment, compete, noise_of, ranked, weigh
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.information import expected_gain
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.protocols import own, phases_of, protocols
from bayeskin.pipeline import diagnosis, experiment
from bayeskin.pipeline.engine import Silent
from bayeskin.pipeline.folder import Record, write_record
from bayeskin.report import figure_experiments
from bayeskin.types import PadMotion, Parameter, Simulation
from bayeskin.workers import Lost

OWN_SPEED = 9e-4  # m/s, the toy's
DRAG = 4e-3 / OWN_SPEED
KNOWN = {
    "rub": Mechanism(
        "rub", (Parameter("rubbing", "N", 0.0, 0.1, "uniform"),), {"rubbing": 0.0}, lambda v: "",
        ("rub", "drag"),
        Instrument(
            Place.DRIVE,
            lambda v, m, f: added(f, lambda t: v["rubbing"][:, None] * np.sign(speed_of(m, t))),
        ),
    ),
    "drag": Mechanism(
        "drag", (Parameter("dragging", "N s/m", 0.0, 40.0, "uniform"),), {"dragging": 0.0}, lambda v: "",
        ("rub", "drag"),
        Instrument(Place.DRIVE, lambda v, m, f: added(f, lambda t: v["dragging"][:, None] * speed_of(m, t))),
    ),
}  # fmt: skip


def gaussians(distance: float, draws: int, seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Draws of two hypotheses over 40 bins that differ by `distance` sds of noise and draws together."""
    rng = np.random.default_rng(1)
    noise = 1e-4 * 0.5 ** np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    spread = 0.03 * rng.standard_normal((40, 4))
    apart = rng.standard_normal(40)
    apart *= distance / np.sqrt(apart @ np.linalg.solve(noise + spread @ spread.T, apart))
    rng = np.random.default_rng(seed)
    first, second = (rng.standard_normal((draws, 4)) @ spread.T for _ in range(2))
    return [first, apart + second], noise


def exact(distance: float) -> float:
    """Information [nats] on which of two equally probable normals, `distance` sds apart, a number is from."""
    x = np.linspace(-10.0, 10.0 + distance, 20001)
    a, b = norm.pdf(x), norm.pdf(x - distance)
    both = 0.5 * (a + b)
    return float(0.5 * np.trapezoid(a * np.log(a / both) + b * np.log(b / both), x))


@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_gain_about_two_gaussians_is_the_closed_form(distance: float) -> None:
    forces, noise = gaussians(distance, 150, 0)
    gain = expected_gain(forces, noise, [1.0, 1.0], 3)
    assert gain.nats == pytest.approx(exact(distance), abs=0.02 + 3 * gain.standard_error)
    assert 0.5 < gain.named <= 1.0


@pytest.mark.parametrize("distance", [0.0, 2.0])
def test_a_dozen_draws_give_too_little_rather_than_too_much(distance: float) -> None:
    gains = [expected_gain(*gaussians(distance, 12, seed), [1.0, 1.0], seed).nats for seed in range(12)]
    assert np.mean(gains) <= exact(distance) + 0.01
    assert np.mean(gains) >= exact(distance) - 0.15


def test_draws_that_spread_in_as_many_directions_as_there_are_draws_do_not_hide_all() -> None:
    """Of 0.63 nats; single densities, sure and wrong, once made it 0.05 and less."""
    gains = []
    for seed in range(8):
        rng = np.random.default_rng(1)
        spread = 20.0 * np.linalg.qr(rng.standard_normal((60, 10)))[0]
        apart = rng.standard_normal(60)
        apart *= 4.0 / np.sqrt(apart @ np.linalg.solve(np.eye(60) + spread @ spread.T, apart))
        rng = np.random.default_rng(seed)
        first, second = (rng.standard_normal((DRAWS, 10)) @ spread.T for _ in range(2))
        gains.append(expected_gain([first, apart + second], np.eye(60), [1.0, 1.0], seed))
    assert min(one.nats for one in gains) > 0.25
    assert max(one.nats for one in gains) < exact(4.0)
    assert max(one.standard_error for one in gains) < 0.3


def test_nothing_is_learnt_about_hypotheses_that_are_the_same() -> None:
    forces, noise = gaussians(0.0, 20, 0)
    found = expected_gain([forces[0], forces[0].copy()], noise, [1.0, 3.0], 0)
    assert found.nats == 0.0
    assert found.named == pytest.approx(0.25**2 + 0.75**2)


def test_a_gain_is_at_most_the_entropy_of_the_hypotheses_and_repeats() -> None:
    forces, noise = gaussians(12.0, 12, 0)
    found = expected_gain(forces, noise, [1.0, 3.0], 5)
    assert found.nats == pytest.approx(-0.25 * np.log(0.25) - 0.75 * np.log(0.75), abs=1e-3)
    assert found == expected_gain(forces, noise, [1.0, 3.0], 5)


def test_too_few_draws_are_refused() -> None:
    forces, noise = gaussians(1.0, 3, 0)
    with pytest.raises(InputError, match="4 draws"):
        expected_gain(forces, noise, [1.0, 1.0], 0)
    with pytest.raises(InputError, match="two at least"):
        expected_gain(forces[:1], noise, [1.0], 0)


def test_protocols_vary_the_recordings_own_motion() -> None:
    amplitude, speed, hold = own(toy.MOTION)
    assert (amplitude, speed, hold) == pytest.approx((9e-3, OWN_SPEED, 30.0))
    listed = {one.name: one for one in protocols(toy.MOTION)}
    assert len(listed) == 9
    for one in listed.values():
        assert np.all(np.diff(one.motion.time_s) > 0.0)
        assert one.motion.displacement_m[0] == one.motion.displacement_m.min() == 0.0
        assert one.sentence.endswith(".")
    slow = listed["quarter speed"].motion
    assert np.diff(slow.displacement_m)[1] / np.diff(slow.time_s)[1] == pytest.approx(OWN_SPEED / 4)
    kinds = [p.kind for p in phases_of(listed["same again"].motion)]
    assert kinds == ["rest", "load", "hold", "unload", "rest", "load", "hold", "unload", "rest"]
    assert [p.cycle for p in phases_of(listed["no holds"].motion)][-1] == 4
    with pytest.raises(InputError, match="never move"):
        own(PadMotion(np.array([0.0, 1.0]), np.zeros(2)))


def toy_run(motion: PadMotion, theta: Mapping[str, float], laws: Sequence[Any]) -> Simulation:
    """The toy on any motion; it knows no parameters of mechanisms."""
    assert list(theta) == list(toy.SPACE.names)
    assert not laws
    time_s = np.unique(np.concatenate([np.linspace(0.0, motion.time_s[-1], 400), motion.time_s]))
    force = SCALE * toy.toy_force(np.array([list(theta.values())]), time_s, motion)[0]
    corner = np.isin(time_s, motion.time_s)
    return Simulation(theta, time_s, motion.at(time_s), force, corner, "ok", "", {}, "toy")


def fitted(name: str, **values: float) -> Fit:
    """A set of one mechanism at the truth of the base, known to a hundredth of each prior."""
    seen = ObservedSurrogate(ToySurrogate(), (KNOWN[name],), toy.MOTION)
    log_posterior = LogPosterior(seen, empty_recording())
    return Fit(
        (name,),
        log_posterior,
        {**TRUTH, **values, **NOISE},
        0.0,
        0.0,
        1e-6 * np.eye(log_posterior.dim),
        np.zeros(3),
    )


def judged(fits: Sequence[Fit], run: Any) -> list[Experiment]:
    return ranked([weigh(one, fits, KNOWN, run, 0) for one in protocols(toy.MOTION)])


def test_friction_is_told_from_drag_by_another_speed_and_not_by_a_repeat() -> None:
    fits = [fitted("rub", rubbing=4e-3), fitted("drag", dragging=DRAG)]
    table = judged(fits, toy_run)
    by_name = {one.protocol: one for one in table}
    assert table[0].protocol in ("quarter speed", "five times faster")
    assert by_name["five times faster"].gain_nats > 0.5
    assert by_name["quarter speed"].gain_nats > 0.3
    assert by_name["same again"].gain_nats < 0.05
    assert by_name["half displacement"].gain_nats < 0.05
    assert all(one.possible_nats == pytest.approx(np.log(2.0)) for one in table)
    assert [one.gain_nats for one in table] == sorted((one.gain_nats for one in table), reverse=True)


def test_the_figure_shows_every_protocol_that_could_be_judged() -> None:
    fits = [fitted("rub", rubbing=4e-3), fitted("drag", dragging=DRAG)]
    table = judged(fits, toy_run)
    figure = figure_experiments((*table, dataclasses.replace(table[0], protocol="failed", gain_nats=np.nan)))
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        one.protocol for one in reversed(table)
    ]
    assert "five times faster" in figure.get_suptitle().lower() or "quarter" in figure.get_suptitle().lower()
    assert "None" in figure_experiments(()).get_suptitle()


def test_failed_runs_are_counted_and_leave_a_row() -> None:
    def failing(motion: PadMotion, theta: Mapping[str, float], laws: Sequence[Any]) -> Simulation:
        run = toy_run(motion, theta, laws)
        return Simulation(
            theta, run.time_s, run.displacement_m, run.force_n, run.corner, "failed", "", {}, "toy"
        )

    fits = [fitted("rub", rubbing=4e-3), fitted("drag", dragging=DRAG)]
    table = judged(fits, failing)
    assert all(np.isnan(one.gain_nats) and one.failed == 24 for one in table)
    with pytest.raises(InputError, match="two at least"):
        judged(fits[:1], toy_run)


def test_sets_with_look_alikes_in_the_place_of_the_likeliest_compete() -> None:
    likely = dataclasses.replace(fitted("rub", rubbing=4e-3), log_evidence=9.0)
    alike = fitted("drag", dragging=DRAG)
    both = dataclasses.replace(alike, names=("drag", "rub"), log_evidence=1.0)
    none = dataclasses.replace(alike, names=(), log_evidence=3.0)
    found = [none, alike, both, likely]
    assert [one.names for one in compete(found, ["rub"], KNOWN)] == [("rub",), ("drag",)]
    # A set that the search refused, since the surrogate is unsure of it, is no reference however likely.
    unsure = dataclasses.replace(alike, log_evidence=99.0)
    assert [one.names for one in compete([*found, unsure], ["rub"], KNOWN)] == [("rub",), ("drag",)]
    impossible = dataclasses.replace(alike, log_evidence=-np.inf)
    assert [one.names for one in compete([none, impossible, likely], ["rub"], KNOWN)] == [("rub",)]


def test_noise_of_a_test_to_come_is_that_of_the_fit() -> None:
    found = fitted("rub", rubbing=4e-3)
    covariance = noise_of(found, toy.MOTION, found.log_posterior.binned.edges_s)
    kinds = [p.kind for p in phases_of(toy.MOTION)]
    phase = np.searchsorted([p.end_s for p in phases_of(toy.MOTION)], found.log_posterior.binned.time_s)
    expected = [NOISE[f"sd_{kinds[i]}"] ** 2 + 1e-6 for i in phase]
    np.testing.assert_allclose(np.diag(covariance), expected, rtol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    hold = slice(20, 40)
    near = np.diag(covariance[hold, hold], 1)
    np.testing.assert_allclose(near, NOISE["sd_hold"] ** 2 * np.exp(-1.0 / NOISE["tau_noise"]) + 0.2e-6)


def test_protocols_judged_before_an_interruption_are_not_judged_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fits = [fitted("rub", rubbing=4e-3), fitted("drag", dragging=DRAG)]
    made: list[str] = []
    listed = {one.name: one for one in protocols(toy.MOTION)}

    def serially(judge: Any, items: Sequence[str], workers: int) -> Iterator[tuple[int, Any]]:
        for place, name in enumerate(items):
            if len(made) == 4:
                made.append("interrupted")
                raise KeyboardInterrupt
            made.append(name)
            yield place, weigh(listed[name], fits, KNOWN, toy_run, 0)

    monkeypatch.setattr(experiment, "run_parallel", serially)
    bench = SimpleNamespace(motion=toy.MOTION, run=SimpleNamespace(config=SimpleNamespace(seed=0)))
    asked = (tmp_path / "x.toml", [{"names": list(one.names)} for one in fits], bench, tmp_path, Silent())
    with pytest.raises(KeyboardInterrupt):
        experiment._weighed(*asked)
    file = next(tmp_path.glob("*.jsonl"))
    file.write_text(file.read_text() + '{"protocol": "torn')
    found = ranked(experiment._weighed(*asked))
    assert sorted(made) == sorted([*listed, "interrupted"])
    experiment._weighed(*asked)  # all lines are whole: nothing is left to judge
    assert len(made) == len(listed) + 1
    assert [one.protocol for one in found] == [one.protocol for one in judged(fits, toy_run)]
    words = experiment._in_words(
        {"sets": [["rub"], ["drag"]], "experiments": [experiment._row(one) for one in found]}
    )
    assert words.splitlines()[0] == "taken as equally probable: rub; or drag"
    assert found[0].sentence in words.splitlines()[1]
    assert "nothing competes" in experiment._in_words({"sets": [["rub"]], "experiments": []})


@dataclasses.dataclass(frozen=True)
class Asked:
    """What `choose` sees of a run that has been diagnosed."""

    source: Path
    folder: Path


@pytest.fixture
def diagnosed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Asked:
    """A run whose diagnosis has been made, and found that something rubs."""
    (tmp_path / "x.toml").write_text('[recording]\nfile = "x.h5"\n')
    record = Record("inputs", True, 1.0, {"diagnosis.json": "00"})
    (tmp_path / "x" / "diagnose").mkdir(parents=True)
    write_record(tmp_path / "x" / "diagnose", record)
    config = SimpleNamespace(
        model=SimpleNamespace(observation="reaction"), design=SimpleNamespace(coarse=None), seed=0
    )
    run = SimpleNamespace(
        config=config, folder=tmp_path / "x", at=lambda *parts: tmp_path.joinpath("x", *parts)
    )
    bench = SimpleNamespace(motion=toy.MOTION, run=run, known=KNOWN)
    monkeypatch.setattr(experiment, "opened", lambda *_: run)
    monkeypatch.setattr(experiment, "workbench", lambda _: bench)
    monkeypatch.setattr(experiment, "stored", lambda one: {"names": list(one.names)})
    monkeypatch.setattr(experiment, "caption", lambda _: "x")
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: {"best_set": ["rub"]})
    return Asked(tmp_path / "x.toml", tmp_path / "x" / "experiment")


def test_nothing_competes_with_the_only_set_that_was_tried(
    diagnosed: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "fits_of", lambda _: [fitted("rub", rubbing=4e-3)])
    answer = experiment.choose(diagnosed.source, Silent())
    assert (answer["ok"], answer["sets"]) == (True, [["rub"]])
    assert "nothing competes" in answer["text"]
    assert (diagnosed.folder / "experiment.json").is_file()


def test_without_a_diagnosis_its_answer_is_given_and_without_its_fits_one_line(
    diagnosed: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "fits_of", lambda _: [])
    with pytest.raises(InputError, match="no fit of rub; expected those that `bayeskin diagnose` left"):
        experiment.choose(diagnosed.source, Silent())
    failed = {"ok": False, "message": "too few runs", "text": "design: failed: too few runs"}
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: failed)
    assert experiment.choose(diagnosed.source, Silent()) == failed


def test_protocols_whose_processes_are_lost_are_said_to_be_unjudged(
    diagnosed: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = [fitted("rub", rubbing=4e-3), fitted("drag", dragging=DRAG)]
    monkeypatch.setattr(diagnosis, "fits_of", lambda _: fits)
    monkeypatch.setattr(
        experiment, "run_parallel", lambda judge, names, _: ((i, Lost("killed")) for i in range(len(names)))
    )
    answer = experiment.choose(diagnosed.source, Silent())
    assert (answer["ok"], len(answer["experiments"])) == (False, 9)
    assert "nothing competes" not in answer["text"]
    assert answer["text"].count("could not be judged") == 9
    asked: list[str] = []

    def now(judge: Any, names: Sequence[str], workers: int) -> Iterator[tuple[int, Any]]:
        asked.extend(names)
        listed = {one.name: one for one in protocols(toy.MOTION)}
        for place, name in enumerate(names):
            yield place, weigh(listed[name], fits, KNOWN, toy_run, 0)

    monkeypatch.setattr(experiment, "run_parallel", now)
    assert experiment.choose(diagnosed.source, Silent())["ok"]
    assert len(asked) == 9  # what was lost is judged anew
