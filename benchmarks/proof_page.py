"""The scoreboard of the shipped proof as tables of docs/mismatch.md, and its figure.

    python benchmarks/proof_page.py

Scores the stored verdicts (`bayeskin prove --at-most 0`), diagnoses nothing, and writes between the markers
of the page.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rows
from demo_gallery import FIGURES, smaller

from bayeskin.pipeline.engine import Silent
from bayeskin.pipeline.proof import prove

PAGE = Path(__file__).parents[1] / "docs" / "mismatch.md"
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
    table = []
    for what, path, to_reach in SHARES:
        one = _at(board, path)
        found, interval = "none", ""
        if one["of"]:
            found = f"{one['hits']} of {one['of']}, {100 * one['share']:.0f} %"
            interval = f"{100 * one['low']:.0f} to {100 * one['high']:.0f} %"
        table.append([what, found, interval, to_reach])
    for what, path, to_reach in MEDIANS:
        one = _at(board, path)
        table.append([f"{what}, median", f"{one['median']:.2f} of {one['of']}", "", to_reach])
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
        ["where nothing is concealed, median", f"{np.median(nothing):.0f} s", "", ""],
    ]
    return rows.markdown(("", "found", "90 % interval", "to reach"), table)


def each(board: Mapping[str, Any]) -> str:
    """What was answered where something is concealed, the largest effect first."""
    concealed = [one for one in board["each"] if one["kind"] != "nothing"]
    table = [
        [one["label"], f"{one['size']:.1f}", ", ".join(one["named"]) or f"`{one['answer']}`", _worth(one)]
        for one in sorted(concealed, key=lambda one: -one["size"])
    ]
    return rows.markdown(("concealed", "size [noise floors]", "named", ""), table)


def _worth(one: Mapping[str, Any]) -> str:
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


def main() -> None:
    made = prove(None, Silent(), at_most=0)
    folder = Path(made["folder"])
    seconds = {
        path.stem: json.loads(path.read_text())["answer"]["seconds"]
        for path in sorted((folder / "verdicts").glob("*.json"))
    }
    for name, table in (("proof", scores(made["scoreboard"], seconds)), ("each", each(made["scoreboard"]))):
        rows.into_docs(PAGE, name, table)
        print(table)
    smaller(folder / "scoreboard.png", FIGURES / "proof.png")


if __name__ == "__main__":
    main()
