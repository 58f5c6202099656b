"""The origin of a result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Provenance:
    """The origin of a result, which is part of every file that bayeskin writes."""

    version: str
    config_sha256: str = ""
    recording_sha256: str = ""
    model_hash: str = ""
    seed: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict)
