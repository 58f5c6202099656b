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
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin import proof, report
from bayeskin.errors import InputError
from bayeskin.hashing import sha256_of, sha256_of_file, sha256_of_input
from bayeskin.json_files import plain, write_json
from bayeskin.proof import seals
from bayeskin.shipped import shipped
from bayeskin.workflow import diagnosis
from bayeskin.workflow.diagnosing_sources import diagnosing_sources
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.folder import locked

Diagnose = Callable[[Path, Reporter], Mapping[str, Any]]
FAILED = "failed"  # takes the place of a verdict where a diagnosis has failed
SET = "data/proof/index.json"


def prove(
    folder: Path | None,
    reporter: Reporter,
    rediagnose: int = 0,
    at_most: int | None = None,
    diagnose: Diagnose = diagnosis.diagnose,
) -> dict[str, Any]:
    """Diagnoses the recordings without a verdict, scores all verdicts, and returns the command's answer.

    folder : the set, by default the shipped set; verdicts and scores are written into it
    rediagnose : so many recordings, spread over the set, are diagnosed again in a temporary folder and
        compared with their stored verdicts; a different verdict is a failure if the stored one is of the same
        sources
    at_most : so many recordings without a verdict are diagnosed now; the recordings judged by then are scored

    A diagnosis that fails has the verdict "failed" until a later call tries it again; the other recordings
    are diagnosed nevertheless. Each scoring is recorded. While recordings are diagnosed, the seals cannot be
    opened. Raises InputError for a folder without a set, for a set whose contents differ from its index, and
    for a set on which another process works.
    """
    folder = shipped(SET).parent if folder is None else folder
    index, sources = seals.read_index(folder), diagnosing_sources()
    if not index:
        raise InputError(folder, "a set without recordings", "a set that `bayeskin conceal` made")
    hashes = {number: entry["recording_sha256"] for number, entry in index.items()}
    diagnoser = _Diagnoser(folder, hashes, reporter, diagnose)
    rediagnosed = diagnoser.work(sources, at_most, rediagnose)
    verdicts = {
        number: verdict
        for number, expected in hashes.items()
        if (verdict := _stored_verdict(folder, number, expected))
    }
    board = proof.score(
        seals.read_keys(folder), {number: verdict["answer"] for number, verdict in verdicts.items()}
    )
    current = sum(verdict["sources_sha256"] == sources for verdict in verdicts.values())
    compared = {
        number: _same_verdict(answer, verdicts[number]["answer"]) for number, answer in rediagnosed.items()
    }
    document = {
        "ok": all(same or verdicts[n]["sources_sha256"] != sources for n, same in compared.items()),
        "folder": folder,
        "scoreboard": board,
        "verdicts_of_these_sources": current,
        "rediagnosed_the_same": compared,
        "rediagnosed_of_these_sources": {n: verdicts[n]["sources_sha256"] == sources for n in compared},
        "figures": list(_record_and_draw(folder, sources, current, board, reporter)),
    }
    return plain({**document, "text": _in_words(document)})


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
                _store(self.folder, number, self.hashes[number], sources, answer)
                self.reporter.log(f"{number}: {_short_answer(answer)}")
            judged = [
                number
                for number, expected in self.hashes.items()
                if _stored_verdict(self.folder, number, expected)
            ]
            return {number: self._diagnosed(number) for number in _evenly_chosen(judged, rediagnose)}

    def _new(self) -> list[str]:
        """Returns the numbers of the recordings without a verdict."""
        return [
            number
            for number, expected in self.hashes.items()
            if not _has_verdict(self.folder, number, expected)
        ]

    def _diagnosed(self, number: str) -> dict[str, Any]:
        """Returns the answer for a copy of a recording in a temporary folder.

        Where the diagnosis fails, the answer has the verdict `FAILED` and the reason.
        """
        source, expected = seals.recording_path(self.folder, number), self.hashes[number]
        if sha256_of_file(source) != expected:
            raise InputError(source, "other contents than the index states", f"sha256 {expected[:12]}...")
        with tempfile.TemporaryDirectory(prefix="bayeskin-prove-", ignore_cleanup_errors=True) as place:
            copy = Path(shutil.copyfile(source, Path(place) / "recording.h5"))
            try:
                answer = dict(self.diagnose(copy, self.reporter))
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
            _record_scoring(folder, sources, current, board)
            stamp = f"bayeskin {bayeskin.__version__}, {folder.name}"
            figures = [*report.save_figure(report.figure_proof(board), folder / "scoreboard", stamp)]
            if board["by_mechanism"]:
                curves = report.figure_detectability(board["by_mechanism"])
                figures += report.save_figure(curves, folder / "detectability", stamp)
            return figures
    except InputError as error:
        reporter.log(f"{error}: figure and scoring are not stored")
    except OSError as error:  # a set inside an installed package may be read-only
        reporter.log(f"{folder}: {error.strerror}: figure and scoring are not stored")
    return ()


def conceal(
    folder: Path, seed: int, count: int, reporter: Reporter, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Makes a set of concealed recordings, or its missing recordings; `only` is as in `proof.cases.plans`.

    Raises InputError as `proof.conceal`, and where another process works on the set.
    """
    if count < 1 or seed < 0:
        raise InputError("--seed, --count", f"{seed}, {count}", "a seed of at least 0, a count of at least 1")
    started = time.monotonic()

    def tell(share: float, note: str) -> None:
        """Reports the progress."""
        reporter.progress("recordings", share, note)

    with locked(folder):
        new_count = proof.conceal(folder, seed, count, only, tell)
    seconds = time.monotonic() - started
    text = f"{new_count} of {count} recordings made in {seconds:.0f} s; keys in {folder / seals.SEALS}"
    return plain(
        {"ok": True, "folder": folder, "made": new_count, "count": count, "seconds": seconds, "text": text}
    )


def _verdict_path(folder: Path, number: str) -> Path:
    """Returns the path of a recording's verdict."""
    return folder / seals.VERDICTS / f"{number}.json"


def _stored_verdict(folder: Path, number: str, recording_sha256: str) -> dict[str, Any] | None:
    """Returns the stored verdict on this very recording, and None where there is none.

    Raises InputError for a file that is no verdict.
    """
    path = _verdict_path(folder, number)
    verdict: dict[str, Any] | None = seals.read_json(path) if path.is_file() else None
    if verdict is None:
        return None
    if not isinstance(verdict, dict) or not {"recording_sha256", "sources_sha256", "answer"} <= set(verdict):
        raise InputError(path, "no verdict of a proof", "a verdict that `bayeskin prove` wrote")
    return verdict if verdict["recording_sha256"] == recording_sha256 else None


def _has_verdict(folder: Path, number: str, recording_sha256: str) -> bool:
    """Returns whether there is a verdict other than that the diagnosis failed."""
    verdict = _stored_verdict(folder, number, recording_sha256)
    return verdict is not None and verdict["answer"]["verdict"] != FAILED


def _store(folder: Path, number: str, recording_sha256: str, sources: str, answer: Mapping[str, Any]) -> None:
    """Stores the verdict on a recording."""
    path = _verdict_path(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        path,
        {
            "recording_sha256": recording_sha256,
            "version": bayeskin.__version__,
            "sources_sha256": sources,
            "answer": answer,
        },
    )


def _record_scoring(folder: Path, sources: str, current: int, board: Mapping[str, Any]) -> None:
    """Adds this scoring to the earlier ones.

    There is one entry for each state of the sources, of the scorer and of the verdicts.
    """
    path = folder / seals.SCORINGS
    before = seals.read_json(path) if path.is_file() else []
    verdicts = sha256_of([sha256_of_file(p) for p in sorted((folder / seals.VERDICTS).glob("*.json"))])
    scorer = sha256_of_input(Path(proof.__file__).with_name("score.py"))
    identity = {"sources_sha256": sources, "verdicts_sha256": verdicts, "scorer_sha256": scorer}
    if any(identity.items() <= scoring.items() for scoring in before):
        return
    scores = {
        name: value for name, value in board.items() if name not in ("each", "by_mechanism", "confusion")
    }
    new = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": bayeskin.__version__,
        **identity,
        "verdicts_of_these_sources": current,
        "scoreboard": scores,
    }
    write_json(path, [*before, new])


def _evenly_chosen(numbers: list[str], count: int) -> list[str]:
    """Returns `count` of the numbers, evenly spread over the set."""
    count = min(count, len(numbers))
    return [numbers[(2 * i + 1) * len(numbers) // (2 * count)] for i in range(count)]


def _same_verdict(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Returns whether two answers have the same verdict and the same mechanisms."""

    def named(answer: Mapping[str, Any]) -> list[str]:
        """Returns the names of an answer's mechanisms, sorted."""
        return sorted(mechanism["name"] for mechanism in answer.get("mechanisms", []))

    return one["verdict"] == other["verdict"] and named(one) == named(other)


def _short_answer(answer: Mapping[str, Any]) -> str:
    """Returns the verdict and the mechanisms of an answer in a few words."""
    if answer["verdict"] == FAILED:
        return f"{FAILED}: {answer.get('message', '')}"
    names = ", ".join(mechanism["name"] for mechanism in answer.get("mechanisms", []))
    return f"{answer['verdict']}{': ' + names if names else ''}"


def _in_words(document: Mapping[str, Any]) -> str:
    """Returns the command's answer as text."""
    board = document["scoreboard"]
    lines = [
        f"{board['judged']} of {board['recordings']} recordings judged, "
        f"{document['verdicts_of_these_sources']} of them by the present sources",
        f"false alarms where nothing is concealed: {_share(board['false_alarms'])}",
    ]
    for name, text in (
        ("named", "named correctly"),
        ("named_up_to_look_alikes", "named correctly or by a look-alike"),
        ("unknown_outside", "effects outside the catalogue with verdict unknown"),
        ("effect_in_interval", "effect's parameters in their 90 % intervals, where named correctly"),
        ("base_in_interval", "base model's parameters in their 90 % intervals"),
    ):
        for size, words in (("clear", "effects of at least 3 x floor"), ("below", "smaller effects")):
            lines.append(f"{text}, {words}: {_share(board[name][size])}")
    for name, text in (
        ("clear_mechanisms_named", "mechanisms that add at least 3 x floor and are named"),
        ("named_mechanisms_there", "named mechanisms that are in the recording"),
    ):
        lines.append(f"{text}: {_share(board[name])}")
    for name, text in (
        ("location_overlap", "overlap of located windows"),
        ("held_out_over_floor", "held-out RMSE divided by the floor, where named correctly"),
    ):
        score = board[name]["clear"]
        middle = "none" if score["median"] is None else f"{score['median']:.2f}"
        lines.append(f"{text}, effects of at least 3 x floor: median {middle} of {score['of']}")
    for number, same in document["rediagnosed_the_same"].items():
        current = document["rediagnosed_of_these_sources"][number]
        different = (
            "ANOTHER VERDICT" if current else "another verdict than the stored one, which other sources gave"
        )
        lines.append(f"{number} diagnosed again: {'the same' if same else different}")
    return "\n".join(lines)


def _share(found: Mapping[str, Any]) -> str:
    """Returns a share with its interval as text."""
    if not found["of"]:
        return "none"
    low, high = 100 * found["low"], 100 * found["high"]
    return f"{found['hits']} of {found['of']}, {100 * found['share']:.0f} % ({low:.0f} to {high:.0f})"
