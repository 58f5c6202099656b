"""A short list of further tests, each a variation of the recording's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array, PadMotion, Phase, PhaseKind

MOVING = 0.05  # of the fastest stretch's speed: slower than this the pads stand
STILL_S = (10.0, 60.0)  # shortest and longest hold taken over from the recording
LONG_S = 600.0
BEFORE_S = 5.0  # rest at the start


@dataclass(frozen=True)
class Protocol:
    """A test: its name, the pads' motion, and what to do in one sentence."""

    name: str
    motion: PadMotion
    sentence: str

    @property
    def seconds(self) -> float:
        return float(self.motion.time_s[-1])


def protocols(motion: PadMotion) -> tuple[Protocol, ...]:
    """Variations of amplitude, speed, holds and pauses of a recording's own motion.

    Raises InputError for pads that never move.
    """
    amplitude, speed, hold = own(motion)
    mm, mm_s = 1e3 * amplitude, 1e3 * speed

    def cycle(reach: float = 1.0, pace: float = 1.0, held_s: float = hold, rest_s: float = hold) -> Array:
        ramp_s = reach * amplitude / (pace * speed)
        return np.array([[ramp_s, reach], [held_s, reach], [ramp_s, 0.0], [rest_s, 0.0]])

    ordinary = cycle()
    steps = {
        "same again": (
            [ordinary, ordinary],
            f"Two cycles to {mm:.3g} mm at {mm_s:.2g} mm/s with holds of {hold:.0f} s.",
        ),
        "quarter speed": (
            [cycle(pace=0.25)] * 2,
            f"The same two cycles at {mm_s / 4:.2g} mm/s, a quarter of the speed.",
        ),
        "five times faster": (
            [cycle(pace=5.0)] * 2,
            f"The same two cycles at {5 * mm_s:.2g} mm/s, five times the speed.",
        ),
        "one long hold": (
            [cycle(held_s=LONG_S)],
            f"One cycle to {mm:.3g} mm, held for {LONG_S:.0f} s.",
        ),
        "half displacement": (
            [cycle(reach=0.5)] * 2,
            f"The same two cycles to {mm / 2:.3g} mm only.",
        ),
        "small, then large": (
            [cycle(reach=reach) for reach in (0.5, 0.5, 1.0, 0.5, 1.0)],
            f"Five cycles to {mm / 2:.3g}, {mm / 2:.3g}, {mm:.3g}, {mm / 2:.3g} and {mm:.3g} mm.",
        ),
        "long pause": (
            [cycle(rest_s=LONG_S), ordinary],
            f"The same two cycles with a pause of {LONG_S:.0f} s at zero displacement between them.",
        ),
        "rests at zero": (
            [cycle(held_s=0.0, rest_s=2 * STILL_S[1])] * 3,
            f"Three cycles without holds, each followed by {2 * STILL_S[1]:.0f} s at zero displacement.",
        ),
        "no holds": (
            [cycle(held_s=0.0, rest_s=0.0)] * 4,
            f"Four cycles to {mm:.3g} mm that turn back at once.",
        ),
    }
    return tuple(Protocol(name, _joined(parts, amplitude), words) for name, (parts, words) in steps.items())


def own(motion: PadMotion) -> tuple[float, float, float]:
    """Amplitude [m], speed [m/s] and usual hold [s] of a motion; holds between 10 and 60 s."""
    lasts = np.diff(motion.time_s)
    travel = np.diff(motion.displacement_m)
    speed = np.abs(travel) / lasts
    amplitude = float(np.ptp(motion.displacement_m))
    if amplitude <= 0.0:
        raise InputError("motion", "pads that never move", "at least one ramp")
    moving = speed > MOVING * speed.max()
    usual = float(np.abs(travel[moving]).sum() / lasts[moving].sum())
    level = 0.5 * (motion.displacement_m[1:] + motion.displacement_m[:-1]) - motion.displacement_m.min()
    held = ~moving & (level > MOVING * amplitude)
    runs = np.split(np.arange(len(lasts)), np.flatnonzero(np.diff(held)) + 1)
    holds = [float(lasts[run].sum()) for run in runs if held[run[0]]]
    return amplitude, usual, float(np.clip(np.median(holds) if holds else 0.0, *STILL_S))


def phases_of(motion: PadMotion) -> tuple[Phase, ...]:
    """Phases of a motion of straight stretches: rest at its lowest level, load, hold and unload."""
    travel = np.diff(motion.displacement_m)
    lowest, reach = float(motion.displacement_m.min()), float(np.ptp(motion.displacement_m))
    found: list[Phase] = []
    cycle, turned = 0, True  # a loading after an unloading or a rest begins a cycle
    for i, step in enumerate(travel):
        kind: PhaseKind = "load" if step > 0.0 else "unload"
        if step == 0.0:
            kind = "hold" if motion.displacement_m[i] - lowest > MOVING * reach else "rest"
        if kind == "load" and turned:
            cycle, turned = cycle + 1, False
        turned = turned or kind in ("unload", "rest")
        found.append(Phase(kind, cycle, float(motion.time_s[i]), float(motion.time_s[i + 1])))
    return tuple(found)


def _joined(parts: list[Array], amplitude: float) -> PadMotion:
    """A rest, then stretches of (duration [s], level it ends at, of the amplitude); empty ones left out."""
    steps = np.concatenate([[[BEFORE_S, 0.0]], *parts])
    steps = steps[steps[:, 0] > 0.0]
    time_s = np.concatenate([[0.0], np.cumsum(steps[:, 0])])
    return PadMotion(time_s, amplitude * np.concatenate([[0.0], steps[:, 1]]))
