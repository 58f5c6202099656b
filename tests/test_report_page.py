"""The report of a run: one well-formed page that loads nothing, escapes all and says what is missing."""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from finished_run import HISTORY, INDICES, drawing, facts, summaries

from bayeskin.report.page import RunFacts, StageFacts, render_page
from bayeskin.report.page.answer import answer
from bayeskin.report.page.charts import history_chart, indices_chart, residual_chart
from bayeskin.report.page.figures import _KNOWN
from bayeskin.report.page.numbers import interval, number, quantity
from bayeskin.report.page.prose import prose
from bayeskin.report.page.svg import inline_svg
from bayeskin.workflow import folder, page, stages
from bayeskin.workflow.engine import CannotGoOn, Run, Silent, Stage

VOID = {"meta", "br", "img", "link", "input", "hr", "source"}
SECTIONS = ["answer", "recording", "fit", "posterior", "sobol", "mismatch", "checks", "provenance"]


class Walk(HTMLParser):
    """Walks a page: every element closed by its own end tag; gathers what tests ask for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))

    def values(self, attribute: str) -> list[str]:
        return [value for _, name, value in self.attributes if name == attribute]

    def text(self) -> str:
        seen = "".join(data for tag, data in self.texts if tag not in ("style", "script"))
        return re.sub(r"\s+", " ", seen)


@pytest.fixture(scope="module")
def whole() -> str:
    return render_page(facts())


def test_a_page_is_well_formed_and_its_ids_are_unique(whole: str) -> None:
    walk = Walk(whole)
    assert whole.startswith("<!DOCTYPE html>")
    assert [text for text, count in Counter(walk.values("id")).items() if count > 1] == []
    targets = [value[1:] for value in walk.values("href") + walk.values("xlink:href") if value[:1] == "#"]
    targets += [name for value in walk.values("aria-labelledby") for name in value.split()]
    targets += re.findall(r"url\(#([^)]+)\)", whole)
    assert len(targets) > 50
    assert set(targets) <= set(walk.values("id"))


def loads(walk: Walk) -> list[str]:
    """All that a browser would fetch."""
    fetched = [
        value
        for tag, name, value in walk.attributes
        if name in ("src", "srcset", "href", "xlink:href", "data", "action", "poster") and tag != "a"
    ]
    styles = [value for _, name, value in walk.attributes if name in ("style", "fill", "clip-path")]
    styles += [data for tag, data in walk.texts if tag == "style"]
    fetched += [url for style in styles for url in re.findall(r"url\(([^)]*)\)|@import", style)]
    return [one for one in fetched if not one.startswith(("#", "data:"))]


def test_a_page_loads_nothing(whole: str) -> None:
    assert loads(Walk(whole)) == []
    assert loads(Walk('<link href="https://a.b/c.css">')) == ["https://a.b/c.css"]
    assert "default-src 'none'" in whole
    links = [value for tag, name, value in Walk(whole).attributes if (tag, name) == ("a", "href")]
    assert links
    assert all(link.startswith("#") for link in links)


def test_every_section_figure_and_table_is_there(whole: str) -> None:
    walk = Walk(whole)
    ids = walk.values("id")
    assert [one for one in ids if one in SECTIONS] == SECTIONS
    assert {f"{stage}-{name}".replace("_", "-") for stage, name in _KNOWN} <= set(ids)
    assert walk.tags.count("table") >= 12
    assert walk.tags.count("caption") == walk.tags.count("table")
    drawn = re.findall(r'<div class="drawn wide" role="img" aria-label="([^"]*)"', whole)
    assert len(drawn) == len(_KNOWN)
    assert all(len(alt) > 20 for alt in drawn)
    for mode in ("prefers-color-scheme: dark", "@media print", "width=device-width"):
        assert mode in whole


def test_the_answer_comes_first_and_says_what_how_sure_and_what_is_missing(whole: str) -> None:
    text = Walk(whole).text()
    for said in (
        "What is this skin made of?", "50.8 kPa", "13.9 to 87 kPa", "informed, at the prior's lower bound",
        "How sure is that? trusted", "What is missing? named", "The slide rubs: 60 mN. (probability 0.98)",
        "Something smooth that is not in the catalogue: probability 0.07.",
        "RMSE 80 mN without, 24.7 mN with", "form a ridge",
    ):  # fmt: skip
        assert said in text, said
    assert text.index("What is missing?") < text.index("Phases of the recording")


def test_what_the_fit_leaves_stands_among_the_checks(whole: str) -> None:
    text = Walk(whole).text()
    said = "What the fit leaves looks like the assumed noise: in its law and all else."
    assert text.index("Sampling: trusted") < text.index(said) < text.index("The surrogate on runs held out")
    assert "rest400.970.80.060.7load4––––" in text.replace(" ", "")


def diagnosed_as(changed: dict[str, object]) -> str:
    """The page's text where the diagnosis said otherwise."""
    stages = facts().stages
    said = {**summaries()["diagnose"], **changed}
    stages = {**stages, "diagnose": dataclasses.replace(stages["diagnose"], summary=said)}
    return Walk(render_page(dataclasses.replace(facts(), stages=stages))).text()


def test_the_fit_and_its_check_by_the_full_model_are_said() -> None:
    text = diagnosed_as({})
    assert "RMSE 80 mN without, 24.7 mN with" in text
    assert "leaves 21.3 mN RMSE; the model that was fitted is off by 0.4 mN there" in text
    failed = diagnosed_as({"full_model": {"message": "the skin folds"}})
    assert "The full model fails at the best values: the skin folds" in failed


@pytest.mark.parametrize(
    ("verdict", "smooth", "word", "sentence"),
    [
        ("unknown", 0.9, "something that has no name here", "no mechanism is likely enough"),
        ("unknown", 0.1, "something that several causes would explain", "no mechanism is likely enough"),
        ("nothing-missing", 0.1, "nothing that could be named", "leaves nothing out"),
    ],
)
def test_what_is_missing_is_said_alike_in_a_word_and_a_sentence(
    verdict: str, smooth: float, word: str, sentence: str
) -> None:
    text = diagnosed_as(
        {"verdict": verdict, "best_set": ["pad-slip", "backlash"], "smooth_probability": smooth}
    )
    assert f"What is missing? {word}" in text
    assert ("Of the catalogue pad-slip, backlash fits best" in text) == (verdict == "unknown")
    faint = text.count("With pad-slip, backlash it would fit better")
    assert faint == (2 if verdict == "nothing-missing" else 0)
    assert sentence in text
    assert f"Something smooth that is not in the catalogue: probability {smooth}." in text


def test_nothing_is_missing_where_no_set_fits_better() -> None:
    text = diagnosed_as({"verdict": "nothing-missing", "best_set": []})
    assert "What is missing? nothing The recording stays" in text
    assert "would fit better" not in text


def test_the_table_of_parameters_has_prior_interval_unit_and_sentence(whole: str) -> None:
    text = Walk(whole).text()
    row = "p init initial interstitial pressure uniform, −0.261 to 4.04 kPa 0.842 −0.522 2.02 kPa 1.6"
    compact = re.sub(r"\s", "", text)
    assert re.sub(r"\s", "", row) + "thedatadoesnotinformit(posterior=prior)" in compact
    assert "thedatainformsitweakly" in compact
    assert "median 5.08e+04" not in text  # its numbers stand beside it, in a unit that reads well


def test_what_is_left_and_which_test_would_tell_stand_in_the_mismatch(whole: str) -> None:
    text = Walk(whole).text()
    for said in (
        "12.3 mN RMS beyond what parameters take up; it varies 75 % with displacement, 25 % with phase.",
        "it grows while loading",
        "0.7 of it follows u^3 while loading",
        "u^2 while loading",
        "Taken as equally probable: device-friction; or viscous-drag.",
        "quarter speed The same at a quarter of the speed. 187 s 0.95 0.01 97 %",
    ):
        assert re.sub(r"\s", "", said) in re.sub(r"\s", "", text), said
    assert "Nothing beyond the noise" in diagnosed_as(
        {"unexplained": {**summaries()["diagnose"]["unexplained"], "noticeable": False}}
    )
    nothing = diagnosed_as({"unexplained": None})
    assert "beyond what parameters take up; it varies" not in nothing
    stages = {name: one for name, one in facts().stages.items() if name != "experiment"}
    unasked = Walk(render_page(dataclasses.replace(facts(), stages=stages))).text()
    assert "Which further test" not in unasked


HOSTILE = '<script>alert("1")</script>&\'"<img src=x onerror=alert(2)>'


def test_what_comes_from_a_recording_or_a_configuration_is_escaped() -> None:
    said = summaries()
    run = facts(config_text=HOSTILE, config_path=HOSTILE, mesh=HOSTILE, parameters={"E_c": HOSTILE})
    recording = {**said["recording"], "name": HOSTILE, "notes": [HOSTILE]}
    recording["phases"] = [{**said["recording"]["phases"][0], "kind": HOSTILE}]
    failed = {"ok": False, "message": HOSTILE}
    changed = {
        **run.stages,
        "recording": dataclasses.replace(run.stages["recording"], summary=recording),
        "design": StageFacts("design", "failed", 1.0, failed),
    }
    text = render_page(dataclasses.replace(run, stages=changed, name=HOSTILE))
    assert "<script>alert" not in text
    assert "<img" not in text
    assert Walk(text).tags.count("script") == Walk(render_page(facts())).tags.count("script")
    assert Walk(text).text().count('alert("1")') >= 6


def test_figures_of_one_page_keep_their_parts_apart() -> None:
    first, second = (inline_svg(drawing("one"), prefix) for prefix in ("a", "b"))
    ids = [set(re.findall(r'\bid="([^"]+)"', text)) for text in (first, second)]
    assert ids[0] & ids[1] == set()
    for text, own in zip((first, second), ids, strict=True):
        used = re.findall(r'href="#([^"]+)"', text) + re.findall(r"url\(#([^)]+)\)", text)
        assert len(used) > 5
        assert set(used) <= own
    assert "#a *{" in first  # its style rules stay inside
    assert "metadata" not in first
    assert "<?xml" not in first


def test_a_figure_that_would_run_or_fetch_something_does_not() -> None:
    svg = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" onload="run()">'
        "<style>@import 'http://a.b/c.css'; g{fill:url(http://a.b/d.svg)}</style><script>run()</script>"
        '<image href="http://a.b/e.png"/><use xlink:href="//a.b/f.svg#g"/><path style="fill: url(//a.b/h)"/>'
        '<image href="data:image/png;base64,AA=="/><text>a<tspan>b</tspan> c</text></svg>'
    )
    safe = inline_svg(svg, "p")
    assert "a.b" not in safe
    assert "run()" not in safe
    assert "data:image/png;base64,AA==" in safe
    assert "</tspan> c" in safe


SVG = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


@pytest.mark.parametrize(
    "inside",
    [
        '<script xmlns="">run()</script>',
        "<SCRIPT>run()</SCRIPT>",
        '<foreignObject><iframe xmlns="http://www.w3.org/1999/xhtml" srcdoc="run()"/></foreignObject>',
        '<a><set attributeName="href" to="javascript:run()"/></a>',
        '<animate attributeName="href" values="javascript:run()"/>',
        '<h:script xmlns:h="http://www.w3.org/1999/xhtml">run()</h:script>',
    ],
)
def test_only_what_figures_are_drawn_with_stays(inside: str) -> None:
    safe = inline_svg(f'<svg {SVG}><g>{inside}<path d="M0 0"/></g></svg>', "p")
    assert "run()" not in safe
    assert "<path" in safe
    assert "sha256-" in render_page(facts())
    assert "script-src 'unsafe-inline'" not in render_page(facts())


def test_what_is_no_svg_is_a_damaged_figure() -> None:
    run = facts()
    bare = dataclasses.replace(
        run.stages["recording"], figures={"recording": "<svg><script>run()</script></svg>"}
    )
    text = render_page(dataclasses.replace(run, stages={**run.stages, "recording": bare}))
    assert "Its file is damaged" in text
    assert "run()" not in text


def test_a_damaged_figure_is_named_and_the_rest_of_the_page_stands() -> None:
    run = facts()
    cut = dataclasses.replace(run.stages["recording"], figures={"recording": "<svg><g>"})
    text = render_page(dataclasses.replace(run, stages={**run.stages, "recording": cut}))
    assert "Its file is damaged" in text
    Walk(text)


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
        "0.75 s, load of cycle 1: −10.0 mN left; 90 % band −20.0 mN to 20.0 mN",
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
        ("E_c is 5.11e+04 Pa", "<i>E</i><sub>c</sub> is 51.1 kPa"),
        ("sd_hold (correlation -1.00)", "<i>σ</i><sub>hold</sub> (correlation −1.00)"),
        ("is 1.33e-16 to 5.56e-12 m^2.", "is 1.33 × 10⁻¹⁶ to 5.56 × 10⁻¹² m²."),
        ("-670 to 2.14e+03 Pa", "−0.67 to 2.14 kPa"),
        ("1.3 mN in 60.25 s, 2026-11-23", "1.3 mN in 60.25 s, 2026-11-23"),
        ("see runs/x_one.toml & <b>", "see runs/x_one.toml &amp; &lt;b&gt;"),
    ],
)
def test_sentences_are_printed_with_symbols_and_units_that_read_well(said: str, printed: str) -> None:
    assert str(prose(said)).replace("\u00a0", " ") == printed


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
    assert quantity(value, unit).replace("\u00a0", " ") == text


def test_an_interval_has_one_unit_unless_its_ends_are_far_apart() -> None:
    assert interval(13.9e3, 87e3, "Pa") == "13.9 to 87\u00a0kPa"
    assert interval(1e4, 2e6, "Pa") == "10\u00a0kPa to 2\u00a0MPa"
    assert interval(-670.0, 2144.0, "Pa") == "−0.67 to 2.14\u00a0kPa"
    assert number(float("nan")) == "–"


def only(run: RunFacts, **standing: str) -> RunFacts:
    stages = {name: StageFacts(name, standing.get(name, "not run")) for name in run.stages}
    done = {name: one for name, one in run.stages.items() if name in standing and standing[name] == "done"}
    return dataclasses.replace(run, stages={**stages, **done}, history=None)


def test_a_page_says_plainly_what_is_not_finished() -> None:
    text = Walk(render_page(only(facts(), recording="done", map="not finished", design="out of date"))).text()
    for said in (
        "The posterior has not been sampled", "The stage sample has not been run.",
        "bayeskin sobol runs/forearm.toml",
        "The stage map was begun and is not finished.", "The stage design is out of date",
        "Nobody has looked yet: the stage diagnose is not run.", "Phases of the recording",
    ):  # fmt: skip
        assert said in text, said
    assert "trusted" not in text.replace("to trust or not to trust", "")


def test_a_posterior_that_is_not_trusted_says_so_and_why_at_the_top() -> None:
    run = facts()
    doubted = {
        **run.stages["sample"].summary,
        "ok": False,
        "verdict": "not trusted",
        "reasons": ["12 lengths of 50"],
    }
    checks = [{**run.stages["map"].summary["checks"][0], "passes": False, "message": "off by 9 mN"}]
    for stage, summary in (("sample", doubted), ("map", {**run.stages["map"].summary, "checks": checks})):
        changed = dataclasses.replace(run.stages[stage], summary=summary)
        sure = answer(dataclasses.replace(run, stages={**run.stages, stage: changed})).sure
        assert (sure.word, sure.tone) == ("not trusted", "doubt")
        assert sure.lines[0] in ("12 lengths of 50", "off by 9 mN")


CONFIG = 'seed = {seed}\n[recording]\nfile = "r.csv"\n'


def stubs(fails: str = "") -> dict[str, Stage]:
    """The stages by name and need, each of which writes its figures and says what a finished run's would."""

    def working(name: str) -> Any:
        def work(run: Run) -> dict[str, Any]:
            if name == fails:
                raise CannotGoOn("too few runs; narrow the prior box")
            for of, figure in _KNOWN:
                if of == name:
                    run.at(name, f"{figure}.svg").write_text(drawing(figure))
            if name == "sample":
                folder.write_json(run.at(name, "bands.json"), HISTORY)
            return summaries().get(name, {})

        return work

    return {
        name: Stage(name, "does", stage.needs, ("seed",), stage.work if name == "report" else working(name))
        for name, stage in stages.STAGES.items()
    }


def configured(where: Path, seed: int = 1) -> Path:
    (where / "r.csv").write_text("as measured")
    (where / "case.toml").write_text(CONFIG.format(seed=seed))
    return where / "case.toml"


def test_a_run_ends_with_its_page_and_report_makes_it_again(tmp_path: Path) -> None:
    config = configured(tmp_path)
    said = stages.run(config, None, Silent(), stubs())
    path = tmp_path / "case" / page.FILE
    assert said["page"] == str(path)
    first = path.read_bytes()
    assert b'id="sample-posterior"' in first
    path.unlink()
    again = stages.report(config, Silent(), stubs())
    assert (again["ok"], again["page"]) == (True, str(path))
    assert path.read_bytes() == first


def test_report_runs_nothing_and_names_what_is_missing(tmp_path: Path) -> None:
    config = configured(tmp_path)
    said = stages.report(config, Silent(), stubs())
    assert (said["ok"], said["verdict"]) == (True, "not finished")
    assert said["missing"] == ["recording", "design", "train", "map", "sample", "sobol"]
    assert [path.name for path in (tmp_path / "case").iterdir()] == [page.FILE]
    stages.run(config, "train", Silent(), stubs())
    assert stages.report(config, Silent(), stubs())["missing"] == ["map", "sample", "sobol"]
    assert "Phases of the recording" in (tmp_path / "case" / page.FILE).read_text()


def test_a_changed_configuration_puts_what_was_made_before_it_out_of_date(tmp_path: Path) -> None:
    stages.run(configured(tmp_path), None, Silent(), stubs())
    text = stages.report(configured(tmp_path, seed=2), Silent(), stubs())["text"]
    assert "sample: out of date" in text
    shown = (tmp_path / "case" / page.FILE).read_text()
    assert "out of date" in shown
    assert "50.8" not in shown  # nothing of the other configuration's answer


def test_a_run_that_fails_leaves_a_page_that_says_where(tmp_path: Path) -> None:
    said = stages.run(configured(tmp_path), None, Silent(), stubs(fails="train"))
    assert said["ok"] is False
    shown = (tmp_path / "case" / page.FILE).read_text()
    assert "The stage train failed: too few runs; narrow the prior box." in shown
    assert stages.report(tmp_path / "case.toml", Silent(), stubs(fails="train"))["ok"] is False


def test_a_run_sampled_before_there_were_bands_has_a_page_without_the_chart(tmp_path: Path) -> None:
    config = configured(tmp_path)
    old = stubs()
    write = old["sample"].work

    def without_bands(run: Run) -> Any:
        summary = write(run)
        run.at("sample", "bands.json").unlink()
        return summary

    old["sample"] = dataclasses.replace(old["sample"], work=without_bands)
    stages.run(config, None, Silent(), old)
    shown = (tmp_path / "case" / page.FILE).read_text()
    assert 'id="history"' not in shown
    assert 'id="sample-fit"' in shown
