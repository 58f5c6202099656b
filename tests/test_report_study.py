"""The page of a study: what it says of a made-up population, and how it looks in a browser."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from toys import made_up_population as made_up
from toys.browser import Browser

from bayeskin import report
from bayeskin.report.page import StudyFacts, render_study
from bayeskin.report.save import figure_bytes
from bayeskin.study import Population
from bayeskin.study.result import Spread
from bayeskin.workflow.study_answer import population_in_json

PERMEABILITY = {
    "parameter": made_up.PERMEABILITY,
    "medians": {"control": made_up.about(2e-14), "<keloid>": made_up.about(3e-14)},
    "informative": 3, "within": Spread(made_up.about(0.1, 8.0)), "at_lower": 5,
}  # fmt: skip
GROUPS = ("control", "<keloid>")
ORIGIN = {
    "name": "keloids",
    "version": "0.1.0",
    "seed": 1,
    "config_sha256": "c" * 64,
    "table_sha256": "t" * 64,
}


def population(**further: Any) -> Population:
    return made_up.population(made_up.table(groups=GROUPS), {}, PERMEABILITY, **further)


def facts(result: Population, left_out: Mapping[str, str] | None = None, **changed: Any) -> StudyFacts:
    left_out = left_out or {}
    answer = population_in_json(result)
    rows = [
        {
            "name": known["name"], "subject": known["subject"], "group": known["group"], "site": None,
            "session": None, "recording": f"{known['name']}.h5", "sha256": "r" * 64, "model_hash": "m" * 64,
            "report": f"recordings/{known['name']}/report.html", "left_out": None,
            "given_the_study": known["given_the_study"],
        }
        for known in answer["recordings"]
    ]  # fmt: skip
    rows += [
        {**rows[0], "name": name, "report": None, "left_out": reason} for name, reason in left_out.items()
    ]
    for row in rows[len(rows) - len(left_out) :]:
        del row["given_the_study"]
    figures = {
        "population": figure_bytes(report.figure_population(result), "svg", "").decode(),
        "recordings": figure_bytes(report.figure_recordings(result), "svg", "").decode(),
    }
    return StudyFacts(
        "keloids.toml", 'table = "t.csv"', "t.csv", "recording,subject\n",
        {**ORIGIN, **answer, "recordings": rows, "left_out": dict(left_out), **changed}, figures,
    )  # fmt: skip


def words(page: str) -> str:
    """The text of a page without its tags."""
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", page)).split())


def test_the_answer_is_a_figure_and_three_sentences() -> None:
    page = render_study(facts(population()))
    answer = page[page.index('<section id="answer"') : page.index('<section id="groups"')]
    assert answer.count("<figure>") == 1
    assert len(re.findall(r"<p>(.*?)</p>", answer)) == 3
    said = words(answer)
    assert "What does this study show? trusted" in said
    assert "is stiffer than group control with probability 0.97, by a factor of 1.8 [1.3, 2.5]." in said
    assert "All 12 recordings enter." in said


def test_texts_of_the_table_are_escaped() -> None:
    page = render_study(facts(population(), {"x<script>": "its <b>file</b> is damaged"}))
    assert "x<script>" not in page
    assert "<keloid>" not in page
    assert "its <b>file</b>" not in page
    assert "x<script>: its <b>file</b> is damaged" in words(page)


def test_tables_state_medians_ratios_and_variation() -> None:
    said = words(render_study(facts(population())))
    assert "E c 100 [77, 130] kPa 200 [150, 260] kPa" in said
    assert "<keloid> / control 1.8 [1.3, 2.5] 0.97" in said
    assert "below 95 % 3 of 12 5 on the lower" in said


def test_only_a_recording_with_a_report_is_a_link() -> None:
    page = render_study(facts(population(), {"broken": "no such file"}))
    assert page.count('<a href="recordings/') == 12
    assert '<a href="recordings/s0-0/report.html">s0-0</a>' in page
    assert '<th scope="row">broken</th>' in page
    assert "12 of 13 recordings enter; 1 is left out" in words(page)


def test_a_study_without_a_population_says_why() -> None:
    known = facts(population(), {"broken": "no such file"})
    answer = {
        **ORIGIN, "ok": False, "verdict": "no population", "because": ["one subject is left"],
        "recordings": known.answer["recordings"], "left_out": known.answer["left_out"],
    }  # fmt: skip
    said = words(render_study(StudyFacts("k.toml", "", "t.csv", "", answer, {})))
    assert "no population No population: one subject is left." in said
    assert "broken: no such file" in said
    assert "Variation" not in said


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "light"), (1280, "dark")])
def test_the_page_fits_its_width_and_a_browser_has_nothing_to_complain_of(
    shown: Browser, tmp_path: Path, width: int, scheme: str
) -> None:
    page = tmp_path / "study.html"
    page.write_text(render_study(facts(population(), {"broken": "no such file"})))
    shown.open(page, width, scheme)
    assert shown.ask("document.documentElement.scrollWidth") <= width
    heights = shown.ask("[...document.querySelectorAll('figure svg')].map((s) => s.clientHeight)")
    assert len(heights) == 2
    assert min(heights) > 50
    assert shown.complaints == []
