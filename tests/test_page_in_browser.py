"""The page of a run in a browser: no complaint, tables sort, figures enlarge, charts are read."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
from toys.browser import Browser
from toys.finished_run import facts, summaries

from bayeskin.report.page import render_page
from bayeskin.report.page.figures import FIGURES

CHARTS = ["overview-wide", "history", "residual", "indices-prior-gp"]
SHOWN = "[...document.querySelectorAll('figure')].filter((f) => getComputedStyle(f).display !== 'none')"
UNFOLD = "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
SCROLLED_WIDTH = "document.documentElement.scrollWidth"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(render_page(facts()))
    return path


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "light"), (1280, "dark")])
def test_the_page_fits_its_width_and_a_browser_has_nothing_to_complain_of(
    shown: Browser, page: Path, width: int, scheme: str
) -> None:
    shown.open(page, width, scheme)
    assert shown.ask("innerWidth") == width
    assert shown.ask(SCROLLED_WIDTH) <= width
    drawn = shown.ask(f"{SHOWN}.map((f) => f.querySelector('svg')).map((s) => [s.id, s.clientHeight])")
    assert drawn[0][0] == ("overview-narrow" if width == 390 else "overview-wide")
    assert len(drawn) == len(FIGURES) + len(CHARTS)
    assert [key for key, height in drawn if height < 50] == []
    ink, paper = (
        sum(map(int, re.findall(r"\d+", shown.ask(f"getComputedStyle(document.body).{name}"))))
        for name in ("color", "backgroundColor")
    )
    assert (ink < paper) == (scheme == "light")
    shown.ask(UNFOLD)
    assert shown.ask(SCROLLED_WIDTH) <= width
    assert shown.complaints == []


def test_what_a_browser_complains_of_is_heard(shown: Browser, page: Path) -> None:
    wrong = page.with_name("wrong.html")
    extra = '<script>document.title = "run";</script><img src="https://a.b/c.png" alt="">'
    wrong.write_text(page.read_text().replace("</body>", f"{extra}</body>"))
    shown.open(wrong, 1280)
    assert shown.ask("document.title") != "run"  # no script but the page's own is run
    shown.ask("console.error('said'); setTimeout(() => absent())")
    shown.ask("new Promise((done) => setTimeout(done, 50))")
    told = " ".join(shown.complaints)
    parts = ("absent is not defined", "'said'", "img-src", "script-src")
    assert [part for part in parts if part not in told] == []


def test_tables_sort(shown: Browser, page: Path) -> None:
    shown.open(page, 1280)
    shown.ask(UNFOLD)
    heading = "#recording table thead th:nth-child(8)"
    spikes = "[...document.querySelectorAll('#recording tbody td:nth-child(8)')].map((c) => c.textContent)"
    for order, rows in (("ascending", ["3", "20"]), ("descending", ["20", "3"])):
        shown.click(f"{heading} button")
        assert shown.ask(spikes) == rows
        assert shown.ask(f"document.querySelector('{heading}').getAttribute('aria-sort')") == order


@pytest.mark.parametrize("chart", CHARTS)
def test_a_chart_is_read_by_pointer_and_keys_where_it_stands_and_enlarged(
    shown: Browser, page: Path, chart: str
) -> None:
    shown.open(page, 1280)
    read_out = f"document.getElementById('{chart}').closest('.chart').querySelector('.read-out').textContent"
    shown.point(f"#{chart}", 0.5)  # a little nearer to the second of four bins than to the third
    assert shown.ask(read_out).startswith("0.75 s, load of cycle 1: ")
    shown.ask(f"document.getElementById('{chart}').focus()")
    shown.press("ArrowRight")
    assert shown.ask(read_out).startswith("1.25 s, load of cycle 1: ")
    shown.click(f"figure:has(#{chart}) .enlarge")
    assert shown.ask("document.querySelector('dialog[open] svg').id") == chart
    shown.point(f"#{chart}", 0.98)
    assert shown.ask(read_out).startswith("1.75 s, load of cycle 1: ")


def test_every_figure_is_enlarged_and_comes_back(shown: Browser, page: Path) -> None:
    shown.open(page, 1280)
    said = shown.ask(
        """(async () => {
      const told = [];
      const large = document.getElementById("large");
      for (const figure of SHOWN) {
        const svg = figure.querySelector("svg");
        const before = svg.clientWidth;
        figure.querySelector(".enlarge").click();
        const wider = large.open && large.contains(svg) && svg.clientWidth > before;
        const closed = new Promise((done) => large.addEventListener("close", done, { once: true }));
        large.close();
        await closed;
        told.push([svg.id, wider, figure.firstElementChild.contains(svg)]);
      }
      return told;
    })()""".replace("SHOWN", SHOWN)
    )
    assert len(said) == len(FIGURES) + len(CHARTS)
    assert [key for key, wider, back in said if not (wider and back)] == []


def test_paper_shows_what_is_folded_and_nothing_to_click(shown: Browser, page: Path) -> None:
    shown.open(page, 1280, "dark")
    opened = "JSON.stringify([...document.querySelectorAll('details')].map((d) => d.open))"
    shown.ask(f"addEventListener('beforeprint', () => {{ document.body.dataset.opened = {opened}; }})")
    assert shown.paper().startswith(b"%PDF")
    assert set(json.loads(shown.ask("document.body.dataset.opened"))) == {True}
    assert not any(json.loads(shown.ask(opened)))  # on the screen as before
    shown.look(700, "dark", "print")
    seen = "[...document.querySelectorAll('header, .enlarge, .read-out')].map((e) => e.clientHeight)"
    assert set(shown.ask(seen)) == {0}
    assert shown.ask("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert shown.ask(SCROLLED_WIDTH) <= 700
    assert shown.complaints == []


def long_answer() -> dict[str, Any]:
    """A diagnosis whose three sentences are as long as those of real recordings."""
    said = summaries()["diagnose"]
    window = said["located"][0]
    kinds = ("rest", "load", "hold", "unload")
    windows = [{**window, "phase": kind, "cycle": 3, "t0": 208.0, "t1": 214.0} for kind in kinds]
    statement = (
        "The load cell is not linear: at 1 N it reads 22 % too much, and this percentage grows in proportion "
        "to the force."
    )
    mechanism = {**said["mechanisms"][0], "name": "cell-nonlinearity", "statement": statement}
    fit = {when: {key: value for key, value in fit.items() if key != "on_skin"} | {"rmse_held_out": 0.017}
           for when, fit in said["fit"].items()}  # fmt: skip
    sets = [
        {"mechanisms": ["cell-nonlinearity", "pre-stretch"], "probability": 0.55},
        {"mechanisms": ["cell-nonlinearity", "fibre-anisotropy"], "probability": 0.45},
    ]
    best = sets[0]["mechanisms"]
    return {**said, "located": windows, "mechanisms": [mechanism], "fit": fit, "sets": sets, "best_set": best,
            "held_out_set": ["cell-nonlinearity"]}  # fmt: skip


def test_the_first_screen_holds_the_verdict_the_figure_and_three_sentences(
    shown: Browser, tmp_path: Path
) -> None:
    run = facts()
    stages = {"recording": run.stages["recording"],
              "diagnose": dataclasses.replace(run.stages["diagnose"], summary=long_answer())}  # fmt: skip
    page = tmp_path / "page.html"
    page.write_text(render_page(dataclasses.replace(run, stages=stages, history=None, indices={})))
    for width, height, least in ((1280, 800, 300), (390, 844, 200)):
        shown.open(page, width)
        figure = shown.ask(f"{SHOWN}[0].querySelector('svg').clientHeight")
        assert figure >= least
        assert shown.ask("document.querySelector('.conclusion').getBoundingClientRect().bottom") < height
        assert shown.ask("document.querySelectorAll('.conclusion p').length") == 3
