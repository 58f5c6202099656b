"""The proof on a set of recordings: diagnosed one by one, verdicts kept, then scored beside their keys."""

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
FAILED = "failed"  # in a verdict's place, where the diagnosis has ended without one
SET = "data/proof/index.json"


def prove(
    folder: Path | None,
    reporter: Reporter,
    rediagnose: int = 0,
    at_most: int | None = None,
    diagnose: Diagnose = diagnosis.diagnose,
) -> dict[str, Any]:
    """Diagnoses what has no verdict yet, then scores all verdicts; into `folder` (default: the shipped set).

    rediagnose : so many, spread over the set, are diagnosed afresh in a temporary place and compared with
        their stored verdicts; another verdict is a failure where the sources are those of the stored one
    at_most : of those without a verdict so many are diagnosed now; what is judged by then is scored

    A diagnosis that fails has the verdict "failed" until a later call tries it again, and the set goes on.
    Each scoring is recorded. While anything is diagnosed, the seals cannot be opened.
    Raises InputError for a folder without a set, whose contents are not what its index says, or on
    which another process is at work.
    """
    folder = shipped(SET).parent if folder is None else folder
    index, sources = seals.read_index(folder), diagnosing_sources()
    if not index:
        raise InputError(folder, "a set without recordings", "one that `bayeskin conceal` made")
    hashes = {number: said["recording_sha256"] for number, said in index.items()}
    judge = _Judge(folder, hashes, reporter, diagnose)
    again = judge.work(sources, at_most, rediagnose)
    verdicts = {
        number: one for number, expected in hashes.items() if (one := _stored(folder, number, expected))
    }
    board = proof.score(seals.read_keys(folder), {number: one["answer"] for number, one in verdicts.items()})
    current = sum(one["sources_sha256"] == sources for one in verdicts.values())
    compared = {number: _same(one, verdicts[number]["answer"]) for number, one in again.items()}
    document = {
        "ok": all(same or verdicts[n]["sources_sha256"] != sources for n, same in compared.items()),
        "folder": folder,
        "scoreboard": board,
        "verdicts_of_these_sources": current,
        "rediagnosed_the_same": compared,
        "rediagnosed_of_these_sources": {n: verdicts[n]["sources_sha256"] == sources for n in compared},
        "figures": list(_kept(folder, sources, current, board, reporter)),
    }
    return plain({**document, "text": _in_words(document)})


@dataclass(frozen=True)
class _Judge:
    """Diagnoses recordings of a set, of which `hashes` are known by number, while its seals are closed."""

    folder: Path
    hashes: Mapping[str, str]
    reporter: Reporter
    diagnose: Diagnose

    def work(self, sources: str, at_most: int | None, rediagnose: int) -> dict[str, Mapping[str, Any]]:
        """Stores verdicts where there are none, at most so many; returns those of `rediagnose` others."""
        diagnosing = bool(self._new()) and at_most != 0
        with proof.closed(self.folder), locked(self.folder) if diagnosing else nullcontext():
            new = self._new()
            for place, number in enumerate(new[:at_most]):
                self.reporter.progress("recordings", place / len(new), f"{number} of {len(self.hashes)}")
                answer = self._diagnosed(number)
                _store(self.folder, number, self.hashes[number], sources, answer)
                self.reporter.log(f"{number}: {_in_a_word(answer)}")
            judged = [
                number for number, expected in self.hashes.items() if _stored(self.folder, number, expected)
            ]
            return {number: self._diagnosed(number) for number in _spread(judged, rediagnose)}

    def _new(self) -> list[str]:
        return [
            number for number, expected in self.hashes.items() if not _answered(self.folder, number, expected)
        ]

    def _diagnosed(self, number: str) -> dict[str, Any]:
        """The answer on a copy of the recording, far from the set; `FAILED` and why where there is none."""
        source, expected = seals.recording_path(self.folder, number), self.hashes[number]
        if sha256_of_file(source) != expected:
            raise InputError(source, "other contents than the index says", f"sha256 {expected[:12]}...")
        with tempfile.TemporaryDirectory(prefix="bayeskin-prove-", ignore_cleanup_errors=True) as place:
            copy = Path(shutil.copyfile(source, Path(place) / "recording.h5"))
            try:
                answer = dict(self.diagnose(copy, self.reporter))
            except Exception as error:  # whatever it is, it is one recording's
                known = isinstance(error, InputError)
                answer = {"message": str(error) if known else f"{type(error).__name__}: {error}"}
                if not known:
                    self.reporter.log("".join(traceback.format_exception(error)))
        said = {name: value for name, value in plain(answer).items() if name not in ("figures", "text")}
        return {"verdict": FAILED, **said}


def _kept(
    folder: Path, sources: str, current: int, board: Mapping[str, Any], reporter: Reporter
) -> Sequence[Path]:
    """Records the scoring and draws the scoreboard, where the folder can be written and is nobody else's."""
    try:
        with locked(folder):
            _record(folder, sources, current, board)
            stamp = f"bayeskin {bayeskin.__version__}, {folder.name}"
            figures = [*report.save_figure(report.figure_proof(board), folder / "scoreboard", stamp)]
            if board["by_mechanism"]:
                curves = report.figure_detectability(board["by_mechanism"])
                figures += report.save_figure(curves, folder / "detectability", stamp)
            return figures
    except InputError as error:
        reporter.log(f"{error}: neither figure nor scoring is kept")
    except OSError as error:  # a set that came with an installation
        reporter.log(f"{folder}: {error.strerror}: neither figure nor scoring is kept")
    return ()


def conceal(
    folder: Path, seed: int, count: int, reporter: Reporter, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Makes a set of concealed recordings, or what is missing of it; `only` as in `proof.cases.plans`.

    Raises InputError as `proof.conceal`, and where another process is at work on the set.
    """
    if count < 1 or seed < 0:
        raise InputError("--seed, --count", f"{seed}, {count}", "a seed from 0 on and at least one recording")
    started = time.monotonic()

    def tell(share: float, note: str) -> None:
        reporter.progress("recordings", share, note)

    with locked(folder):
        made = proof.conceal(folder, seed, count, only, tell)
    seconds = time.monotonic() - started
    text = f"{made} of {count} recordings made in {seconds:.0f} s; keys in {folder / seals.SEALS}"
    return plain(
        {"ok": True, "folder": folder, "made": made, "count": count, "seconds": seconds, "text": text}
    )


def _verdict_path(folder: Path, number: str) -> Path:
    return folder / seals.VERDICTS / f"{number}.json"


def _stored(folder: Path, number: str, recording_sha256: str) -> dict[str, Any] | None:
    """The verdict on this very recording, if there is one."""
    path = _verdict_path(folder, number)
    found: dict[str, Any] | None = seals.read_json(path) if path.is_file() else None
    if found is None:
        return None
    if not isinstance(found, dict) or not {"recording_sha256", "sources_sha256", "answer"} <= set(found):
        raise InputError(path, "no verdict of a proof", "one that `bayeskin prove` wrote")
    return found if found["recording_sha256"] == recording_sha256 else None


def _answered(folder: Path, number: str, recording_sha256: str) -> bool:
    """Whether there is a verdict, and not that the diagnosis failed."""
    found = _stored(folder, number, recording_sha256)
    return found is not None and found["answer"]["verdict"] != FAILED


def _store(folder: Path, number: str, recording_sha256: str, sources: str, answer: Mapping[str, Any]) -> None:
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


def _record(folder: Path, sources: str, current: int, board: Mapping[str, Any]) -> None:
    """Adds this scoring to those before it; one for each state of the sources and of the scorer, and each set
    of verdicts."""
    path = folder / seals.SCORINGS
    before = seals.read_json(path) if path.is_file() else []
    verdicts = sha256_of([sha256_of_file(p) for p in sorted((folder / seals.VERDICTS).glob("*.json"))])
    scorer = sha256_of_input(Path(proof.__file__).with_name("score.py"))
    of = {"sources_sha256": sources, "verdicts_sha256": verdicts, "scorer_sha256": scorer}
    if any(of.items() <= one.items() for one in before):
        return
    kept = {name: value for name, value in board.items() if name not in ("each", "by_mechanism", "confusion")}
    new = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": bayeskin.__version__,
        **of,
        "verdicts_of_these_sources": current,
        "scoreboard": kept,
    }
    write_json(path, [*before, new])


def _spread(numbers: list[str], count: int) -> list[str]:
    """`count` of the numbers, evenly over the set."""
    count = min(count, len(numbers))
    return [numbers[(2 * i + 1) * len(numbers) // (2 * count)] for i in range(count)]


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two answers have the same verdict and the same names."""

    def named(answer: Mapping[str, Any]) -> list[str]:
        return sorted(mechanism["name"] for mechanism in answer.get("mechanisms", []))

    return one["verdict"] == other["verdict"] and named(one) == named(other)


def _in_a_word(answer: Mapping[str, Any]) -> str:
    if answer["verdict"] == FAILED:
        return f"{FAILED}: {answer.get('message', '')}"
    names = ", ".join(one["name"] for one in answer.get("mechanisms", []))
    return f"{answer['verdict']}{': ' + names if names else ''}"


def _in_words(document: Mapping[str, Any]) -> str:
    board = document["scoreboard"]
    lines = [
        f"{board['judged']} of {board['recordings']} recordings judged, "
        f"{document['verdicts_of_these_sources']} by the present sources",
        f"false alarms where nothing is concealed: {_share(board['false_alarms'])}",
    ]
    for name, text in (
        ("named", "named right"),
        ("named_up_to_look_alikes", "named right up to look-alikes"),
        ("unknown_outside", "unknown for what is outside the catalogue"),
        ("effect_in_interval", "effect's parameters in their 90 % intervals, where named right"),
        ("base_in_interval", "base's parameters in theirs"),
    ):
        for size, words in (("clear", "3 x floor and more"), ("below", "below")):
            lines.append(f"{text}, {words}: {_share(board[name][size])}")
    for name, text in (
        ("clear_mechanisms_named", "mechanisms that add 3 x floor and more, named"),
        ("named_mechanisms_there", "named mechanisms that are there"),
    ):
        lines.append(f"{text}: {_share(board[name])}")
    for name, text in (
        ("location_overlap", "overlap of located windows"),
        ("held_out_over_floor", "held-out RMSE over the floor, where named right"),
    ):
        found = board[name]["clear"]
        middle = "none" if found["median"] is None else f"{found['median']:.2f}"
        lines.append(f"{text}, 3 x floor and more: median {middle} of {found['of']}")
    for number, same in document["rediagnosed_the_same"].items():
        current = document["rediagnosed_of_these_sources"][number]
        other = "ANOTHER VERDICT" if current else "another verdict than that stored, which other sources gave"
        lines.append(f"{number} diagnosed again: {'the same' if same else other}")
    return "\n".join(lines)


def _share(found: Mapping[str, Any]) -> str:
    if not found["of"]:
        return "none"
    low, high = 100 * found["low"], 100 * found["high"]
    return f"{found['hits']} of {found['of']}, {100 * found['share']:.0f} % ({low:.0f} to {high:.0f})"
