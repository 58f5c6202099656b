"""The proof on a set of recordings with concealed effects.

The recordings are diagnosed one by one, and the verdicts are stored. Then they are scored against the keys.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin import proof, report
from bayeskin.errors import InputError, reason_of
from bayeskin.hashing import sha256_of_file
from bayeskin.json_files import plain
from bayeskin.proof import seals
from bayeskin.proof.scoring_history import record_scoring
from bayeskin.proof.verdicts import (
    FAILED,
    has_verdict,
    in_short,
    read_verdict,
    same_verdict,
    store_verdict,
)
from bayeskin.shipped import shipped
from bayeskin.workflow import diagnosing
from bayeskin.workflow.diagnosing_sources import diagnosing_sources
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.folder import locked
from bayeskin.workflow.proof_text import in_words

Diagnose = Callable[[Sequence[Path], Reporter], Mapping[str, Any]]
SET = "data/proof/index.json"


def prove(
    folder: Path | None,
    reporter: Reporter,
    rediagnose: int = 0,
    at_most: int | None = None,
    diagnose: Diagnose = diagnosing.diagnose,
) -> dict[str, Any]:
    """Diagnoses the recordings without a verdict, scores all verdicts, and returns the command's answer.

    folder : the set, by default the shipped set; verdicts and scores are written into it
    rediagnose : number of recordings, spread over the set, that are diagnosed again in a temporary folder and
        compared with their stored verdicts; a different verdict is a failure if the stored one is of the same
        sources
    at_most : largest number of recordings without a verdict that are diagnosed now; the recordings that have
        a verdict then are scored

    A diagnosis that fails has the verdict "failed" until a later call tries it again; the other recordings
    are diagnosed nevertheless. Each scoring is recorded. While recordings are diagnosed, the seals cannot be
    opened. Raises InputError for a folder without a set, for a set whose contents differ from its index, and
    for a set on which another process works.
    """
    folder = shipped(SET).parent if folder is None else folder
    index, sources = seals.read_index(folder), diagnosing_sources()
    if not index:
        raise InputError(folder, "the set has no recordings", "use a set that `bayeskin conceal` made")
    hashes = {number: entry["recording_sha256"] for number, entry in index.items()}
    diagnosed_again = _Diagnoser(folder, hashes, reporter, diagnose).work(sources, at_most, rediagnose)
    verdicts = {
        number: verdict
        for number, expected in hashes.items()
        if (verdict := read_verdict(folder, number, expected))
    }
    board = proof.score(seals.read_keys(folder), {number: v.answer for number, v in verdicts.items()})
    of_these_sources = {number: v.sources_sha256 == sources for number, v in verdicts.items()}
    current = sum(of_these_sources.values())
    same = {n: same_verdict(answer, verdicts[n].answer) for n, answer in diagnosed_again.items()}
    document = {
        "ok": all(same[number] or not of_these_sources[number] for number in same),
        "folder": folder,
        "scoreboard": board,
        "verdicts_of_these_sources": current,
        "rediagnosed_the_same": same,
        "rediagnosed_of_these_sources": {number: of_these_sources[number] for number in same},
        "figures": list(_record_and_draw(folder, sources, current, board, reporter)),
    }
    return plain({**document, "text": in_words(document)})


@dataclass(frozen=True)
class _Diagnoser:
    """Diagnoses recordings of a set while its seals are closed.

    hashes : the sha256 of each recording, by its number
    """

    folder: Path
    hashes: Mapping[str, str]
    reporter: Reporter
    diagnose: Diagnose

    def work(self, sources: str, at_most: int | None, rediagnose: int) -> dict[str, Mapping[str, Any]]:
        """Stores verdicts of at most `at_most` recordings that have none, and diagnoses others again.

        Returns the new answers of the `rediagnose` recordings that are diagnosed again.
        """
        diagnosing = bool(self._new()) and at_most != 0
        with proof.closed(self.folder), locked(self.folder) if diagnosing else nullcontext():
            new = self._new()
            for place, number in enumerate(new[:at_most]):
                self.reporter.progress("recordings", place / len(new), f"{number} of {len(self.hashes)}")
                answer = self._diagnosed(number)
                store_verdict(self.folder, number, self.hashes[number], sources, answer)
                self.reporter.log(f"{number}: {in_short(answer)}")
            judged = [
                number
                for number, expected in self.hashes.items()
                if read_verdict(self.folder, number, expected)
            ]
            return {number: self._diagnosed(number) for number in _evenly_chosen(judged, rediagnose)}

    def _new(self) -> list[str]:
        """Returns the numbers of the recordings without a verdict."""
        return [
            number
            for number, expected in self.hashes.items()
            if not has_verdict(self.folder, number, expected)
        ]

    def _diagnosed(self, number: str) -> dict[str, Any]:
        """Returns the answer for a copy of a recording in a temporary folder.

        Where the diagnosis fails, the answer has the verdict `FAILED` and the reason.
        """
        source, expected = seals.recording_path(self.folder, number), self.hashes[number]
        if sha256_of_file(source) != expected:
            raise InputError(
                source,
                "its contents differ from those of the index",
                f"its sha256 must be {expected[:12]}...",
            )
        with tempfile.TemporaryDirectory(prefix="bayeskin-prove-", ignore_cleanup_errors=True) as place:
            copy = Path(shutil.copyfile(source, Path(place) / "recording.h5"))
            try:
                answer = dict(self.diagnose([copy], self.reporter))
            except Exception as error:  # an error of any type concerns this one recording only
                known = isinstance(error, InputError)
                answer = {"message": str(error) if known else f"{type(error).__name__}: {error}"}
                if not known:
                    self.reporter.log("".join(traceback.format_exception(error)))
        stored = {name: value for name, value in plain(answer).items() if name not in ("figures", "text")}
        return {"verdict": FAILED, **stored}


def _record_and_draw(
    folder: Path, sources: str, current: int, board: Mapping[str, Any], reporter: Reporter
) -> Sequence[Path]:
    """Records the scoring and draws the scoreboard, and returns the figures.

    Nothing is written where the folder is read-only or another process uses it.
    """
    try:
        with locked(folder):
            record_scoring(folder, sources, current, board)
            stamp = f"bayeskin {bayeskin.__version__}, {folder.name}"
            figures = [*report.save_figure(report.figure_proof(board), folder / "scoreboard", stamp)]
            if board["by_mechanism"]:
                curves = report.figure_detectability(board["by_mechanism"])
                figures += report.save_figure(curves, folder / "detectability", stamp)
            return figures
    except InputError as error:
        reporter.log(f"figure and scoring are not stored: {error}")
    except OSError as error:  # a set inside an installed package may be read-only
        reporter.log(f"figure and scoring are not stored: {folder}: {reason_of(error)}")
    return ()


def conceal(
    folder: Path, seed: int, count: int, reporter: Reporter, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Makes a set of concealed recordings, or its missing recordings; `only` is as in `proof.plans.plans`.

    Raises InputError as `proof.conceal`, and where another process works on the set.
    """
    if count < 1 or seed < 0:
        raise InputError(
            "--seed, --count",
            f"they are {seed} and {count}",
            "the seed must be at least 0, and the count at least 1",
        )
    started = time.monotonic()

    with locked(folder):
        new_count = proof.conceal(folder, seed, count, only, partial(reporter.progress, "recordings"))
    seconds = time.monotonic() - started
    text = f"{new_count} of {count} recordings made in {seconds:.0f} s; keys in {folder / seals.SEALS}"
    return plain(
        {"ok": True, "folder": folder, "made": new_count, "count": count, "seconds": seconds, "text": text}
    )


def _evenly_chosen(numbers: list[str], count: int) -> list[str]:
    """Returns `count` of the numbers, evenly spread over the set."""
    count = min(count, len(numbers))
    return [numbers[(2 * i + 1) * len(numbers) // (2 * count)] for i in range(count)]
