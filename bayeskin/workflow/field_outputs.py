"""Writes the fields of a run: a time series for ParaView, and a figure at chosen moments of the protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.finite_element.fields import FieldWriter, StatesAt
from bayeskin.finite_element.problem import Problem
from bayeskin.finite_element.surface import PARTS, seen_surface, surface_state
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Phase

_PHASE_NAMES = {"rest": "rest", "load": "loading", "hold": "hold", "unload": "unloading"}
_CAPTION = (
    "Part of the modelled quarter near the pads, deformed, to scale (axes: 5 mm). Thick lines: pad, and the "
    "guard around it. The planes of symmetry, x=0 and y=0, show the cutis above the subcutis. Arrows: "
    "direction of the velocity, all of equal length. Below each panel: range of its values."
)


class FieldOutputs:
    """Collects the states of one run for both outputs.

    Give `on_state` to `simulate`, and call `write` after the run.

    fields, figures : folders of the time series and of the figure, or None where the output is not wanted
    moments : the times [s] of the figure's rows, increasing, and for each the phase that takes place then
    """

    def __init__(
        self,
        problem: Problem,
        theta: Mapping[str, float],
        motion: PadMotion,
        moments: Mapping[float, str],
        fields: Path | None,
        figures: Path | None,
    ) -> None:
        self._problem, self._theta, self._motion, self._moments = problem, theta, motion, moments
        self._figures = figures
        self._writer = FieldWriter(fields, problem, theta) if fields else None
        self._states = StatesAt(tuple(moments), problem, theta["p_init"])

    def on_state(self, time_s: float, x: Array, force_n: float) -> None:
        """Takes the next state of the run."""
        self._states.on_state(time_s, x, force_n)
        if self._writer:
            self._writer.on_state(time_s, x, force_n)

    def write(self, provenance: str) -> list[Path]:
        """Writes the requested outputs and returns their files.

        The figure is drawn before any file is written.
        """
        files: list[Path] = []
        if self._figures:
            figure = field_figure(
                self._problem, self._theta, self._moments, self._states.states, self._motion
            )
            files += report.save_figure(figure, self._figures / "fields", provenance)
        return files + (list(self._writer.write()) if self._writer else [])


def moments_of(phases: Sequence[Phase], motion: PadMotion, at_s: Sequence[float] = ()) -> dict[float, str]:
    """Returns increasing times [s] and a description of the protocol at each of them.

    These are the given times, or else four characteristic moments: the end of the first loading, the middle
    of the hold, the end of the unloading, and the middle of the last phase. Raises InputError for a time
    outside the motion.
    """
    end_s = float(motion.time_s[-1])
    for time_s in at_s:
        if not 0.0 <= time_s <= end_s:
            raise InputError(
                f"--at {time_s:g}", "this is not a time of the test", f"use a time from 0 to {end_s:g} s"
            )
    if at_s:
        return {time_s: _during(phases, time_s) for time_s in sorted(set(at_s))}
    first = {phase.kind: phase for phase in reversed(phases)}
    chosen = [
        (first[kind], share)
        for kind, share in (("load", 1.0), ("hold", 0.5), ("unload", 1.0))
        if kind in first
    ]
    moments = {}
    for phase, share in [*chosen, (phases[-1], 0.5)]:
        time_s = phase.start_s + share * (phase.end_s - phase.start_s)
        if share == 1.0:  # the corner of the protocol, whose time may be rounded
            time_s = float(motion.time_s[np.abs(motion.time_s - time_s).argmin()])
        word = "end" if share == 1.0 else "middle"
        moments[min(time_s, end_s)] = f"{word} of {_PHASE_NAMES[phase.kind]} {phase.cycle}"
    return dict(sorted(moments.items()))


def _during(phases: Sequence[Phase], time_s: float) -> str:
    """Returns the name and cycle of the phase at a time."""
    phase = next((p for p in phases if time_s <= p.end_s), phases[-1])
    return f"{_PHASE_NAMES[phase.kind]} {phase.cycle}"


def field_figure(
    problem: Problem,
    theta: Mapping[str, float],
    moments: Mapping[float, str],
    states: Sequence[Array],
    motion: PadMotion,
) -> Figure:
    """Returns a figure of displacement, pressure and fluid flow on the deformed quarter.

    states : the unknowns (dofs,) of the model at each of the moments
    """
    surface = seen_surface(problem)
    seen = [surface_state(problem, theta, surface, x) for x in states]
    pressure_kpa = 1e-3 * np.array([state.pressure_pa for state in seen])
    velocity = np.array([state.velocity_m_s for state in seen])
    columns = [
        report.SurfaceField("displacement", "mm", 1e3 * np.array([state.displacement_m for state in seen])),
        report.SurfaceField("pressure", "kPa", pressure_kpa, signed=True),
        report.SurfaceField(
            "fluid velocity relative to solid",
            "µm/s",
            1e6 * np.linalg.norm(velocity, axis=-1),
            directions=velocity,
        ),
    ]
    pad = surface.part == PARTS.index("pad")  # the pads, which may move less than the drive
    labels = [
        f"{number(time_s, 4)} s\n{phase}\npads at {1e3 * state.displacement_m[pad].mean():.2f} mm"
        for (time_s, phase), state in zip(moments.items(), seen, strict=True)
    ]
    return report.figure_fields(
        labels,
        [state.points_m for state in seen],
        surface.faces,
        surface.part + len(PARTS) * surface.plane,
        [PARTS.index("pad"), PARTS.index("guard")],
        columns,
        _pressure_extremes(moments, pressure_kpa),
        _CAPTION,
    )


def _pressure_extremes(moments: Mapping[float, str], pressure_kpa: Array) -> str:
    """Returns a sentence with the lowest and highest pressure and their moments, from values (t, f) [kPa]."""
    rows = list(moments.items())
    low, high = int(pressure_kpa.min(axis=1).argmin()), int(pressure_kpa.max(axis=1).argmax())
    lowest, highest = (
        f"{number(value, 3)} kPa ({number(rows[row][0], 4)} s, {rows[row][1]})"
        for value, row in ((pressure_kpa[low].min(), low), (pressure_kpa[high].max(), high))
    )
    return f"Pressure from {lowest} to {highest}"
