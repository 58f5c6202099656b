"""Tests of the outputs of a diagnosis: parts of the force, the remainder, figures and sentences."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.figure import Figure
from toys import closed_form_model
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, toy_problem

from bayeskin import report
from bayeskin.inference import LogPosterior
from bayeskin.json_files import plain
from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.assess import Diagnosis, Remainder
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.contributions import Contribution, contributions
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import propose_form
from bayeskin.mismatch.locate import Located, Window
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.report.conclusion import conclusion_of
from bayeskin.workflow.diagnosis_answer import candidate_entries, remainder_entry
from bayeskin.workflow.diagnosis_figures import draw
from bayeskin.workflow.diagnosis_forces import forces_of
from bayeskin.workflow.diagnosis_text import in_words

CREEP_S = 20.0
VALUES = {
    "F0": -0.04, "drift": 1e-4, "Fc": 0.05, "presliding": 5e-5, "friction_start": 0.0, "friction_tau": CREEP_S
}  # fmt: skip
ALONE = toy_problem(1)
BINNED = ALONE.binned


def build(names: Sequence[str]) -> LogPosterior:
    if not names:
        return ALONE
    these = tuple(catalogue()[name] for name in names)
    return dataclasses.replace(
        ALONE, surrogate=ObservedSurrogate(ToySurrogate(), these, closed_form_model.MOTION)
    )


def fitted(*names: str) -> Fit:
    """The toy with mechanisms at VALUES, as if it had been fitted there."""
    log_posterior = build(names)
    theta = {name: {**TRUTH, **NOISE, **VALUES}[name] for name in log_posterior.names}
    return Fit(names, log_posterior, theta, 0.0, 0.0, 1e-6 * np.eye(log_posterior.dim), np.zeros(3))


def parts_of(*names: str) -> list[Contribution]:
    """Returns the contributions of mechanisms to the force of the closed-form model."""

    def force(names: Sequence[str], theta: Mapping[str, float]) -> np.ndarray:
        log_posterior = build(names)
        values = log_posterior.from_sampling(log_posterior.vector(theta))
        return np.asarray(log_posterior.predict(values).mean[0])

    return contributions(names, fitted(*names).theta, force, catalogue())


def located(residual_n: np.ndarray, *windows: Window) -> Located:
    return Located(windows, np.arange(len(residual_n)), residual_n, np.full(len(residual_n), 1e-3), 1.0)


WINDOW = Window(15.0, 45.0, "hold", 1, 5e-3, 1e-3)
PARAMETERS = ALONE.surrogate.space.parameters


@dataclasses.dataclass(frozen=True)
class DrawnFit:
    """An assessed fit with the values that the figures need."""

    force_n: np.ndarray
    band_n: tuple[np.ndarray, np.ndarray]
    held_out_n: np.ndarray | None
    located: Located
    values: Mapping[str, Mapping[str, Any]]
    on_skin: None = None


def drawn(left_n: float, held_out_by: float | None = None) -> DrawnFit:
    """A fit that leaves so much of every bin, in a band of 3 mN to either side."""
    force_n = BINNED.force_n - left_n
    held_out_n = None if held_out_by is None else BINNED.force_n - held_out_by
    values = {
        p.name: {"mean": 0.5 * (p.lower + p.upper), "interval90": [p.lower, p.upper]} for p in PARAMETERS
    }
    return DrawnFit(force_n, (force_n - 3e-3, force_n + 3e-3), held_out_n, located(0.0 * force_n), values)


# Parts of the force


def test_a_mechanism_s_part_is_what_it_adds_at_its_own_values() -> None:
    drift, offset = parts_of("force-offset", "sensor-drift")[::-1]
    assert (offset.name, drift.name) == ("force-offset", "sensor-drift")  # the larger first
    assert offset.along == drift.along == ()
    np.testing.assert_allclose(offset.force_n, -0.04, atol=1e-12)
    assert offset.size_n == pytest.approx(0.04)
    np.testing.assert_allclose(drift.force_n, 1e-4 * BINNED.time_s, atol=1e-12)
    assert parts_of() == []


def test_friction_takes_its_creep_along() -> None:
    parts = {part.name: part for part in parts_of("device-friction", "friction-creep")}
    friction, creep = parts["device-friction"], parts["friction-creep"]
    assert friction.along == ("friction-creep",)
    assert creep.along == ()
    hold = (BINNED.time_s > 16.0) & (BINNED.time_s < 44.0)
    fades = friction.force_n[hold] / friction.force_n[hold][0]
    np.testing.assert_allclose(fades, np.exp(-(BINNED.time_s[hold] - BINNED.time_s[hold][0]) / CREEP_S))
    kept = parts_of("device-friction")[0]
    assert kept.along == ()
    np.testing.assert_allclose(friction.force_n, kept.force_n + creep.force_n, atol=1e-12)


# What is left


def drifting() -> Fit:
    """Returns the remainder that a drift of the load cell leaves if no mechanism is known."""
    plain_fit, drift = fitted(), 2e-4 * BINNED.time_s
    noisy = dataclasses.replace(BINNED, force_n=BINNED.force_n + drift)
    return dataclasses.replace(plain_fit, log_posterior=dataclasses.replace(ALONE, binned=noisy))


@pytest.fixture(scope="module")
def remainder() -> Remainder:
    fit = drifting()
    return Remainder(
        discrepancy(fit, closed_form_model.MOTION), propose_form(fit, closed_form_model.MOTION, 0)
    )


def test_what_is_left_is_said_with_its_size_parts_and_form(remainder: Remainder) -> None:
    said = json.loads(json.dumps(plain(remainder_entry(remainder)), allow_nan=False))
    assert said["size_n"] == pytest.approx(remainder.discrepancy.size_n)
    assert set(said["share"]) == {"displacement", "change", "phase", "cycle"}
    assert said["noticeable"]
    assert said["gain_nats"] > 5.0
    assert "rises with time" in " ".join(said["features"])
    term = said["form"]["terms"][0]
    assert (term["name"], term["unit"]) == ("time", "N/s")
    assert abs(term["coefficient"] - 2e-4) < 3.0 * term["standard_error"] + 3e-5
    assert said["form"]["sentence"] == remainder.form.sentence


def test_words_say_what_was_found_and_how_far_the_models_are_off() -> None:
    fits = {
        "rmse": 1e-3, "rmse_held_out": 3e-3, "emulator": {"settled": True}, "sampled": {"settled": True},
    }  # fmt: skip
    answer: dict[str, Any] = {
        "verdict": "unknown", "mechanisms": [], "nothing_probability": 0.02, "smooth_probability": 0.974,
        "located": [], "remaining": [], "recordings": [], "best_set": [], "candidates": [], "folder": "x",
        "sets": [], "held_out_set": None, "page": "x", "fit": {"before": fits, "after": fits},
        "full_model": {"rmse": 2.5e-3, "fit_off_by": 4e-4},
    }  # fmt: skip
    words = in_words(answer)
    assert "an unnamed smooth discrepancy: probability 0.97" in words
    assert words.splitlines()[-4:] == [*conclusion_of(answer).sentences, "report: x"]
    assert words.splitlines()[-5] == f"{conclusion_of(answer).verdict}."
    assert "an RMSE of 2.5 mN. The fitted model differs from it by 0.4 mN there." in words
    assert "The intervals are" not in words
    rough = {**answer, "fit": {"before": fits, "after": {**fits, "sampled": {"settled": False}}}}
    assert "The intervals are approximate" in in_words(rough)
    assert "The full model fails at the best values: it folds" in in_words(
        {**answer, "full_model": {"message": "it folds"}}
    )
    says = {"sd_alone": {"E_c": 0.1, "E_s": 0.8, "k_c": 1.0}, "widens": {"E_c": 2.5, "E_s": 1.1, "k_c": 1.0}}
    nothing = {"sd_alone": {"E_c": 1.0}, "widens": {"E_c": 1.0}}
    pair = [
        {"name": "A", "rms_n": 2e-3, "noise_n": 1e-3, "tension": 0.4, "contradicts": False, **says},
        {"name": "B", "rms_n": 5e-3, "noise_n": 1e-3, "tension": 5.2, "contradicts": True, **nothing},
        {"name": "C", "rms_n": 5e-3, "noise_n": 1e-3, "tension": None, "contradicts": False, **nothing},
    ]
    joint = in_words({**answer, "recordings": pair})
    assert "A agrees with the others, by 0.4 sd: RMS residual 2.0 mN, 2.0 sd of its noise" in joint
    assert "A alone informs E_c and weakly E_s; without it, the intervals would be wider by these" in joint
    assert "factors: E_c 2.5\n" in joint
    assert "B alone informs no parameter of the skin; without it, no interval would be much wider" in joint
    assert "B contradicts the others, by 5.2 sd" in joint
    assert "C: RMS residual 5.0 mN, 5.0 sd of its noise; it could not be fitted alone" in joint


# Figures


def headline(figure: Figure) -> str:
    return figure.get_suptitle().replace("\n", " ")


def test_each_figure_is_written_where_it_has_something_to_show(
    monkeypatch: pytest.MonkeyPatch, remainder: Remainder
) -> None:
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, made_by: (stem.with_suffix(".png"),))
    rows = [{"name": "force-offset", "delta_score": 3.0, "standard_error": 1.0}]
    context = DiagnosisContext(BINNED, None, closed_form_model.MOTION, None, ALONE.surrogate.space, 0)  # type: ignore[arg-type]
    explanation = SimpleNamespace(beginning=None, split_s=60.0)
    written = []
    for parts, left in ((parts_of("force-offset"), remainder), ([], None)):
        diagnosis = Diagnosis(explanation, drawn(8e-3), drawn(2e-3), parts, left, "")  # type: ignore[arg-type]
        written.append({path.name for path in draw(Path("x"), "", context, diagnosis, rows)})
    assert written[0] - written[1] == {"contributions.png", "discrepancy.png"}
    assert {Path(name).stem for name in written[1]} == {
        "located", "candidates", "before_after", "residual_by_phase", "base_parameters"
    }  # fmt: skip


def test_before_and_after_have_their_band_and_what_was_not_fitted() -> None:
    before, after = drawn(8e-3, held_out_by=2e-2), drawn(2e-3, held_out_by=5e-3)
    figure = report.figure_before_after(BINNED, closed_form_model.MOTION, before, after, 60.0)
    assert headline(figure) == "RMS residual 8.0 mN before, 2.0 mN after"
    titles = {ax.get_title(loc="left")[-60:]: ax for ax in figure.axes}
    assert [title.split("  ")[-1] for title in titles][1:4:2] == [
        "bins inside the 90 % bands: 0 → 100 %", "fitted up to 60 s; later 20.0 → 5.0 mN RMS"
    ]  # fmt: skip
    residual, left = figure.axes[1], figure.axes[3]
    (band,) = residual.collections[:1]
    edges = band.get_paths()[0].vertices[:, 1]  # type: ignore[index]
    np.testing.assert_allclose([edges.min(), edges.max()], [-3.0, 3.0], atol=1e-9)
    assert [line.get_xdata()[0] for line in left.get_lines() if line.get_linestyle() == "--"] == [60.0]  # type: ignore[index]
    whole = report.figure_before_after(BINNED, closed_form_model.MOTION, drawn(8e-3), drawn(2e-3), None)
    assert len(whole.axes) == 3


def test_the_page_gets_the_forces_and_windows_of_each_recording() -> None:
    context = DiagnosisContext(BINNED, None, closed_form_model.MOTION, None, ALONE.surrogate.space, 0)  # type: ignore[arg-type]
    before = dataclasses.replace(drawn(8e-3), located=located(0.0 * BINNED.force_n, WINDOW))
    diagnosis = Diagnosis(SimpleNamespace(), before, drawn(2e-3), [], None, "")  # type: ignore[arg-type]
    (entry,) = json.loads(json.dumps(plain(forces_of(context, diagnosis)), allow_nan=False))
    assert entry["name"] == ""
    assert entry["windows"] == [{"start_s": 15.0, "end_s": 45.0, "mean_n": 5e-3}]
    for name, left_n in (("before", 8e-3), ("after", 2e-3), ("low_90", 5e-3), ("high_90", -1e-3)):
        np.testing.assert_allclose(np.subtract(entry["recorded_n"], entry[f"{name}_n"]), left_n, atol=1e-12)
    np.testing.assert_allclose(entry["time_s"], BINNED.time_s)


def test_the_base_s_parameters_that_leave_their_intervals_are_said() -> None:
    values = {p.name: {"mean": TRUTH[p.name], "interval90": [0.9 * TRUTH[p.name], 1.1 * TRUTH[p.name]]}
              for p in PARAMETERS}  # fmt: skip
    stays = report.figure_base_parameters(PARAMETERS, values, values)
    assert headline(stays) == "No base parameter moves out of its 90 % interval"
    assert len(stays.axes) == len(PARAMETERS)
    far = {
        **values,
        "E_c": {"mean": 2.0 * TRUTH["E_c"], "interval90": [1.8 * TRUTH["E_c"], 2.2 * TRUTH["E_c"]]},
    }
    moves = report.figure_base_parameters(PARAMETERS, values, far)
    assert headline(moves).endswith("moves out of its 90 % interval")
    before, after = (line.get_xdata() for line in moves.axes[0].get_lines()[::2])
    np.testing.assert_allclose(10.0 ** (np.array(after) - before), 2.0)  # a log-uniform prior


def test_residuals_by_phase_have_a_line_a_cycle_and_the_rms_of_their_kind() -> None:
    kinds = np.array([phase.kind for phase in BINNED.phases])[BINNED.phase]
    residual = np.where(kinds == "hold", 8e-3, 2e-3)
    before, after = located(residual, WINDOW), located(0.25 * residual)
    figure = report.figure_residual_by_phase(BINNED, closed_form_model.MOTION, before, after)
    assert headline(figure) == "Largest residual in holds: 8.0 mN RMS before, 2.0 mN after"
    titles = {ax.get_title(loc="left"): ax for ax in figure.axes}
    assert [title[title.index("  ") + 2 :] for title in titles] == [
        "while loading: 2.0 → 0.5 mN RMS",
        "while unloading: 2.0 → 0.5 mN RMS",
        "in holds: 8.0 → 2.0 mN RMS",
        "at rest: 2.0 → 0.5 mN RMS",
    ]
    lines = [len(ax.get_lines()) for ax in figure.axes]
    assert lines == [4, 4, 4, 6]  # before and after of two cycles; the rest before the first is one more
    assert [ax.get_xscale() for ax in figure.axes] == ["linear", "linear", "log", "log"]
    first, second = figure.axes[2].get_lines()[:2]
    assert cast(float, first.get_alpha()) > cast(float, second.get_alpha())
    np.testing.assert_allclose(np.asarray(first.get_ydata()), 8.0)
    assert np.ptp(np.asarray(figure.axes[0].get_lines()[0].get_xdata())) == pytest.approx(8.1)  # mm


def test_residuals_of_a_part_of_the_recording_leave_the_other_phases_out() -> None:
    inside = np.flatnonzero(BINNED.time_s < 50.0)
    part = Located((), inside, np.full(len(inside), 1e-3), np.full(len(inside), 1e-3), 1.0)
    figure = report.figure_residual_by_phase(BINNED, closed_form_model.MOTION, part, part)
    assert [len(ax.get_lines()) for ax in figure.axes] == [2, 2, 2, 2]
    moving = dataclasses.replace(
        BINNED,
        phases=tuple(dataclasses.replace(p, kind="hold") if p.kind == "rest" else p for p in BINNED.phases),
    )
    panels = report.figure_residual_by_phase(moving, closed_form_model.MOTION, part, part).axes
    assert [ax.get_visible() for ax in panels] == [True, True, True, False]


def test_contributions_have_a_row_each_and_rounding_does_not_fill_one() -> None:
    parts = parts_of("device-friction", "force-offset", "friction-creep")
    parts.append(Contribution("pad-slip", (), np.full(len(BINNED.force_n), 1e-17)))
    figure = report.figure_contributions(BINNED, closed_form_model.MOTION, parts)
    assert len(figure.axes) == 2 * len(parts)
    assert headline(figure) == f"{parts[0].name} moves the force most, by {1e3 * parts[0].size_n:.1f} mN RMS"
    titles = [ax.get_title(loc="left") for ax in figure.axes[::2]]
    assert "force-offset: 40.0 mN RMS" in titles
    assert [title for title in titles if title.startswith("device-friction with friction-creep: ")]
    drawn = np.asarray(figure.axes[0].get_lines()[0].get_ydata())
    np.testing.assert_allclose(drawn, 1e3 * parts[0].force_n)
    low, high = figure.axes[-2].get_ylim()
    assert high - low > 0.02  # mN


def test_what_a_pair_gains_is_no_candidate_s_alone() -> None:
    known = catalogue()
    sets: list[tuple[str, ...]] = [(), ("device-friction",), ("device-friction", "force-offset")]
    fits = {names: fitted(*names) for names in sets}
    assert [row["name"] for row in candidate_entries(fits, known)] == ["device-friction"]
    needed = ("device-friction", "friction-creep")
    fits[needed] = fitted(*needed)
    assert {row["name"] for row in candidate_entries(fits, known)} == set(needed)


def test_candidates_of_a_few_nats_are_read_off_beside_one_of_hundreds() -> None:
    rows = [
        {"name": "viscous-drag", "delta_score": 812.34, "standard_error": 100.0},
        {"name": "force-offset", "delta_score": -1.26, "standard_error": 0.4},
        {"name": "sensor-drift", "delta_score": -0.01, "standard_error": 0.0},
    ]
    figure = report.figure_candidates(rows)
    figure.draw_without_rendering()
    (numbers,) = figure.axes[0].child_axes
    assert [label.get_text() for label in numbers.get_yticklabels()] == [
        "+0.0 ± 0.0", "−1.3 ± 0.4", "+812 ± 100"
    ]  # fmt: skip
    assert headline(figure).endswith("viscous-drag gains most on its own")
    rows[1] |= {"delta_score": 750.0}
    assert headline(report.figure_candidates(rows)).endswith("own, 1 other as much within the error")
