"""Provides the library of terms for the form of a mismatch: functions of the test's state over time.

The state is displacement, speed, time, cycle, phase and force. Coefficients are printed in units of mN, mm
and s. Each function is evaluated at several times inside a bin and averaged. The memory of displacement over
tau is

    m(t) = int_0^t exp(-(t - s) / tau) du(s) .
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayeskin.mismatch.unexplained import Place, Unexplained, place
from bayeskin.types import PHASE_IN_WORDS, Array, PadMotion, Phase, PhaseKind
from bayeskin.types.joint import recording_at


@dataclass(frozen=True)
class LibrarySettings:
    """Settings of the library of terms.

    points : number of times inside a bin at which a function is evaluated
    taus_s : times of memories and of exponential relaxations [s], about three to a decade
    log_taus_s : times of logarithmic relaxations [s]
    """

    points: int = 8
    taus_s: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0, 100.0)
    log_taus_s: tuple[float, ...] = (1.0, 10.0)


@dataclass(frozen=True)
class Term:
    """One function of the library.

    name : the function in words; values : its values (k,) in SI
    unit : SI unit of its coefficient, which is a force divided by the function
    shown_unit, shown : unit in which the coefficient is printed, and the factor that converts SI to it
    """

    name: str
    unit: str
    shown_unit: str
    shown: float
    values: Array


# For the unit of a term: the SI unit of its coefficient, the unit in which it is printed, and the factor.
_UNITS = {
    "1": ("N", "mN", 1e3),
    "m": ("N/m", "mN/mm", 1.0),
    "m^2": ("N/m^2", "mN/mm^2", 1e-3),
    "m/s": ("N s/m", "mN s/mm", 1.0),
    "s": ("N/s", "mN/s", 1e3),
    "m s": ("N/(m s)", "mN/(mm s)", 1.0),
    "N": ("1", "%", 1e2),
    "N^2": ("1/N", "1/N", 1.0),
    "N s": ("1/s", "%/s", 1e2),
}


def library(
    remainder: Unexplained, edges_s: Array, phases: tuple[Phase, ...], motion: PadMotion,
    settings: LibrarySettings = LibrarySettings(),
) -> list[Term]:  # fmt: skip
    """Returns all terms on the fitted bins of a recording, the simpler ones first."""
    start, end = edges_s[remainder.bins], edges_s[remainder.bins + 1]
    share = (np.arange(settings.points) + 0.5) / settings.points
    time_s = start[:, None] + share * (end - start)[:, None]
    starts = np.array([p.start_s for p in phases])
    phase = np.clip(np.searchsorted(starts, time_s, side="right") - 1, 0, len(phases) - 1)
    at = place(time_s, phase, phases, motion)
    return [
        Term(name, *_UNITS[unit], np.broadcast_to(values, time_s.shape).mean(axis=1))
        for name, unit, values in _functions(at, remainder.force_n[:, None], motion, settings)
    ]


def _functions(
    at: Place, force_n: Array, motion: PadMotion, settings: LibrarySettings
) -> Iterator[tuple[str, str, Array]]:
    """Yields the name, the unit and the values at times (k, points) of each function."""
    u, direction = at.displacement_m, at.direction
    cycles_done = np.maximum(at.cycle - 1.0, 0.0)
    in_first_cycle = (at.cycle <= 1.0).astype(float)
    yield "a constant", "1", np.ones_like(u)
    yield "the direction of motion", "1", direction
    yield "displacement", "m", u
    yield "time", "s", at.time_s
    yield "cycles done", "1", cycles_done
    for kind in ("hold", "rest", "load", "unload"):
        yield f"a constant {PHASE_IN_WORDS[kind]}", "1", (at.kind == kind).astype(float)
    yield "speed", "m/s", at.speed_m_s
    yield "the model's force", "N", force_n * np.ones_like(u)
    yield "displacement squared", "m^2", u**2
    yield "displacement with the sign of motion", "m", u * direction
    yield "displacement in the first cycle", "m", u * in_first_cycle
    yield "displacement while loading in the first cycle", "m", u * in_first_cycle * (at.kind == "load")
    yield "displacement times cycles done", "m", u * cycles_done
    yield "displacement times time", "m s", u * at.time_s
    yield "the model's force squared", "N^2", force_n**2 * np.ones_like(u)
    yield "the model's force with the sign of motion", "N", force_n * direction
    yield "the model's force times cycles done", "N", force_n * cycles_done
    yield "the model's force times time", "N s", force_n * at.time_s
    for tau_s in settings.taus_s:
        yield f"memory of displacement over {tau_s:g} s", "m", memory(motion, at.time_s, tau_s)
    still: tuple[PhaseKind, ...] = ("hold", "rest")
    for kind in still:
        inside = (at.kind == kind) & (at.cycle > 0)
        for tau_s in settings.taus_s:
            name = f"1 − exp(−t / {tau_s:g} s) {PHASE_IN_WORDS[kind]}"
            yield name, "1", inside * -np.expm1(-at.since_s / tau_s)
        for tau_s in settings.log_taus_s:
            yield (
                f"log(1 + t / {tau_s:g} s) {PHASE_IN_WORDS[kind]}",
                "1",
                inside * np.log1p(at.since_s / tau_s),
            )


def memory(motion: PadMotion, time_s: Array, tau_s: float) -> Array:
    """Returns the memory of displacement m(t) [m] at times of any shape; exact for straight stretches."""
    if motion.spans:
        out, recording = np.empty(time_s.shape), recording_at(motion.spans, time_s)
        for number, (part, span) in enumerate(zip(motion.parts, motion.spans, strict=True)):
            out[recording == number] = memory(part, time_s[recording == number] - span.start_s, tau_s)
        return out
    speed = np.diff(motion.displacement_m) / np.diff(motion.time_s)
    corners = [0.0]
    for v, lasts_s in zip(speed, np.diff(motion.time_s), strict=True):
        corners.append(v * tau_s + (corners[-1] - v * tau_s) * float(np.exp(-lasts_s / tau_s)))
    stretch = np.clip(np.searchsorted(motion.time_s, time_s, side="right") - 1, 0, len(speed) - 1)
    ends, began = speed[stretch] * tau_s, np.array(corners)[stretch]
    return np.asarray(ends + (began - ends) * np.exp(-(time_s - motion.time_s[stretch]) / tau_s))
