"""Builds the report of a run or a study: one HTML file that needs no other file."""

from bayeskin.report.page.facts import RunFacts, StageFacts
from bayeskin.report.page.render import render_page, render_study
from bayeskin.report.page.study import StudyFacts

__all__ = ["RunFacts", "StageFacts", "StudyFacts", "render_page", "render_study"]
