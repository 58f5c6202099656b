"""The scoreboards of the shipped proof and of the sets beside it as tables of docs/mismatch.md, and figures.

    python benchmarks/proof_page.py

Scores the stored verdicts (`bayeskin prove FOLDER --at-most 0`), diagnoses nothing, and writes between the
markers of the page.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import rows
from demo_gallery import FIGURES, smaller

from bayeskin.proof import seals
from bayeskin.proof.score import CLEAR, share, share_of_parts
from bayeskin.report import half_in_words
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.proof import prove

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "mismatch.md"
PROOF, NOTHING, SIZES = (ROOT / "data" / name for name in ("proof", "nothing", "sizes"))
SHARES = (
    ("false alarms where nothing is concealed", ("false_alarms",), "at most 5 %"),
    ("clear effects named right", ("named", "clear"), "90 %"),
    ("the same up to look-alikes", ("named_up_to_look_alikes", "clear"), "95 %"),
    ("smaller effects named right", ("named", "below"), ""),
    ("mechanisms that add three floors and more, alone or in a pair, named", ("clear_mechanisms_named",), ""),
    ("named mechanisms that are there, on all recordings", ("named_mechanisms_there",), ""),
    ("`unknown` for clear effects outside the catalogue", ("unknown_outside", "clear"), "80 %"),
    (
        "the effect's parameters in their 90 % intervals, where named right and clear",
        ("effect_in_interval", "clear"),
        "80 to 97 %",
    ),
    ("the base's parameters in theirs, there", ("base_in_interval", "clear"), "80 to 97 %"),
    (
        "the base's parameters in theirs, where nothing is concealed",
        ("base_in_interval_nothing",),
        "80 to 97 %",
    ),
)
MEDIANS = (
    (
        "located windows against those where the effect exceeds the floor, clear, overlap",
        ("location_overlap", "clear"),
        "0.5",
    ),
    (
        "RMSE on what was not fitted, over the noise floor, where named right and clear",
        ("held_out_over_floor", "clear"),
        "at most 1.3",
    ),
)


def scores(board: Mapping[str, Any], seconds: Mapping[str, float]) -> str:
    """Shares with their intervals and medians, each beside what is to be reached."""
    table = [_share_row(what, _at(board, path), to_reach) for what, path, to_reach in SHARES]
    missed = [
        one["inside_base"]
        for one in board["each"]
        if one["kind"] in ("alone", "pair") and one["answer"] == "nothing-missing"
    ]
    what = "the base's parameters in theirs, where an effect of the catalogue was called `nothing-missing`"
    table.append(_share_row(what, share_of_parts(missed), ""))
    for what, path, to_reach in MEDIANS:
        one = _at(board, path)
        middle = "not tested" if one["median"] is None else f"{one['median']:.2f} ({one['of']} recordings)"
        table.append([f"{what}, median", middle, "", to_reach])
    nothing = [seconds[one["number"]] for one in board["each"] if one["kind"] == "nothing"]
    every = list(seconds.values())
    table += [
        [
            "time a recording (`seconds` of the verdicts), median",
            f"{np.median(every):.0f} s",
            "",
            "at most 60 s",
        ],
        [
            "recordings that took more than five minutes",
            f"{sum(s > 300.0 for s in every)} of {len(every)}",
            "",
            "",
        ],
        ["longest", f"{max(every) / 60.0:.0f} minutes", "", ""],
    ]
    if nothing:
        table.append(["where nothing is concealed, median", f"{np.median(nothing):.0f} s", "", ""])
    effect = [seconds[one["number"]] for one in board["each"] if one["kind"] != "nothing"]
    if effect:
        table.append(["where something is, median", f"{np.median(effect):.0f} s", "", ""])
    return rows.markdown(("", "found", "90 % interval", "to reach"), table)


def _share_row(what: str, one: Mapping[str, Any], to_reach: str) -> list[str]:
    if not one["of"]:
        return [what, "not tested", "", to_reach]
    interval = f"{100 * one['low']:.0f} to {100 * one['high']:.0f} %"
    return [what, f"{one['hits']} of {one['of']}, {100 * one['share']:.0f} %", interval, to_reach]


def each(board: Mapping[str, Any]) -> str:
    """What was answered where something is concealed, the largest effect first."""
    concealed = [one for one in board["each"] if one["kind"] != "nothing"]
    table = [
        [one["label"], f"{one['size']:.1f}", ", ".join(one["named"]) or f"`{one['answer']}`", _worth(one)]
        for one in sorted(concealed, key=lambda one: -one["size"])
    ]
    return rows.markdown(("concealed", "size [noise floors]", "named", ""), table)


def nothing(boards: Mapping[str, Mapping[str, Any]]) -> str:
    """False alarms and the base's parameters where nothing is concealed, set by set and all together."""
    empty = {
        name: [one for one in board["each"] if one["kind"] == "nothing"] for name, board in boards.items()
    }
    empty["together"] = list(chain.from_iterable(empty.values()))
    table = []
    for name, some in empty.items():
        alarms = share(one["answer"] != "nothing-missing" for one in some)
        inside = [hit for one in some for hit in one["inside_base"].values()]
        table.append([
            name, f"{alarms['hits']} of {alarms['of']}",
            f"{100 * alarms['low']:.0f} to {100 * alarms['high']:.0f} %",
            f"{sum(inside)} of {len(inside)}, {100 * np.mean(inside):.0f} %",
        ])  # fmt: skip
    return rows.markdown(("", "false alarms", "90 % interval", "base's parameters in 90 % intervals"), table)


def inside(boards: Mapping[str, Mapping[str, Any]]) -> str:
    """Of some sets, the base's parameters in their intervals, each and together, by what was concealed."""
    groups: dict[str, list[Mapping[str, bool]]] = {}
    for one in chain.from_iterable(board["each"] for board in boards.values()):
        known = one["inside_base"]
        if one["kind"] == "nothing":
            groups.setdefault("nothing", []).append(known)
        elif one["right"] and one["size"] >= CLEAR:
            groups.setdefault("clear, named right", []).append(known)
            groups.setdefault(one["label"], []).append(known)
        elif one["answer"] == "nothing-missing" and one["kind"] != "outside":
            groups.setdefault(f"{one['label']}, called nothing", []).append(known)
        elif _worth(one) == "wrong":
            groups.setdefault("a wrong name", []).append(known)
    names = list(next(iter(groups.values()))[0])
    table = []
    for group, some in sorted(groups.items(), key=lambda item: -len(item[1])):
        hits = [sum(one[name] for one in some) for name in names]
        table.append([group, str(len(some)), *map(str, hits), f"{sum(hits)} of {len(names) * len(some)}"])
    return rows.markdown(("concealed", "recordings", *names, "together"), table)


def faint(boards: Mapping[str, Mapping[str, Any]], answers: Mapping[str, Mapping[str, Any]]) -> str:
    """Of some sets, what was called `nothing-missing` though a set of mechanisms fitted better, and not."""
    kinds = {
        "nothing": "nothing",
        "alone": "an effect of the catalogue",
        "pair": "an effect of the catalogue",
        "outside": "one outside",
    }
    called: dict[tuple[str, str], list[Mapping[str, bool]]] = {}
    for name, board in boards.items():
        for one in board["each"]:
            if one["answer"] == "nothing-missing":
                better = "yes" if answers[name][one["number"]]["best_set"] else "no"
                called.setdefault((kinds[one["kind"]], better), []).append(one["inside_base"])
    table = []
    for (kind, better), inside in sorted(called.items()):
        hits = share_of_parts(inside)
        table.append([kind, better, str(len(inside)), f"{hits['hits']} of {hits['of']}"])
    head = ("concealed", "a set fits better", "recordings", "base's parameters in 90 % intervals")
    return rows.markdown(head, table)


def sizes(board: Mapping[str, Any]) -> str:
    """Of each mechanism how many are named right, and how large an effect has to be."""
    table = []
    for name, one in board["by_mechanism"].items():
        answers = list(zip(one["sizes"], one["right"], one["up_to"], strict=True))
        clear = [right for size, right, _ in answers if size >= CLEAR]
        below = [right for size, right, _ in answers if size < CLEAR]
        alike = sum(up_to and not right for _, right, up_to in answers)
        table.append([
            name, f"{min(one['sizes']):.1f} to {max(one['sizes']):.1f}", f"{sum(clear)} of {len(clear)}",
            f"{sum(below)} of {len(below)}", str(alike), half_in_words(one),
        ])  # fmt: skip
    head = ("", "sizes [noise floors]", "clear, named right", "smaller, named right", "a look-alike named",
            "half are named at")  # fmt: skip
    return rows.markdown(head, table)


def _worth(one: Mapping[str, Any]) -> str:
    if one["answer"] == "nothing-missing" and one["size"] < 1.0:
        return "below the floor"
    if one["kind"] == "outside":
        return "right" if one["answer"] == "unknown" else ("missed" if not one["named"] else "wrong")
    if one["right"]:
        return "right"
    if not one["named"]:
        return "missed"
    truth = set(one["label"].split(" + "))
    return "in part" if set(one["named"]) < truth else "wrong"


def _at(board: Mapping[str, Any], path: Sequence[str]) -> Mapping[str, Any]:
    found: Any = board
    for key in path:
        found = found[key]
    return dict(found)


def judged(folder: Path) -> bool:
    """Whether each recording of a set has a verdict: keys are opened only then."""
    return {path.stem for path in (folder / "verdicts").glob("*.json")} == set(seals.read_index(folder))


def main() -> None:
    boards, answers, seconds = {}, {}, {}
    for folder in (PROOF, NOTHING, SIZES):
        if not judged(folder):
            print(f"{folder.name}: not judged to the end, left out")
            continue
        boards[folder.name] = prove(folder, Silent(), at_most=0)["scoreboard"]
        verdicts = (folder / "verdicts").glob("*.json")
        answers[folder.name] = {path.stem: json.loads(path.read_text())["answer"] for path in verdicts}
        seconds[folder.name] = {number: one["seconds"] for number, one in answers[folder.name].items()}
    proof = boards[PROOF.name]
    tables = {"proof": scores(proof, seconds[PROOF.name]), "each": each(proof)}
    smaller(PROOF / "scoreboard.png", FIGURES / "proof.png")
    if NOTHING.name in boards:
        tables["nothing"] = nothing({name: boards[name] for name in (PROOF.name, NOTHING.name)})
    if SIZES.name in boards:
        board = boards[SIZES.name]
        tables |= {
            "sizes": sizes(board),
            "sizes-scores": scores(board, seconds[SIZES.name]),
            "sizes-each": each(board),
        }
        smaller(SIZES / "detectability.png", FIGURES / "detectability.png")
    beside = {name: board for name, board in boards.items() if name != PROOF.name}  # by earlier sources
    for mark, some in (("", {PROOF.name: proof}), ("-beside", beside)):
        if some:
            tables |= {f"inside{mark}": inside(some), f"faint{mark}": faint(some, answers)}
    for name, table in tables.items():
        rows.into_docs(PAGE, name, table)
        print(table)


if __name__ == "__main__":
    main()
