"""Results of studies that were made up, so that each sentence and figure has the numbers that it needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.inference import Convergence, Verdict
from bayeskin.study import (
    Contrast,
    Entry,
    Estimate,
    Overlap,
    ParameterOfPopulation,
    Population,
    Priors,
    Shrunk,
    Spread,
)
from bayeskin.study.layout import Layout
from bayeskin.types import Parameter

STIFFNESS = Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform", stress_power=1)
PERMEABILITY = Parameter("k_s", "m^2", 1e-16, 1e-11, "log-uniform", stress_power=-1)


def about(median: float, factor: float = 1.3) -> Estimate:
    """An estimate with an interval of this factor around its median."""
    return Estimate(median, median / factor, median * factor)


def table(subjects: int = 6, sessions: int = 2, groups: Sequence[str] = ("control", "keloid")) -> list[Entry]:
    """Rows in which subjects belong to the groups in turn."""
    return [
        Entry(
            f"row {j}",
            Path(f"s{j}-{t}.h5"),
            f"s{j}",
            None,
            groups[j % len(groups)] if groups else None,
            str(t),
        )
        for j in range(subjects)
        for t in range(sessions)
    ]


def parameter(layout: Layout, **changes: Any) -> ParameterOfPopulation:
    """A stiffness with well-known numbers, and with these changes."""
    group = layout.group
    contrasts = (Contrast("group", group.values[0], group.values[1], about(1.8, 1.4), 0.97),) if group else ()
    fields: dict[str, Any] = {
        "parameter": STIFFNESS,
        "medians": {name: about(1e5 * (1 + n)) for n, name in enumerate(group.values if group else ("",))},
        "between": Spread(about(0.4)),
        "within": Spread(about(0.1)) if layout.levels else None,
        "repeats": None,
        "contrasts": contrasts,
        "informative": len(layout.recordings),
        "at_lower": 0,
        "at_upper": 0,
    }
    return ParameterOfPopulation(**fields | changes)


def population(
    entries: Sequence[Entry], *changes: dict[str, Any], trusted: bool = True, **further: Any
) -> Population:
    """A result with one parameter for each of the `changes` to the stiffness (none: only the stiffness)."""
    layout = Layout.of(entries)
    parameters = tuple(parameter(layout, **changed) for changed in changes or ({},))
    rng = np.random.default_rng(0)
    recordings, overlaps = [], []
    for n, name in enumerate(layout.recordings):
        group = layout.group.of(n) if layout.group else None
        values = [
            np.exp(0.3 * rng.standard_normal()) * summary.medians[group or ""].median
            for summary in parameters
        ]
        recordings.append(
            Shrunk(
                name, layout.subjects[layout.subject[n]], group, tuple(about(v, 2.0) for v in values),
                tuple(about(v) for v in values),
            )
        )  # fmt: skip
        overlaps.append(Overlap(name, 300.0, 0.2, 0.02))
    verdict = Verdict(trusted, () if trusted else ("R-hat is 1.3",))
    none = np.zeros(1)
    convergence = Convergence(1000, 500, 10, none, none, none, none, (), verdict)
    fields: dict[str, Any] = {"recordings": tuple(recordings), "overlaps": tuple(overlaps)} | further
    return Population(layout, Priors(), parameters, subjects=(), convergence=convergence, **fields)
