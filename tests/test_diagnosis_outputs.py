"""What a diagnosis says and draws: parts of the force, what is left and when that is told, figures, words."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import toy
from matplotlib.figure import Figure
from test_mismatch import tried
from toy_inference import NOISE, TRUTH, ToySurrogate, toy_problem

from bayeskin import report
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.contributions import Contribution, contributions
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import propose_form
from bayeskin.mismatch.full_fit import FullFit
from bayeskin.mismatch.locate import Located, Window
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.search import Search
from bayeskin.mismatch.verdict import Diagnosis, Named
from bayeskin.pipeline import diagnosis
from bayeskin.pipeline.diagnosis_outputs import (
    Found,
    Remainder,
    Shown,
    candidates,
    draw,
    in_words,
    mechanism,
    shown,
    unexplained,
)
from bayeskin.pipeline.folder import plain
from bayeskin.pipeline.taking_up import TakenUp

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
    return dataclasses.replace(ALONE, surrogate=ObservedSurrogate(ToySurrogate(), these, toy.MOTION))


def fitted(*names: str) -> Fit:
    """The toy with mechanisms at VALUES, as if it had been fitted there."""
    log_posterior = build(names)
    theta = {name: {**TRUTH, **NOISE, **VALUES}[name] for name in log_posterior.names}
    return Fit(names, log_posterior, theta, 0.0, 0.0, 1e-6 * np.eye(log_posterior.dim), np.zeros(3))


def parts_of(*names: str) -> list[Contribution]:
    """By the toy itself."""

    def force(case: tuple[Sequence[str], Mapping[str, float]]) -> np.ndarray:
        log_posterior = build(case[0])
        values = log_posterior.from_sampling(log_posterior.vector(case[1]))
        return np.asarray(log_posterior.predict(values).mean[0])

    return contributions(names, fitted(*names).theta, force, catalogue())


def located(residual_n: np.ndarray, *windows: Window) -> Located:
    return Located(windows, np.arange(len(residual_n)), residual_n, np.full(len(residual_n), 1e-3), 1.0)


WINDOW = Window(15.0, 45.0, "hold", 1, 5e-3, 1e-3)
PARAMETERS = ALONE.surrogate.space.parameters


def drawn(left_n: float, held_out_by: float | None = None) -> Shown:
    """A fit that leaves so much of every bin, in a band of 3 mN to either side."""
    force_n = BINNED.force_n - left_n
    held_out_n = None if held_out_by is None else BINNED.force_n - held_out_by
    values = {
        p.name: {"mean": 0.5 * (p.lower + p.upper), "interval90": [p.lower, p.upper]} for p in PARAMETERS
    }
    return Shown(force_n, (force_n - 3e-3, force_n + 3e-3), held_out_n, located(0.0 * force_n), values)


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
    parts = {one.name: one for one in parts_of("device-friction", "friction-creep")}
    friction, creep = parts["device-friction"], parts["friction-creep"]
    assert friction.along == ("friction-creep",)
    assert creep.along == ()
    hold = (BINNED.time_s > 16.0) & (BINNED.time_s < 44.0)
    fades = friction.force_n[hold] / friction.force_n[hold][0]
    np.testing.assert_allclose(fades, np.exp(-(BINNED.time_s[hold] - BINNED.time_s[hold][0]) / CREEP_S))
    kept = parts_of("device-friction")[0]
    assert kept.along == ()
    np.testing.assert_allclose(friction.force_n, kept.force_n + creep.force_n, atol=1e-12)


def test_a_named_mechanism_states_the_size_of_its_own_part() -> None:
    named = Named("sensor-drift", 1.0, ("sensor-drift",), 1.0, 5e-3)
    parts = parts_of("force-offset", "sensor-drift")
    values = {"drift": {"mean": 1e-4, "sd": 1e-6, "interval90": [9.8e-5, 1.02e-4]}}
    said = mechanism(named, catalogue()["sensor-drift"], parts, values, {"drift": 1e-4})
    assert said["contribution_n"] == pytest.approx(1e-4 * np.sqrt(np.mean(BINNED.time_s**2)))
    assert said["statement"] == catalogue()["sensor-drift"].statement({"drift": 1e-4})
    assert said["parameters"] == {"drift": {**values["drift"], "unit": "N/s"}}


# What is left


@pytest.mark.parametrize(
    ("verdict", "windows", "described"),
    [
        ("nothing-missing", (), False),
        ("nothing-missing", (WINDOW,), False),
        ("named", (), False),
        ("named", (WINDOW,), True),
        ("unknown", (), True),
        ("unknown", (WINDOW,), True),
    ],
)
def test_what_is_left_is_described_where_something_is(
    verdict: Any, windows: tuple[Window, ...], described: bool
) -> None:
    after = located(np.zeros(len(BINNED.force_n)), *windows)
    assert diagnosis.leaves_something(Diagnosis(verdict, (), 0.0, 0.05, True), after) == described


def drifting() -> Fit:
    """What a sensor's drift leaves where no mechanism is known."""
    plain_fit, drift = fitted(), 2e-4 * BINNED.time_s
    noisy = dataclasses.replace(BINNED, force_n=BINNED.force_n + drift)
    return dataclasses.replace(plain_fit, log_posterior=dataclasses.replace(ALONE, binned=noisy))


@pytest.fixture(scope="module")
def remainder() -> Remainder:
    fit = drifting()
    return Remainder(discrepancy(fit, toy.MOTION), propose_form(fit, toy.MOTION, 0))


def test_what_is_left_is_said_with_its_size_parts_and_form(remainder: Remainder) -> None:
    said = json.loads(json.dumps(plain(unexplained(remainder)), allow_nan=False))
    assert said["size_n"] == pytest.approx(remainder.discrepancy.size_n)
    assert set(said["share"]) == {"displacement", "change", "phase", "cycle"}
    assert said["noticeable"]
    assert said["gain_nats"] > 5.0
    assert "rises with time" in " ".join(said["features"])
    term = said["form"]["terms"][0]
    assert (term["name"], term["unit"]) == ("time", "N/s")
    assert abs(term["coefficient"] - 2e-4) < 3.0 * term["standard_error"] + 3e-5
    assert said["form"]["sentence"] == remainder.form.sentence


def test_words_say_what_is_left_only_where_something_is(remainder: Remainder) -> None:
    fits = {
        "rmse": 1e-3,
        "rmse_held_out": None,
        "rmse_of_mean": 5e-3,
        "rmse_left_out": 4e-3,
        "full_model": {"rmse": 2.5e-3, "rmse_held_out": 3e-3, "fit_off_by": 4e-4, "runs": 2},
        "sampled": {"settled": True, "rhat": 1.37, "effective": 150.0},
    }
    answer = {
        "verdict": "unknown", "mechanisms": [], "located": [], "remaining": [], "candidates": [],
        "fit": {"before": fits, "after": fits}, "folder": "x", "unexplained": None, "unsure": [],
        "refuted": [],
        "unknown_probability": 0.974,
    }  # fmt: skip
    assert "outside this catalogue: probability at most 0.97" in in_words(answer)
    assert "unexplained" not in in_words(answer)
    assert "R-hat" not in in_words(answer)
    faint = in_words(
        {**answer, "verdict": "nothing-missing", "best_set": ["pre-stretch"], "set_probability": 0.9}
    )
    assert "With pre-stretch it would fit better" in faint
    assert "not to be relied on" in faint
    for alike in ({"verdict": "nothing-missing", "best_set": []}, {"verdict": "unknown", "best_set": ["x"]}):
        assert "would fit better" not in in_words({**answer, **alike, "set_probability": None})
    believed = in_words({**answer, "best_set": ["pad-slip", "backlash"], "set_probability": 0.034})
    assert "pad-slip, backlash: probability against something smooth without a name 0.03" in believed
    rough = {**fits, "sampled": {**fits["sampled"], "settled": False}}
    assert "R-hat of the draws 1.37" in in_words({**answer, "fit": {"before": rough, "after": fits}})
    assert "each phase by a fit without it: RMSE 4.0 mN" in in_words(answer)
    assert "without what the surrogate's own error takes up: 5.0 mN" in in_words(answer)
    said = "full model: RMSE 2.5 mN, 3.0 mN on what follows the second hold, not fitted; the surrogate's fit"
    assert f"{said} is off by 0.4 mN" in in_words(answer)
    said = unexplained(remainder)
    words = in_words({**answer, "unexplained": said})
    assert f"left unexplained: {1e3 * said['size_n']:.1f} mN RMS" in words
    assert said["form"]["sentence"] in words
    assert all(feature in words for feature in said["features"])
    nothing = in_words({**answer, "unexplained": {**said, "noticeable": False}})
    assert "nothing beyond noise" in nothing
    assert "mN RMS" not in nothing


# Figures


def headline(figure: Figure) -> str:
    return figure.get_suptitle().replace("\n", " ")


def test_each_figure_is_written_where_it_has_something_to_show(
    monkeypatch: pytest.MonkeyPatch, remainder: Remainder
) -> None:
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, made_by: (stem.with_suffix(".png"),))
    rows = [{"name": "force-offset", "delta_score": 3.0, "standard_error": 1.0}]
    written = []
    for parts, left in ((parts_of("force-offset"), remainder), ([], None)):
        found = Found(drawn(8e-3), drawn(2e-3), None, PARAMETERS, parts, left)
        written.append({path.name for path in draw(Path("x"), "", BINNED, toy.MOTION, found, rows)})
    assert written[0] - written[1] == {"contributions.png", "discrepancy.png"}
    assert {Path(name).stem for name in written[1]} == {
        "located", "candidates", "before_after", "residual_by_phase", "base_parameters"
    }  # fmt: skip


def test_a_fit_is_drawn_by_the_full_model_where_there_is_a_run() -> None:
    fit, begun, run = fitted("force-offset"), fitted(), np.full(len(BINNED.force_n), 0.25)
    full = FullFit({}, 0.0, run, 0.0 * run, 1, 0.0)
    taken = cast(TakenUp, SimpleNamespace(full=full, band_n=(run, run), located=None,
                                          draws=SimpleNamespace(summary={})))  # fmt: skip
    both = shown(fit, taken, begun, full)
    assert both.force_n is run
    assert both.held_out_n is run
    failed = cast(TakenUp, SimpleNamespace(**{**vars(taken), "full": "did not converge"}))
    neither = shown(fit, failed, begun, None)
    np.testing.assert_array_equal(neither.force_n, fit.force_n)
    np.testing.assert_array_equal(neither.held_out_n, begun.force_n)  # type: ignore[arg-type]
    assert shown(fit, taken, None, None).held_out_n is None


def test_before_and_after_have_their_band_and_what_was_not_fitted() -> None:
    before, after = drawn(8e-3, held_out_by=2e-2), drawn(2e-3, held_out_by=5e-3)
    figure = report.figure_before_after(BINNED, toy.MOTION, before, after, 60.0)
    assert headline(figure) == "RMS residual 8.0 mN before, 2.0 mN after"
    titles = {ax.get_title(loc="left")[-60:]: ax for ax in figure.axes}
    assert [title.split("  ")[-1] for title in titles][1:4:2] == [
        "in the 90 % bands: 0 → 100 % of bins", "fitted up to 60 s; beyond that 20.0 → 5.0 mN RMS"
    ]  # fmt: skip
    residual, left = figure.axes[1], figure.axes[3]
    (band,) = residual.collections[:1]
    edges = band.get_paths()[0].vertices[:, 1]  # type: ignore[index]
    np.testing.assert_allclose([edges.min(), edges.max()], [-3.0, 3.0], atol=1e-9)
    assert [line.get_xdata()[0] for line in left.get_lines() if line.get_linestyle() == "--"] == [60.0]  # type: ignore[index]
    whole = report.figure_before_after(BINNED, toy.MOTION, drawn(8e-3), drawn(2e-3), None)
    assert len(whole.axes) == 3


def test_the_base_s_parameters_that_leave_their_intervals_are_said() -> None:
    values = {p.name: {"mean": TRUTH[p.name], "interval90": [0.9 * TRUTH[p.name], 1.1 * TRUTH[p.name]]}
              for p in PARAMETERS}  # fmt: skip
    stays = report.figure_base_parameters(PARAMETERS, values, values)
    assert headline(stays) == "No parameter of the base leaves its interval"
    assert len(stays.axes) == len(PARAMETERS)
    far = {
        **values,
        "E_c": {"mean": 2.0 * TRUTH["E_c"], "interval90": [1.8 * TRUTH["E_c"], 2.2 * TRUTH["E_c"]]},
    }
    moves = report.figure_base_parameters(PARAMETERS, values, far)
    assert headline(moves).endswith("leaves its interval")
    before, after = (line.get_xdata() for line in moves.axes[0].get_lines()[::2])
    np.testing.assert_allclose(10.0 ** (np.array(after) - before), 2.0)  # a log-uniform prior


def test_residuals_by_phase_have_a_line_a_cycle_and_the_rms_of_their_kind() -> None:
    kinds = np.array([phase.kind for phase in BINNED.phases])[BINNED.phase]
    residual = np.where(kinds == "hold", 8e-3, 2e-3)
    before, after = located(residual, WINDOW), located(0.25 * residual)
    figure = report.figure_residual_by_phase(BINNED, toy.MOTION, before, after)
    assert headline(figure) == "Most is left in holds: 8.0 mN RMS before, 2.0 mN after"
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
    figure = report.figure_residual_by_phase(BINNED, toy.MOTION, part, part)
    assert [len(ax.get_lines()) for ax in figure.axes] == [2, 2, 2, 2]
    moving = dataclasses.replace(
        BINNED,
        phases=tuple(dataclasses.replace(p, kind="hold") if p.kind == "rest" else p for p in BINNED.phases),
    )
    panels = report.figure_residual_by_phase(moving, toy.MOTION, part, part).axes
    assert [ax.get_visible() for ax in panels] == [True, True, True, False]


def test_contributions_have_a_row_each_and_rounding_does_not_fill_one() -> None:
    parts = parts_of("device-friction", "force-offset", "friction-creep")
    parts.append(Contribution("pad-slip", (), np.full(len(BINNED.force_n), 1e-17)))
    figure = report.figure_contributions(BINNED, toy.MOTION, parts)
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
    search = Search({names: fitted(*names) for names in sets}, {("force-offset",): fitted("force-offset")})
    assert [row["name"] for row in candidates(search, known)] == ["device-friction"]
    needed = ("device-friction", "friction-creep")
    search.fits[needed] = fitted(*needed)
    assert {row["name"] for row in candidates(search, known)} == set(needed)


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
    assert headline(figure).endswith("viscous-drag alone gains most")
    rows[1] |= {"delta_score": 750.0}
    assert headline(report.figure_candidates(rows)).endswith("most, 1 other as much within the error")


def test_the_best_set_is_the_one_that_the_full_model_makes_it() -> None:
    found = tried({(): 0.0, ("x",): 90.0, ("y",): 70.0})

    def taken(weight: float | None) -> Any:
        return SimpleNamespace(full_weight=weight, full=None)

    before, after, rival = taken(5.0), taken(80.0), taken(95.0)
    likeliest = diagnosis._likeliest(found, before, after, found.rivals(None), [rival])
    assert likeliest is rival
    assert found.best.names == ("y",)
    found.full = {}
    assert diagnosis._likeliest(found, before, after, found.rivals(None), [taken(None)]) is after
    found.full = {}
    assert diagnosis._likeliest(found, before, taken(1.0), found.rivals(None), [taken(2.0)]) is before
    found.full = {}
    none = taken(None)
    assert diagnosis._likeliest(found, none, none, found.rivals(None), [none]) is none
    assert found.best.names == ("x",)


def test_a_set_that_the_full_model_cannot_run_goes_for_none_that_leaves_much() -> None:
    found = tried({(): 0.0, ("x",): 90.0, ("y",): 70.0})

    def taken(weight: float | None, left: str) -> Any:
        fit = found.base
        noise = [name for name in fit.log_posterior.names if name.startswith("sd_")]
        end = fit.log_posterior.bounds[left == "much"]
        widest = fit.log_posterior.named(fit.log_posterior.from_sampling(np.asarray(end)))
        theta = {**fit.theta, **{name: widest[name] for name in noise}}
        full = FullFit(theta, 0.0, fit.force_n, fit.force_n, 1, 0.0)
        return SimpleNamespace(full_weight=weight, full="the skin folds" if weight is None else full)

    rivals = [found.fits["y",]]
    for before, rival, best in (("much", "much", "x"), ("much", "little", "y"), ("little", "much", "")):
        found.full = {}
        without, failed, other = taken(5.0, before), taken(None, ""), taken(70.0, rival)
        after = diagnosis._likeliest(found, without, failed, rivals, [other])
        assert after is {"x": failed, "y": other, "": without}[best]
        assert "".join(found.best.names) == best
    found.full = {}
    runs = taken(60.0, "much")
    assert diagnosis._likeliest(found, taken(5.0, "much"), runs, rivals, [taken(70.0, "much")]) is not runs
