"""Stores the verdicts on the recordings of a set, and reads them again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin.errors import InputError
from bayeskin.json_files import write_json
from bayeskin.proof import seals

FAILED = "failed"  # takes the place of a verdict where a diagnosis has failed


@dataclass(frozen=True)
class Verdict:
    """The answer of a diagnosis, with the hashes of its recording and of the diagnosing sources."""

    recording_sha256: str
    version: str
    sources_sha256: str
    answer: Mapping[str, Any]


def verdict_path(folder: Path, number: str) -> Path:
    """Returns the path of a recording's verdict."""
    return folder / seals.VERDICTS / f"{number}.json"


def store_verdict(
    folder: Path, number: str, recording_sha256: str, sources_sha256: str, answer: Mapping[str, Any]
) -> None:
    """Stores the verdict on a recording."""
    path = verdict_path(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, vars(Verdict(recording_sha256, bayeskin.__version__, sources_sha256, answer)))


def read_verdict(folder: Path, number: str, recording_sha256: str) -> Verdict | None:
    """Returns the stored verdict on this very recording, and None where there is none.

    Raises InputError for a file that is no verdict.
    """
    path = verdict_path(folder, number)
    stored = seals.read_json(path) if path.is_file() else None
    if stored is None:
        return None
    if not isinstance(stored, dict) or not {"recording_sha256", "sources_sha256", "answer"} <= set(stored):
        raise InputError(
            path, "it is not a verdict of a proof", "bayeskin needs a verdict that `bayeskin prove` wrote"
        )
    if stored["recording_sha256"] != recording_sha256:
        return None
    return Verdict(recording_sha256, stored.get("version", ""), stored["sources_sha256"], stored["answer"])


def has_verdict(folder: Path, number: str, recording_sha256: str) -> bool:
    """Returns whether there is a verdict other than that the diagnosis failed."""
    verdict = read_verdict(folder, number, recording_sha256)
    return verdict is not None and verdict.answer["verdict"] != FAILED


def same_verdict(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Returns whether two answers have the same verdict and the same mechanisms."""
    return first["verdict"] == second["verdict"] and sorted(_named(first)) == sorted(_named(second))


def in_short(answer: Mapping[str, Any]) -> str:
    """Returns the verdict and the mechanisms of an answer in a few words."""
    if answer["verdict"] == FAILED:
        return f"{FAILED}: {answer.get('message', '')}"
    names = ", ".join(_named(answer))
    return f"{answer['verdict']}{': ' + names if names else ''}"


def _named(answer: Mapping[str, Any]) -> list[str]:
    """Returns the names of an answer's mechanisms."""
    return [mechanism["name"] for mechanism in answer.get("mechanisms", [])]
