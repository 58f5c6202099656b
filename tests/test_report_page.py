"""The report of a run: one well-formed page that loads nothing, escapes all and says what is missing."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest
from toys.finished_run import facts, summaries
from toys.html_walk import Walk

from bayeskin.report.conclusion import conclusion_of
from bayeskin.report.page import RunFacts, StageFacts, render_page
from bayeskin.report.page.answer import answer
from bayeskin.report.page.figures import FIGURES, pictures

SECTIONS = ["answer", "mismatch", "recording", "fit", "posterior", "sobol", "checks", "provenance"]


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
    return [address for address in fetched if not address.startswith(("#", "data:"))]


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
    assert [anchor for anchor in ids if anchor in SECTIONS] == SECTIONS
    assert {f"{stage}-{name}".replace("_", "-") for stage, name in FIGURES} <= set(ids)
    assert walk.tags.count("table") >= 12
    assert walk.tags.count("caption") == walk.tags.count("table")
    drawn = re.findall(r'<div class="drawn wide" role="img" aria-label="([^"]*)"', whole)
    assert len(drawn) == len(FIGURES)
    assert all(len(alt) > 20 for alt in drawn)
    for mode in ("prefers-color-scheme: dark", "@media print", "width=device-width"):
        assert mode in whole


def test_a_diagnosis_s_page_begins_with_its_verdict_one_figure_and_three_sentences(whole: str) -> None:
    conclusion = conclusion_of(summaries()["diagnose"], summaries()["experiment"])
    start = whole[whole.index("<h1") : whole.index('<div class="conclusion">')]
    assert f'<h1 id="question">{conclusion.verdict}</h1>' in start
    assert re.findall(r'<figure class="(\w+)-screen">', start) == ["wide", "narrow"]
    assert start.count("<figure") == 2
    first = whole[whole.index('<div class="conclusion">') :]
    assert re.findall(r"<p>(.*?)</p>", first[: first.index("</div>")]) == list(conclusion.sentences)
    assert whole.count("<h1") == 1
    assert re.sub(r"<[^>]*>", "", first)[:900].index("What is this skin made of?") > 0


def test_a_calibration_follows_the_diagnosis_and_begins_the_page_without_one(whole: str) -> None:
    text = Walk(whole).text()
    for said in (
        "What is this skin made of?", "50.8 kPa", "13.9 to 87 kPa", "informed, at the prior's lower bound",
        "How sure is that? trusted", "form a ridge",
    ):  # fmt: skip
        assert said in text, said
    assert "What is missing?" not in text
    stages = {name: stage for name, stage in facts().stages.items() if name != "diagnose"}
    alone = render_page(dataclasses.replace(facts(), stages=stages, forces=()))
    assert '<h1 id="question">What is this skin made of?</h1>' in alone
    assert "What is missing? not known yet" in Walk(alone).text()
    assert '<div class="conclusion">' not in alone


def test_a_diagnosis_alone_has_no_sections_on_a_calibration() -> None:
    run = facts(config_text="")
    stages = {name: stage for name, stage in run.stages.items() if name in ("recording", "diagnose")}
    page = render_page(dataclasses.replace(run, stages=stages, history=None, indices={}))
    assert [anchor for anchor in Walk(page).values("id") if anchor in SECTIONS] == [
        "answer", "mismatch", "recording", "provenance"
    ]  # fmt: skip
    text = Walk(page).text()
    assert "has not been run" not in text
    assert "What is this skin made of?" not in text
    assert "The configuration file" not in text


def test_what_the_fit_leaves_stands_among_the_checks(whole: str) -> None:
    text = Walk(whole).text()
    said = "The residual looks like the assumed noise: in its distribution and all else."
    assert text.index("Sampling: trusted") < text.index(said) < text.index("The surrogate on held-out runs")
    assert "rest400.970.80.060.7load4––––" in text.replace(" ", "")


def diagnosed_as(changed: dict[str, object]) -> str:
    """The page's text where the diagnosis said otherwise."""
    stages = facts().stages
    said = {**summaries()["diagnose"], **changed}
    stages = {**stages, "diagnose": dataclasses.replace(stages["diagnose"], summary=said)}
    return Walk(render_page(dataclasses.replace(facts(), stages=stages))).text()


def test_the_fit_and_its_check_by_the_full_model_are_said() -> None:
    text = diagnosed_as({})
    assert "has an RMSE of 21.3 mN. The fitted model differs from it by 0.4 mN there." in text
    failed = diagnosed_as({"full_model": {"message": "the skin folds"}})
    assert "The full model fails at the best values: the skin folds" in failed


def test_the_values_are_said_to_be_biased_by_what_is_missing_and_corrected() -> None:
    text = diagnosed_as({}).replace("\N{NO-BREAK SPACE}", " ")
    assert "These values are of the model without device-friction; what it lacks biases them." in text
    assert "With device-friction, the 90 % intervals are: Ec 40 to 80 kPa." in text
    unknown = diagnosed_as({"verdict": "unknown", "mechanisms": []})
    assert "lacks something without a name, which biases these values by an unknown amount" in unknown
    assert "biases" not in diagnosed_as({"verdict": "nothing-missing", "mechanisms": [], "best_set": []})


def test_the_held_out_error_has_a_column_where_there_is_one() -> None:
    assert "held out: after the second hold" not in diagnosed_as({})
    fit = summaries()["diagnose"]["fit"]
    tested = {when: {**said, "rmse_held_out": 0.0312} for when, said in fit.items()}
    text = diagnosed_as({"fit": tested, "held_out_set": ["device-friction"]})
    assert "held out: after the second hold" in text
    assert "31.2 mN" in text.replace("\N{NO-BREAK SPACE}", " ")


def test_each_of_several_recordings_stands_beside_the_others() -> None:
    entry = {"rms_n": 2e-3, "noise_n": 1e-3, "sd_alone": {"E_c": 0.1}, "widens": {"E_c": 2.5}}
    text = diagnosed_as({"recordings": [
        {"name": "first", "tension": 0.4, "contradicts": False, **entry},
        {"name": "second", "tension": 5.2, "contradicts": True, **entry},
    ]})  # fmt: skip
    assert "second2 mN25.2contradicts them" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert re.search(r"first alone informs E.*; without it, the intervals would be wider by .* 2\.5\.", text)


def test_the_table_of_parameters_has_prior_interval_unit_and_sentence(whole: str) -> None:
    text = Walk(whole).text()
    row = "p init initial interstitial pressure uniform, −0.261 to 4.04 kPa 0.842 −0.522 2.02 kPa 1.6"
    compact = re.sub(r"\s", "", text)
    assert re.sub(r"\s", "", row) + "thedatadoesnotinformit(posterior=prior)" in compact
    assert "thedatainformsitweakly" in compact


def test_what_is_left_and_which_test_would_tell_stand_in_the_mismatch(whole: str) -> None:
    text = Walk(whole).text()
    for said in (
        "12.3 mN RMS that the parameters cannot explain; it varies 75 % with displacement, 25 % with phase.",
        "it grows while loading",
        "0.7 of it follows u^3 while loading",
        "u^2 while loading",
        "Explanations, taken as equally probable: device-friction; or viscous-drag.",
        "quarter speed The same at a quarter of the speed. 187 s 0.95 0.01 97 %",
    ):
        assert re.sub(r"\s", "", said) in re.sub(r"\s", "", text), said
    assert "Nothing is left beyond the noise" in diagnosed_as(
        {"unexplained": {**summaries()["diagnose"]["unexplained"], "noticeable": False}}
    )
    nothing = diagnosed_as({"unexplained": None})
    assert "that the parameters cannot explain; it varies" not in nothing
    stages = {name: stage for name, stage in facts().stages.items() if name != "experiment"}
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


def only(run: RunFacts, **standing: str) -> RunFacts:
    stages = {name: StageFacts(name, standing.get(name, "not run")) for name in run.stages}
    done = {
        name: stage for name, stage in run.stages.items() if name in standing and standing[name] == "done"
    }
    return dataclasses.replace(run, stages={**stages, **done}, history=None)


def test_a_page_says_plainly_what_is_not_finished() -> None:
    text = Walk(render_page(only(facts(), recording="done", map="not finished", design="out of date"))).text()
    for said in (
        "The posterior has not been sampled", "The stage sample has not been run.",
        "bayeskin sobol runs/forearm.toml",
        "The stage map was begun and is not finished.", "The stage design is out of date",
        "The physics that is missing is not known: the stage diagnose is not run.", "Phases of the recording",
    ):  # fmt: skip
        assert said in text, said
    assert "trusted" not in text


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


def test_figures_of_further_recordings_follow_that_of_the_first() -> None:
    run = facts()
    sample = run.stages["sample"]
    figures = {**sample.figures, "fit-2": sample.figures["fit"], "fit-10": sample.figures["fit"]}
    changed = dataclasses.replace(sample, figures=figures)
    both = dataclasses.replace(run, stages={**run.stages, "sample": changed})
    fits = pictures(both, "sample", ["fit"])
    assert [picture.title for picture in fits[1:]] == [f"{fits[0].title}, recording {n}" for n in (2, 10)]
    assert len(pictures(run, "sample", ["fit"])) == 1


def test_a_diagnosis_alone_that_failed_says_why_and_names_no_command_for_a_configuration() -> None:
    run = facts(config_text="", config_path="arm.h5")
    failed = StageFacts("diagnose", "failed", 1.0, {"ok": False, "message": "no set could be assessed"})
    stages = {"recording": run.stages["recording"], "diagnose": failed}
    page = render_page(dataclasses.replace(run, stages=stages, history=None, indices={}, forces=()))
    text = Walk(page).text()
    assert '<h1 id="question">What is missing?</h1>' in page
    assert "The stage diagnose failed: no set could be assessed." in text
    assert "bayeskin diagnose" not in text
    assert "What is this skin made of?" not in text
    assert "stage sample" not in text


def test_markers_are_shown_with_their_noise_and_what_they_add(whole: str) -> None:
    text = Walk(whole).text()
    residual = (
        "t 2 of 25 markers the skin moves otherwise than the model says (residual of 0.12 mm RMS at the"
    )
    assert [text.count(f"{start}{residual}") for start in ("A", "Before: a", "After: a")] == [1, 1, 1]
    assert text.count("The noise of a marker's coordinate has an sd of 0.02 mm.") == 3
    assert re.sub(r"\s", "", text).count("wouldbewiderbythesefactors:Ec4.5.") == 3
    assert re.sub(r"\s", "", text).count("c36−12−0.30.1") == 3
    assert "Before: at 2 of 25" not in diagnosed_as({"best_set": []})


def test_a_page_without_markers_does_not_mention_them() -> None:
    def bare(summary: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in summary.items() if key != "on_skin"}

    run = facts()
    fit = {when: bare(fit) for when, fit in summaries()["diagnose"]["fit"].items()}
    said = {"sample": bare(summaries()["sample"]), "diagnose": {**summaries()["diagnose"], "fit": fit}}
    changed = {
        name: dataclasses.replace(run.stages[name], summary=summary, figures={})
        for name, summary in said.items()
    }
    assert (
        "arkers" not in Walk(render_page(dataclasses.replace(run, stages={**run.stages, **changed}))).text()
    )
