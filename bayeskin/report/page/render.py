"""Renders the facts of a run or a study as HTML: it fills a template with sections, style and script."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from bayeskin.report.page import checks, indices, mismatch, sections
from bayeskin.report.page.answer import answer
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.overview import overview_charts
from bayeskin.report.page.parts import Block, Section
from bayeskin.report.page.prose import prose
from bayeskin.report.page.study import StudyFacts, study_picture, study_sections, study_verdict

MATERIAL, MISSING = "What is this skin made of?", "What is missing?"
_HERE = Path(__file__).parent


def render_page(facts: RunFacts) -> str:
    """Returns one HTML document that loads nothing: it contains all text, figures, style and script.

    A page with a diagnosis begins with its verdict, one figure and three sentences.
    All text from a configuration or a recording is escaped. The page allows its own script only, which it
    identifies by a hash. The same facts give the same bytes.
    """
    said, diagnosed = answer(facts), bool(facts.said("diagnose"))
    question = MATERIAL if facts.calibrated else MISSING
    return _rendered(
        "page.html", facts=facts, question=said.missing.word if diagnosed else question, material=MATERIAL,
        diagnosed=diagnosed, charts=overview_charts(facts), answer=said, sections=_sections(facts),
    )  # fmt: skip


def render_study(facts: StudyFacts) -> str:
    """Returns the HTML document of a study, as `render_page`; it links to the reports of the recordings."""
    return _rendered(
        "study.html", facts=facts, question="What does this study show?", answer=study_verdict(facts),
        pictures=study_picture(facts, "population"), sections=study_sections(facts),
    )  # fmt: skip


def page_environment(*folders: Path) -> Environment:
    """Returns an environment with the templates of pages, and with those of further folders before them.

    Everything that a template prints is escaped.
    """
    environment = Environment(
        loader=FileSystemLoader([*folders, _HERE]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"kind": _kind, "prose": prose}
    return environment


def page_asset(name: str) -> str:
    """Returns the style ("page.css") or the script ("page.js") of pages."""
    return (_HERE / name).read_text(encoding="utf-8")


def _rendered(template: str, **parts: Any) -> str:
    """Returns a template filled with parts of a page."""
    script = page_asset("page.js")
    return (
        page_environment()
        .get_template(template)
        .render(
            **parts,
            style=Markup(page_asset("page.css")),
            script=Markup(script),
            script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        )
    )


def _sections(facts: RunFacts) -> list[Section]:
    """Returns the sections of the page, which begin with the diagnosis if one was made."""
    calibration = (sections.fit, sections.posterior, indices.sobol) if facts.calibrated else ()
    checked = (checks.checks,) if facts.calibrated else ()
    if facts.said("diagnose"):
        order = (mismatch.mismatch, sections.recording, *calibration, *checked, checks.provenance)
    else:
        order = (sections.recording, *calibration, mismatch.mismatch, *checked, checks.provenance)
    return [make(facts) for make in order]


def _kind(block: Block) -> str:
    return type(block).__name__
