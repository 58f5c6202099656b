"""Input of a page: a run, and the answers and figures of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bayeskin.sensitivity.sobol import SobolResult


@dataclass(frozen=True)
class StageFacts:
    """One stage: how it stands, its seconds, and, when it is done, its summary and figures.

    summary : the stage's own, in SI; a failed stage's has a "message"
    figures : name to SVG text
    """

    name: str
    standing: str
    seconds: float | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    figures: Mapping[str, str] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        return self.standing == "done"


@dataclass(frozen=True)
class RunFacts:
    """A run: its configuration, where it comes from, the standing of its stages.

    config_path : as a person would type it; config_text : the file's own
    parameters : those of the model, by name in their order, and what each means
    history : the recorded bins and what is predicted for them, as the stage `sample` writes them
    indices : Sobol' indices over time by what they are taken over, as the stage `sobol` writes them
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

    def stage(self, name: str) -> StageFacts:
        """A stage's facts; of one that nothing is known of, that it has not been run."""
        return self.stages.get(name, StageFacts(name, "not run"))

    def said(self, stage: str) -> Mapping[str, Any]:
        """The summary of a stage that is done; empty otherwise."""
        facts = self.stage(stage)
        return facts.summary if facts.done else {}
