"""Builds the report of a run: one HTML file that needs no other file."""

from bayeskin.report.page.facts import RunFacts, StageFacts
from bayeskin.report.page.render import render_page

__all__ = ["RunFacts", "StageFacts", "render_page"]
