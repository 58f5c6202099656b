"""Writes the scoreboards of the shipped proof and of the sets beside it into docs/mismatch-appendix.md.

    python benchmarks/proof_page.py

The program scores the stored verdicts (`bayeskin prove FOLDER --at-most 0`) and diagnoses nothing. It writes
tables between the markers of the page, and copies the figures.
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
from bayeskin.proof.scoring.judgement import CLEAR
from bayeskin.proof.scoring.shares import share, share_of_parts
from bayeskin.report import half_in_words
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.proof import prove

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "mismatch-appendix.md"
PROOF, NOTHING, SIZES = (ROOT / "data" / name for name in ("proof", "nothing", "sizes"))
SHARES = (
    ("false alarms where nothing is concealed", ("false_alarms",), "at most 5 %"),
    ("clear effects named right", ("named", "clear"), "90 %"),
    ("the same up to look-alikes", ("named_up_to_look_alikes", "clear"), "95 %"),
    ("smaller effects named right", ("named", "below"), ""),
    ("mechanisms of three floors or more, alone or in a pair, named", ("clear_mechanisms_named",), ""),
    ("named mechanisms that were concealed, all recordings", ("named_mechanisms_there",), ""),
    ("`unknown` for clear effects outside the catalogue", ("unknown_outside", "clear"), "80 %"),
    (
        "parameters of the effect inside their 90 % intervals (clear, named right)",
        ("effect_in_interval", "clear"),
        "80 to 97 %",
    ),
    (
        "base parameters inside their 90 % intervals (clear, named right)",
        ("base_in_interval", "clear"),
        "80 to 97 %",
    ),
    (
        "base parameters inside their 90 % intervals (nothing concealed)",
        ("base_in_interval_nothing",),
        "80 to 97 %",
    ),
)
MEDIANS = (
    (
        "overlap of located windows with those where the effect exceeds the floor (clear)",
        ("location_overlap", "clear"),
        "0.5",
    ),
    (
        "held-out RMSE over the noise floor (clear, named right)",
        ("held_out_over_floor", "clear"),
        "at most 1.3",
    ),
)


def scores(board: Mapping[str, Any], seconds: Mapping[str, float]) -> str:
    """Returns a table of shares with their intervals, and of medians, each beside the aim."""
    table = [_share_row(label, _at(board, path), to_reach) for label, path, to_reach in SHARES]
    inside_missed = [
        recording["inside_base"]
        for recording in board["each"]
        if recording["kind"] in ("alone", "pair") and recording["answer"] == "nothing-missing"
    ]
    label = "base parameters inside their 90 % intervals (effect of the catalogue called `nothing-missing`)"
    table.append(_share_row(label, share_of_parts(inside_missed), ""))
    for label, path, to_reach in MEDIANS:
        value = _at(board, path)
        median = (
            "not tested" if value["median"] is None else f"{value['median']:.2f} ({value['of']} recordings)"
        )
        table.append([f"{label}, median", median, "", to_reach])
    nothing_seconds = [
        seconds[recording["number"]] for recording in board["each"] if recording["kind"] == "nothing"
    ]
    all_seconds = list(seconds.values())
    table += [
        [
            "time per recording (`seconds` of the verdicts), median",
            f"{np.median(all_seconds):.0f} s",
            "",
            "at most 60 s",
        ],
        [
            "recordings that took more than five minutes",
            f"{sum(duration_s > 300.0 for duration_s in all_seconds)} of {len(all_seconds)}",
            "",
            "",
        ],
        ["longest time", f"{max(all_seconds) / 60.0:.0f} minutes", "", ""],
    ]
    if nothing_seconds:
        table.append(
            ["time where nothing is concealed, median", f"{np.median(nothing_seconds):.0f} s", "", ""]
        )
    effect_seconds = [
        seconds[recording["number"]] for recording in board["each"] if recording["kind"] != "nothing"
    ]
    if effect_seconds:
        table.append(
            ["time where an effect is concealed, median", f"{np.median(effect_seconds):.0f} s", "", ""]
        )
    return rows.markdown(("", "result", "90 % interval", "aim"), table)


def _share_row(what: str, share: Mapping[str, Any], to_reach: str) -> list[str]:
    """Returns the table's row of one share with its interval."""
    if not share["of"]:
        return [what, "not tested", "", to_reach]
    interval = f"{100 * share['low']:.0f} to {100 * share['high']:.0f} %"
    return [what, f"{share['hits']} of {share['of']}, {100 * share['share']:.0f} %", interval, to_reach]


def each(board: Mapping[str, Any]) -> str:
    """Returns a table of the answers where something is concealed, the largest effect first."""
    concealed = [recording for recording in board["each"] if recording["kind"] != "nothing"]
    table = [
        [
            recording["label"],
            f"{recording['size']:.1f}",
            ", ".join(recording["named"]) or f"`{recording['answer']}`",
            _worth(recording),
        ]
        for recording in sorted(concealed, key=lambda recording: -recording["size"])
    ]
    return rows.markdown(("concealed", "size [noise floors]", "named", "judgement"), table)


def nothing(boards: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns a table of false alarms and coverage of the base parameters where nothing is concealed.

    The table has a row for each set, and one for all sets together.
    """
    without_effect = {
        name: [recording for recording in board["each"] if recording["kind"] == "nothing"]
        for name, board in boards.items()
    }
    without_effect["together"] = list(chain.from_iterable(without_effect.values()))
    table = []
    for name, recordings in without_effect.items():
        alarms = share(recording["answer"] != "nothing-missing" for recording in recordings)
        inside = [hit for recording in recordings for hit in recording["inside_base"].values()]
        table.append([
            name, f"{alarms['hits']} of {alarms['of']}",
            f"{100 * alarms['low']:.0f} to {100 * alarms['high']:.0f} %",
            f"{sum(inside)} of {len(inside)}, {100 * np.mean(inside):.0f} %",
        ])  # fmt: skip
    return rows.markdown(("", "false alarms", "90 % interval", "base parameters in 90 % intervals"), table)


def inside(boards: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns a table of the base parameters in their intervals, each and together, by what was concealed."""
    groups: dict[str, list[Mapping[str, bool]]] = {}
    for recording in chain.from_iterable(board["each"] for board in boards.values()):
        is_inside = recording["inside_base"]
        if recording["kind"] == "nothing":
            groups.setdefault("nothing", []).append(is_inside)
        elif recording["right"] and recording["size"] >= CLEAR:
            groups.setdefault("clear, named right", []).append(is_inside)
            groups.setdefault(recording["label"], []).append(is_inside)
        elif recording["answer"] == "nothing-missing" and recording["kind"] != "outside":
            groups.setdefault(f"{recording['label']}, called nothing", []).append(is_inside)
        elif _worth(recording) == "wrong":
            groups.setdefault("a wrong name", []).append(is_inside)
    names = list(next(iter(groups.values()))[0])
    table = []
    for group, group_inside in sorted(groups.items(), key=lambda item: -len(item[1])):
        hits = [sum(is_inside[name] for is_inside in group_inside) for name in names]
        table.append(
            [
                group,
                str(len(group_inside)),
                *map(str, hits),
                f"{sum(hits)} of {len(names) * len(group_inside)}",
            ]
        )
    return rows.markdown(("concealed", "recordings", *names, "together"), table)


def faint(boards: Mapping[str, Mapping[str, Any]], answers: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns a table of the recordings that were called `nothing-missing`, by what was concealed.

    The rows also tell whether a set of mechanisms fitted better than the base model.
    """
    kinds = {
        "nothing": "nothing",
        "alone": "an effect of the catalogue",
        "pair": "an effect of the catalogue",
        "outside": "an effect outside the catalogue",
    }
    called: dict[tuple[str, str], list[Mapping[str, bool]]] = {}
    for name, board in boards.items():
        for recording in board["each"]:
            if recording["answer"] == "nothing-missing":
                set_is_better = "yes" if answers[name][recording["number"]]["best_set"] else "no"
                called.setdefault((kinds[recording["kind"]], set_is_better), []).append(
                    recording["inside_base"]
                )
    table = []
    for (kind, set_is_better), inside in sorted(called.items()):
        hits = share_of_parts(inside)
        table.append([kind, set_is_better, str(len(inside)), f"{hits['hits']} of {hits['of']}"])
    head = ("concealed", "a set fits better", "recordings", "base parameters in 90 % intervals")
    return rows.markdown(head, table)


def sizes(board: Mapping[str, Any]) -> str:
    """Returns a table of how many effects of each mechanism are named right, and of the size required."""
    table = []
    for name, entry in board["by_mechanism"].items():
        answers = list(zip(entry["sizes"], entry["right"], entry["up_to"], strict=True))
        clear = [right for size, right, _ in answers if size >= CLEAR]
        below = [right for size, right, _ in answers if size < CLEAR]
        look_alikes = sum(up_to and not right for _, right, up_to in answers)
        table.append([
            name, f"{min(entry['sizes']):.1f} to {max(entry['sizes']):.1f}", f"{sum(clear)} of {len(clear)}",
            f"{sum(below)} of {len(below)}", str(look_alikes), half_in_words(entry),
        ])  # fmt: skip
    head = ("", "sizes [noise floors]", "clear, named right", "smaller, named right", "a look-alike named",
            "half are named at")  # fmt: skip
    return rows.markdown(head, table)


def _worth(answer: Mapping[str, Any]) -> str:
    """Returns the judgement of one answer in words."""
    if answer["answer"] == "nothing-missing" and answer["size"] < 1.0:
        return "below the floor"
    if answer["kind"] == "outside":
        return "right" if answer["answer"] == "unknown" else ("missed" if not answer["named"] else "wrong")
    if answer["right"]:
        return "right"
    if not answer["named"]:
        return "missed"
    truth = set(answer["label"].split(" + "))
    return "in part" if set(answer["named"]) < truth else "wrong"


def _at(board: Mapping[str, Any], path: Sequence[str]) -> Mapping[str, Any]:
    """Returns the entry of a scoreboard at a path of keys."""
    entry: Any = board
    for key in path:
        entry = entry[key]
    return dict(entry)


def judged(folder: Path) -> bool:
    """Returns True if each recording of a set has a verdict; only then are the keys opened."""
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
        seconds[folder.name] = {number: answer["seconds"] for number, answer in answers[folder.name].items()}
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
    # The verdicts of the other sets are by earlier sources, so they have tables of their own.
    other_boards = {name: board for name, board in boards.items() if name != PROOF.name}
    for mark, group in (("", {PROOF.name: proof}), ("-beside", other_boards)):
        if group:
            tables |= {f"inside{mark}": inside(group), f"faint{mark}": faint(group, answers)}
    for name, table in tables.items():
        rows.into_docs(PAGE, name, table)
        print(table)


if __name__ == "__main__":
    main()
