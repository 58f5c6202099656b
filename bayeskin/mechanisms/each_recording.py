"""Gives each of several recordings its own values of a mechanism of the instrument."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from bayeskin.mechanisms.mechanism import Instrument, Mechanism
from bayeskin.types.joint import own_name, plain_name, values_in


def in_each_recording(mechanism: Mechanism, recordings: Sequence[str]) -> Mechanism:
    """Returns the mechanism with its parameters once for each recording, given by name.

    Each recording switches it on by itself. A mechanism of the skin or of the arm is returned unchanged,
    because recordings of one skin share it.
    """
    if not isinstance(mechanism.act, Instrument) or mechanism.act.of_skin or len(recordings) < 2:
        return mechanism
    numbers = range(len(recordings))

    def statement(values: Mapping[str, float]) -> str:
        return " ".join(
            f"In {name}: {mechanism.statement(values_in(values, number))}"
            for number, name in enumerate(recordings)
        )

    return replace(
        mechanism,
        parameters=tuple(
            replace(p, name=own_name(p.name, number), description=f"{p.description}, in {recordings[number]}")
            for number in numbers
            for p in mechanism.parameters
        ),
        neutral={
            own_name(name, number): value for number in numbers for name, value in mechanism.neutral.items()
        },
        statement=statement,
        parts=tuple(
            tuple(own_name(name, number) for name in part)
            for number in numbers
            for part in mechanism.whole_or_parts
        ),
    )


def in_one_recording(mechanism: Mechanism) -> Mechanism:
    """Returns the mechanism with plain names, as it acts in one of several recordings.

    This is the inverse of `in_each_recording`, except for the statement.
    """
    parameters = tuple(p for p in mechanism.parameters if p.name == plain_name(p.name))
    names = {p.name for p in parameters}
    return replace(
        mechanism,
        parameters=parameters,
        neutral={name: value for name, value in mechanism.neutral.items() if name in names},
        parts=tuple(part for part in mechanism.parts if set(part) <= names),
    )
