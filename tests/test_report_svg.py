"""Figures in the report's page: their parts stay apart, and nothing in them runs or loads."""

from __future__ import annotations

import dataclasses
import re

import pytest
from toys.finished_run import drawing, facts
from toys.html_walk import Walk

from bayeskin.report.page import render_page
from bayeskin.report.page.svg import inline_svg


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
