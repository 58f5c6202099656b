"""The layout of a study: which recordings share a subject, a session, a group and a site.

The median of a parameter depends on the group and the site of a recording. Around it, subjects differ, then
the sessions of a subject, then the recordings of a session. Only the levels that the table repeats can be
told apart, so a level without repetition is joined with the level below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bayeskin.study.table import Entry
from bayeskin.types import Array, FreezesArrays

Units = NDArray[np.int64]
Repetition = Literal["none", "recordings", "recordings of a session", "sessions", "sessions and recordings"]


@dataclass(frozen=True)
class Level(FreezesArrays):
    """Units that have several members, such as subjects with several recordings.

    unit (N,) : unit of each recording
    parent (n,) : unit of the level above to which each unit belongs; zeros for the highest level
    """

    name: str
    unit: Units
    parent: Units


@dataclass(frozen=True)
class Category(FreezesArrays):
    """A property whose values have different medians.

    value (N,) : number of each recording's value
    column : of the layout's matrix, the first of those for the values after the first, which is the reference
    """

    name: str
    values: tuple[str, ...]
    value: Units
    column: int

    @property
    def further(self) -> int:
        """Returns the number of values after the reference."""
        return len(self.values) - 1

    def of(self, recording: int) -> str:
        """Returns the value of a recording."""
        return self.values[self.value[recording]]


@dataclass(frozen=True)
class Layout(FreezesArrays):
    """The layout of a study of N recordings.

    subjects, subject (N,) : names of the subjects, and the subject of each recording
    group, site : properties with different medians, or None where the table has one value only, or where
        sites cannot be told apart from groups (`site_is_group`)
    matrix (N, p) : an intercept, and a column for each further group and site
    levels : units that have several members, subjects first; the recordings themselves are the last level
    repetition : what the spread within a subject contains
    """

    recordings: tuple[str, ...]
    subjects: tuple[str, ...]
    subject: Units
    group: Category | None
    site: Category | None
    site_is_group: bool
    matrix: Array
    levels: tuple[Level, ...]
    repetition: Repetition

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> Layout:
        """Returns the layout of the rows of a table."""
        subjects, subject = _numbered([entry.subject for entry in entries])
        session = _sessions(entries)
        group = _category("group", entries, 1)
        site = _category("site", entries, 1 + (group.further if group else 0))
        matrix = _matrix(len(entries), group, site)
        confounded = site is not None and np.linalg.matrix_rank(matrix) < matrix.shape[1]
        if confounded:
            site, matrix = None, _matrix(len(entries), group)
        levels = _levels(subject, session)
        return cls(
            tuple(entry.name for entry in entries), subjects, subject, group, site, confounded,
            matrix, levels, _repetition(subject, session, entries[0].session is not None),
        )  # fmt: skip

    @property
    def categories(self) -> tuple[Category, ...]:
        """Returns the group and the site, where they have different medians."""
        return tuple(category for category in (self.group, self.site) if category is not None)

    def row(self, group: str) -> Array:
        """Returns the row (p,) of the matrix of a group ("" without groups), averaged over the sites."""
        row = np.zeros(self.matrix.shape[1])
        row[0] = 1.0
        if self.group is not None and group != self.group.values[0]:
            row[self.group.column + self.group.values.index(group) - 1] = 1.0
        if self.site is not None:
            row[self.site.column : self.site.column + self.site.further] = 1.0 / len(self.site.values)
        return row

    def ancestors(self, lower: int, level: int) -> Units:
        """Returns the unit of `level` to which each unit of the level `lower` belongs."""
        first = np.unique(self.levels[lower].unit, return_index=True)[1]
        return self.levels[level].unit[first]


def _numbered(values: Sequence[object]) -> tuple[tuple[str, ...], Units]:
    """Returns the different values in the order in which they appear, and the number of each value (N,)."""
    number = {value: n for n, value in enumerate(dict.fromkeys(values))}
    return tuple(map(str, number)), np.array([number[value] for value in values], dtype=np.int64)


def _category(name: str, entries: Sequence[Entry], column: int) -> Category | None:
    """Returns the category of a column of the table, or None where it has one value only."""
    values, value = _numbered([getattr(entry, name) for entry in entries])
    return Category(name, values, value, column) if len(values) > 1 else None


def _matrix(count: int, *categories: Category | None) -> Array:
    """Returns the matrix (N, p) of an intercept and the further values of categories."""
    columns = [np.ones(count)]
    for category in categories:
        if category is not None:
            columns += [(category.value == v).astype(float) for v in range(1, len(category.values))]
    return np.stack(columns, axis=1)


def _sessions(entries: Sequence[Entry]) -> Units:
    """Returns the session of each recording (N,); without the column, each recording has its own."""
    if entries[0].session is None:
        return np.arange(len(entries))
    return _numbered([(entry.subject, entry.session) for entry in entries])[1]


def _levels(subject: Units, session: Units) -> tuple[Level, ...]:
    """Returns the levels that have several members and differ from each other."""
    levels = []
    count, sessions, subjects = len(subject), session.max() + 1, subject.max() + 1
    if subjects < count:
        levels.append(Level("subject", subject, np.zeros(subjects, dtype=np.int64)))
    if subjects < sessions < count:
        parent = subject[np.unique(session, return_index=True)[1]]
        levels.append(Level("session", session, parent))
    return tuple(levels)


def _repetition(subject: Units, session: Units, stated: bool) -> Repetition:
    count, sessions, subjects = len(subject), session.max() + 1, subject.max() + 1
    if subjects == count:
        return "none"
    if not stated:
        return "recordings"
    if sessions == subjects:
        return "recordings of a session"
    return "sessions" if sessions == count else "sessions and recordings"
