"""Further tests within a device's limits: variations of the recording's own, and changes of any of these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array, PadMotion, Phase, PhaseKind

MOVING = 0.05  # of the fastest stretch's speed: slower than this the pads stand
STILL_S = (10.0, 60.0)  # shortest and longest hold taken over from the recording
LONG_S = 600.0
BEFORE_S = 5.0  # rest at the start
LEAST_REACH = 0.2  # of the largest displacement that a changed test opens the pads by
CHANGE = 0.7  # sd of the logarithm of what is changed
SHORT_S = 5.0  # added to holds and rests before they are changed by a factor, so that those of 0 s can grow
MOST_CYCLES = 5


@dataclass(frozen=True)
class Limits:
    """The largest displacement [m], slowest and fastest speed [m/s], and longest test [s] of a device."""

    largest_m: float
    speeds_m_s: tuple[float, float]
    longest_s: float


@dataclass(frozen=True)
class Cycle:
    """The pads open at a speed, are held, come back as fast, and rest."""

    reach_m: float
    speed_m_s: float
    hold_s: float
    rest_s: float

    @property
    def seconds(self) -> float:
        return 2.0 * self.reach_m / self.speed_m_s + self.hold_s + self.rest_s

    def within(self, limits: Limits) -> Cycle:
        """The nearest cycle that a device can do."""
        reach_m = float(np.clip(self.reach_m, 0.0, limits.largest_m))
        return replace(self, reach_m=reach_m, speed_m_s=float(np.clip(self.speed_m_s, *limits.speeds_m_s)))


@dataclass(frozen=True)
class Protocol:
    """A test of one cycle after the other, and its name."""

    name: str
    cycles: tuple[Cycle, ...]

    @cached_property
    def motion(self) -> PadMotion:
        """The pads' motion, after a short rest."""
        time_s, displacement_m = [0.0, BEFORE_S], [0.0, 0.0]
        for one in self.cycles:
            ramp_s = one.reach_m / one.speed_m_s
            for lasts_s, level_m in ((ramp_s, one.reach_m), (one.hold_s, one.reach_m), (ramp_s, 0.0),
                                     (one.rest_s, 0.0)):  # fmt: skip
                if lasts_s > 0.0:
                    time_s.append(time_s[-1] + lasts_s)
                    displacement_m.append(level_m)
        return PadMotion(np.array(time_s), np.array(displacement_m))

    @property
    def sentence(self) -> str:
        """The sentence that says what to do."""
        parts = [_said(cycle, len(list(equal))) for cycle, equal in groupby(self.cycles)]
        text = "; then ".join(parts)
        return f"{text[0].upper()}{text[1:]}."

    def within(self, limits: Limits) -> Protocol:
        """The nearest test that a device can do; waits are cut where it would take too long."""
        cycles = [one.within(limits) for one in self.cycles]
        waits_s = sum(one.hold_s + one.rest_s for one in cycles)
        room_s = max(limits.longest_s - BEFORE_S - sum(one.seconds for one in cycles) + waits_s, 0.0)
        share = min(1.0, room_s / waits_s) if waits_s else 1.0
        return Protocol(self.name, tuple(
            replace(one, hold_s=share * one.hold_s, rest_s=share * one.rest_s) for one in cycles
        ))  # fmt: skip


def _said(cycle: Cycle, times: int) -> str:
    start = "one cycle" if times == 1 else f"{times} equal cycles"
    held = f"a hold of {cycle.hold_s:.0f} s" if cycle.hold_s >= 0.5 else "no hold"
    rest = (
        f"{cycle.rest_s:.0f} s at zero displacement after it" if cycle.rest_s >= 0.5 else "no rest after it"
    )
    return (
        f"{start} to {1e3 * cycle.reach_m:.3g} mm at {1e3 * cycle.speed_m_s:.2g} mm/s, with {held} and {rest}"
    )


def variations(motion: PadMotion, limits: Limits) -> tuple[Protocol, ...]:
    """Variations of amplitude, speed, holds and pauses of a recording's own motion, within limits.

    Raises InputError for pads that never move.
    """
    amplitude_m, speed_m_s, hold_s = own(motion)
    ordinary = Cycle(amplitude_m, speed_m_s, hold_s, hold_s)
    small = replace(ordinary, reach_m=0.5 * amplitude_m)
    listed = {
        "same again": [ordinary] * 2,
        "quarter speed": [replace(ordinary, speed_m_s=0.25 * speed_m_s)] * 2,
        "five times faster": [replace(ordinary, speed_m_s=5.0 * speed_m_s)] * 2,
        "one long hold": [replace(ordinary, hold_s=LONG_S)],
        "half displacement": [small] * 2,
        "small, then large": [small, small, ordinary, small, ordinary],
        "long pause": [replace(ordinary, rest_s=LONG_S), ordinary],
        "rests at zero": [replace(ordinary, hold_s=0.0, rest_s=2.0 * STILL_S[1])] * 3,
        "no holds": [replace(ordinary, hold_s=0.0, rest_s=0.0)] * 4,
    }
    return tuple(Protocol(name, tuple(cycles)).within(limits) for name, cycles in listed.items())


def changed(protocol: Protocol, limits: Limits, name: str, rng: np.random.Generator) -> Protocol:
    """Returns a test near another: a cycle more or fewer, and one cycle or all with another shape."""
    cycles = list(protocol.cycles)
    more = int(rng.integers(-1, 2))
    if more > 0 and len(cycles) < MOST_CYCLES:
        cycles.append(cycles[-1])
    elif more < 0 and len(cycles) > 1:
        cycles.pop()
    which = range(len(cycles)) if rng.random() < 0.5 else [int(rng.integers(len(cycles)))]
    factors = np.exp(CHANGE * rng.standard_normal(4))
    for i in which:
        cycles[i] = _scaled(cycles[i], factors, limits)
    return Protocol(name, tuple(cycles)).within(limits)


def _scaled(cycle: Cycle, factors: Array, limits: Limits) -> Cycle:
    reach_m = max(cycle.reach_m * factors[0], LEAST_REACH * limits.largest_m)
    hold_s, rest_s = (
        max((wait_s + SHORT_S) * factor - SHORT_S, 0.0)
        for wait_s, factor in zip((cycle.hold_s, cycle.rest_s), factors[2:], strict=True)
    )
    return Cycle(float(reach_m), float(cycle.speed_m_s * factors[1]), float(hold_s), float(rest_s))


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
