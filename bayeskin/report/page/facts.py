"""Defines the input of a page: a run, and the summaries and figures of its stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bayeskin.sensitivity.result import SobolResult


@dataclass(frozen=True)
class StageFacts:
    """Holds the state of one stage, its seconds and, when it is done, its summary and figures.

    standing : "done", "not run", "not finished", "failed" or "out of date"
    summary : results of the stage, in SI; the summary of a failed stage has a "message"
    figures : SVG text by name
    """

    name: str
    standing: str
    seconds: float | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    figures: Mapping[str, str] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """Returns whether the stage is done and up to date."""
        return self.standing == "done"


@dataclass(frozen=True)
class RunFacts:
    """Holds the facts of a run: its configuration, its provenance, and the state of its stages.

    config_path : as a person would type it; config_text : content of that file, "" for recordings without one
    parameters : meaning of each parameter of the model, by name and in the model's order
    history : recorded bins and their prediction, as the stage `sample` writes them
    indices : Sobol' indices over time, by the name of their distribution, as the stage `sobol` writes them
    forces : recorded and fitted forces of each recording, as the stage `diagnose` writes them
    """

    name: str
    config_path: str
    config_text: str
    config_sha256: str
    version: str
    seed: int
    observation: str
    mesh: str
    parameters: Mapping[str, str]
    stages: Mapping[str, StageFacts]
    history: Mapping[str, Any] | None = None
    indices: Mapping[str, SobolResult] = field(default_factory=dict)
    forces: Sequence[Mapping[str, Any]] = ()

    def stage(self, name: str) -> StageFacts:
        """Returns the facts of a stage; an unknown stage counts as not run."""
        return self.stages.get(name, StageFacts(name, "not run"))

    def said(self, stage: str) -> Mapping[str, Any]:
        """Returns the summary of a stage that is done, and an empty mapping otherwise."""
        facts = self.stage(stage)
        return facts.summary if facts.done else {}

    @property
    def calibrated(self) -> bool:
        """Returns whether the stages of a calibration belong to the page.

        They do not where a diagnosis was made and nothing else was asked for, and for recordings without a
        configuration.
        """
        diagnosed = bool(self.said("diagnose"))
        return "sample" in self.stages and not (diagnosed and self.stage("sample").standing == "not run")

    def command(self, stage: str) -> str:
        """Returns the command that runs a stage, or "" for recordings without a configuration."""
        return f"bayeskin {stage} {self.config_path}" if self.config_text else ""
