"""Writes the answer of `bayeskin prove` as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def in_words(document: Mapping[str, Any]) -> str:
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


def _share(share: Mapping[str, Any]) -> str:
    """Returns a share with its interval as text."""
    if not share["of"]:
        return "none"
    low, high = 100 * share["low"], 100 * share["high"]
    return f"{share['hits']} of {share['of']}, {100 * share['share']:.0f} % ({low:.0f} to {high:.0f})"
