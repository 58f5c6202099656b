"""Records each scoring of a set in a file of the set."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin.hashing import sha256_of, sha256_of_file, sha256_of_input
from bayeskin.json_files import write_json
from bayeskin.proof import scoring, seals


def record_scoring(folder: Path, sources_sha256: str, current: int, board: Mapping[str, Any]) -> None:
    """Adds a scoreboard to the earlier ones of a set.

    There is one entry for each state of the diagnosing sources, of the scorer and of the verdicts.

    current : number of verdicts that are of these sources
    """
    path = folder / seals.SCORINGS
    before = seals.read_json(path) if path.is_file() else []
    verdicts = sha256_of([sha256_of_file(p) for p in sorted((folder / seals.VERDICTS).glob("*.json"))])
    identity = {
        "sources_sha256": sources_sha256, "verdicts_sha256": verdicts, "scorer_sha256": _scorer_sha256(),
    }  # fmt: skip
    if any(identity.items() <= entry.items() for entry in before):
        return
    left_out = ("each", "by_mechanism", "confusion")
    new = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": bayeskin.__version__,
        **identity,
        "verdicts_of_these_sources": current,
        "scoreboard": {name: value for name, value in board.items() if name not in left_out},
    }
    write_json(path, [*before, new])


def _scorer_sha256() -> str:
    """Returns the hash of how the scoring modules behave."""
    modules = sorted(Path(scoring.__file__).parent.glob("*.py"))
    return sha256_of([sha256_of_input(module) for module in modules])
