"""Charts, sentences and numbers of the report's page."""

from __future__ import annotations

import json
import re

import pytest
from toys.finished_run import FORCES, HISTORY, INDICES, facts, summaries

from bayeskin.number_format import interval, number, quantity
from bayeskin.report.page import StageFacts
from bayeskin.report.page.charts import history_chart, indices_chart, residual_chart
from bayeskin.report.page.overview import overview_charts
from bayeskin.report.page.parts import Chart
from bayeskin.report.page.prose import prose

PHASES = summaries()["recording"]["phases"]


def test_under_the_cross_hair_stands_what_the_stage_says() -> None:
    chart = history_chart(HISTORY, PHASES)
    assert chart.data["says"][1:3] == [
        "0.75 s, load of cycle 1: recorded 100.0 mN; predicted 110.0 mN, 90 % band 90.0 mN to 130.0 mN",
        "1.25 s, load of cycle 1: nothing recorded (not fitted); predicted 200.0 mN, "
        "90 % band 180.0 mN to 220.0 mN",
    ]
    x, (y,) = chart.data["x"], chart.data["dots"]
    assert x == sorted(x)
    assert y == sorted(y, reverse=True)  # more force stands higher
    assert (x[0], x[-1]) == (54.0, 750.0)
    assert chart.svg.count("M") > 3
    assert "nan" not in chart.svg
    json.dumps(chart.data, allow_nan=False)


def test_what_the_fit_leaves_can_be_read() -> None:
    chart = residual_chart(HISTORY, PHASES)
    assert chart.data["says"][1:3] == [
        "0.75 s, load of cycle 1: residual −10.0 mN; 90 % band −20.0 mN to 20.0 mN",
        "1.25 s, load of cycle 1: nothing recorded (not fitted); 90 % band −20.0 mN to 20.0 mN",
    ]
    zero, below, none, above = chart.data["dots"][0]
    assert below > zero > above
    assert none is None
    assert "nan" not in chart.svg


def test_sobol_indices_over_time_can_be_read() -> None:
    chart = indices_chart("key", "over the prior", INDICES, PHASES)
    assert chart.data["says"][::3] == [
        "0.25 s, load of cycle 1: the force does not vary",
        "1.75 s, load of cycle 1: first order (total): E_c 0.60 (0.65), p_init 0.00 (0.05)",
    ]
    leading, other = chart.data["dots"]
    assert leading[0] is None
    assert all(high < low for high, low in zip(leading[1:], other[1:], strict=True))
    assert [key.text for key in chart.keys] == ["E_c", "p_init", "total, with all interactions"]
    assert len({key.color for key in chart.keys}) == 3
    assert "nan" not in chart.svg


@pytest.mark.parametrize(
    ("said", "printed"),
    [
        ("E_c is 51.1 kPa", "<i>E</i><sub>c</sub> is 51.1 kPa"),
        ("sd_hold (correlation −1)", "<i>σ</i><sub>hold</sub> (correlation −1)"),
        ("-5e+04 Pa in 60.25 s, 2026-11-23", "-5e+04 Pa in 60.25 s, 2026-11-23"),
        ("see runs/x_one.toml & <b>", "see runs/x_one.toml &amp; &lt;b&gt;"),
        ("`run E_c <b>` finds E_c", "<code>run E_c &lt;b&gt;</code> finds <i>E</i><sub>c</sub>"),
        ("a ` alone", "a ` alone"),
    ],
)
def test_names_in_sentences_are_symbols_and_commands_are_code(said: str, printed: str) -> None:
    assert str(prose(said)) == printed


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (50830.0, "Pa", "50.8 kPa"), (2e6, "Pa", "2 MPa"), (745.0, "Pa", "745 Pa"),
        (-0.0253, "N", "−25.3 mN"),
        (1.234, "N", "1.23 N"), (0.0094, "m", "9.4 mm"), (1.64e-14, "m^2", "1.64 × 10⁻¹⁴ m²"),
        (13.29, "s", "13.3 s"), (None, "N", "–"),
        (0.0, "1", "0"), (99.96, "1", "100"), (1.2e6, "1", "1.2 × 10⁶"),
    ],
)  # fmt: skip
def test_numbers_read_well(value: float | None, unit: str, text: str) -> None:
    assert quantity(value, unit) == text


def test_an_interval_has_one_unit_unless_its_ends_are_far_apart() -> None:
    assert interval(13.9e3, 87e3, "Pa") == "13.9 to 87 kPa"
    assert interval(1e4, 2e6, "Pa") == "10 kPa to 2 MPa"
    assert interval(-670.0, 2144.0, "Pa") == "−0.67 to 2.14 kPa"
    assert number(float("nan")) == "–"


def overview(**changed: object) -> list[Chart]:
    return overview_charts(facts(forces=[{**FORCES[0], **changed}]))


def test_the_first_figure_of_a_diagnosis_is_drawn_for_two_widths_and_marks_the_mismatch() -> None:
    wide, narrow = overview()
    assert (wide.screen, narrow.screen) == ("wide", "narrow")
    assert 'viewBox="0 0 380 ' in narrow.svg
    for chart in (wide, narrow):
        assert chart.svg.count('class="window"') == 2  # of the force and of the residual
        assert chart.data["says"][1] == (
            "0.75 s, load of cycle 1: recorded 100 mN; model before 180 mN, after 110 mN"
        )
        before, after, left_before, left_after = chart.data["dots"]
        assert before[1] < after[1]  # more force stands higher
        assert left_before[1] > left_after[1]  # and a recording below the model lower
        assert max(before) < min(y for y in left_before if y is not None)
        assert "at most 80 mN before and 10 mN after. Marked: 0.5 to 1.5 s." in chart.alt
        assert "nan" not in chart.svg
        json.dumps(chart.data, allow_nan=False)


def test_a_smaller_mismatch_is_marked_fainter_and_none_is_not_in_the_legend() -> None:
    first = FORCES[0]["windows"][0]
    both = overview(windows=[first, {"start_s": 1.5, "end_s": 1.75, "mean_n": 0.02}])[0]
    assert re.findall(r'class="window"[^>]*fill-opacity="([\d.]+)"', both.svg) == ["0.44", "0.44"]
    assert [key.mark for key in both.keys][-1] == "window"
    none = overview(windows=[])[0]
    assert [key.mark for key in none.keys] == ["dots", "before", "line"]
    assert none.alt.endswith("No window is marked.")


def test_of_several_recordings_the_one_with_the_largest_mismatch_is_shown() -> None:
    small = {**FORCES[0], "name": "first", "windows": [{"start_s": 0.0, "end_s": 1.0, "mean_n": 0.02}]}
    large = {**FORCES[0], "name": "second"}
    recording = {**summaries()["recording"], "recordings": [{"phases": ()}, {"phases": PHASES}]}
    stages = {**facts().stages, "recording": StageFacts("recording", "done", 1.0, recording)}
    chart = overview_charts(facts(forces=[small, large], stages=stages))[0]
    assert chart.title.endswith("(recording second)")
    assert chart.data["says"][0].startswith("0.25 s, load of cycle 1: ")
    assert overview_charts(facts(forces=[])) == []
