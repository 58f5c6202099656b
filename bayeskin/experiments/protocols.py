"""Makes further tests within a device's limits: variations of the recorded test, and random changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array, PadMotion, Phase, PhaseKind


@dataclass(frozen=True)
class ProtocolSettings:
    """Settings of the tests that are made from a recorded one.

    Reading a motion
    moving : share of the largest speed below which pads are still; still pads are at rest, not held, if they
        are within the same share of the travel from the lowest level
    still_s : shortest and longest hold that is taken from the recording [s]

    Variations
    long_s : duration of a long hold or rest [s]
    before_s : rest at the start [s]

    Random changes
    change : sd of the logarithm of the random factors
    least_reach : least displacement of a changed cycle, as a share of the device's largest displacement
    short_s : time [s] that is added to holds and rests before a factor changes them, so that a hold of 0 s
        can grow
    most_cycles : largest number of cycles
    """

    moving: float = 0.05
    still_s: tuple[float, float] = (10.0, 60.0)
    long_s: float = 600.0
    before_s: float = 5.0
    change: float = 0.7
    least_reach: float = 0.2
    short_s: float = 5.0
    most_cycles: int = 5


PROTOCOLS = ProtocolSettings()


@dataclass(frozen=True)
class Limits:
    """The largest displacement [m], slowest and fastest speed [m/s], and longest test [s] of a device."""

    largest_m: float
    speeds_m_s: tuple[float, float]
    longest_s: float


@dataclass(frozen=True)
class Cycle:
    """A cycle: the pads open at a speed, are held, return at the same speed, and rest."""

    reach_m: float
    speed_m_s: float
    hold_s: float
    rest_s: float

    @property
    def seconds(self) -> float:
        return 2.0 * self.reach_m / self.speed_m_s + self.hold_s + self.rest_s

    def within(self, limits: Limits) -> Cycle:
        """Returns the nearest cycle that a device can perform."""
        reach_m = float(np.clip(self.reach_m, 0.0, limits.largest_m))
        return replace(self, reach_m=reach_m, speed_m_s=float(np.clip(self.speed_m_s, *limits.speeds_m_s)))


@dataclass(frozen=True)
class Protocol:
    """A test that consists of consecutive cycles, with its name."""

    name: str
    cycles: tuple[Cycle, ...]

    @cached_property
    def motion(self) -> PadMotion:
        """Returns the pads' motion, which begins with a short rest."""
        time_s, displacement_m = [0.0, PROTOCOLS.before_s], [0.0, 0.0]
        for cycle in self.cycles:
            ramp_s = cycle.reach_m / cycle.speed_m_s
            for lasts_s, level_m in ((ramp_s, cycle.reach_m), (cycle.hold_s, cycle.reach_m), (ramp_s, 0.0),
                                     (cycle.rest_s, 0.0)):  # fmt: skip
                if lasts_s > 0.0:
                    time_s.append(time_s[-1] + lasts_s)
                    displacement_m.append(level_m)
        return PadMotion(np.array(time_s), np.array(displacement_m))

    @property
    def sentence(self) -> str:
        """Returns the sentence that tells the user how to perform the test."""
        parts = [_cycle_in_words(cycle, len(list(equal))) for cycle, equal in groupby(self.cycles)]
        text = "; then ".join(parts)
        return f"{text[0].upper()}{text[1:]}."

    def within(self, limits: Limits) -> Protocol:
        """Returns the nearest test that a device can perform.

        Holds and rests are shortened if the test would take too long.
        """
        cycles = [cycle.within(limits) for cycle in self.cycles]
        waits_s = sum(cycle.hold_s + cycle.rest_s for cycle in cycles)
        total_s = sum(cycle.seconds for cycle in cycles)
        available_s = max(limits.longest_s - PROTOCOLS.before_s - total_s + waits_s, 0.0)
        share = min(1.0, available_s / waits_s) if waits_s else 1.0
        return Protocol(self.name, tuple(
            replace(cycle, hold_s=share * cycle.hold_s, rest_s=share * cycle.rest_s) for cycle in cycles
        ))  # fmt: skip


def _cycle_in_words(cycle: Cycle, times: int) -> str:
    start = "one cycle" if times == 1 else f"{times} equal cycles"
    held = f"a hold of {cycle.hold_s:.0f} s" if cycle.hold_s >= 0.5 else "no hold"
    rest = (
        f"{cycle.rest_s:.0f} s at zero displacement after it" if cycle.rest_s >= 0.5 else "no rest after it"
    )
    return (
        f"{start} to {1e3 * cycle.reach_m:.3g} mm at {1e3 * cycle.speed_m_s:.2g} mm/s, with {held} and {rest}"
    )


def variations(motion: PadMotion, limits: Limits) -> tuple[Protocol, ...]:
    """Returns variations of a recorded motion's amplitude, speed, holds and rests, within the limits.

    Raises InputError for pads that never move.
    """
    amplitude_m, speed_m_s, hold_s = own(motion)
    ordinary = Cycle(amplitude_m, speed_m_s, hold_s, hold_s)
    small = replace(ordinary, reach_m=0.5 * amplitude_m)
    listed = {
        "same again": [ordinary] * 2,
        "quarter speed": [replace(ordinary, speed_m_s=0.25 * speed_m_s)] * 2,
        "five times faster": [replace(ordinary, speed_m_s=5.0 * speed_m_s)] * 2,
        "one long hold": [replace(ordinary, hold_s=PROTOCOLS.long_s)],
        "half displacement": [small] * 2,
        "small, then large": [small, small, ordinary, small, ordinary],
        "long pause": [replace(ordinary, rest_s=PROTOCOLS.long_s), ordinary],
        "rests at zero": [replace(ordinary, hold_s=0.0, rest_s=2.0 * PROTOCOLS.still_s[1])] * 3,
        "no holds": [replace(ordinary, hold_s=0.0, rest_s=0.0)] * 4,
    }
    return tuple(Protocol(name, tuple(cycles)).within(limits) for name, cycles in listed.items())


def changed(protocol: Protocol, limits: Limits, name: str, rng: np.random.Generator) -> Protocol:
    """Returns a random change of a test.

    The new test may have one cycle more or less. In one cycle or in all cycles, the displacement, the speed,
    the hold and the rest are multiplied by random factors.
    """
    cycles = list(protocol.cycles)
    added = int(rng.integers(-1, 2))
    if added > 0 and len(cycles) < PROTOCOLS.most_cycles:
        cycles.append(cycles[-1])
    elif added < 0 and len(cycles) > 1:
        cycles.pop()
    which = range(len(cycles)) if rng.random() < 0.5 else [int(rng.integers(len(cycles)))]
    factors = np.exp(PROTOCOLS.change * rng.standard_normal(4))
    for i in which:
        cycles[i] = _scaled(cycles[i], factors, limits)
    return Protocol(name, tuple(cycles)).within(limits)


def _scaled(cycle: Cycle, factors: Array, limits: Limits) -> Cycle:
    reach_m = max(cycle.reach_m * factors[0], PROTOCOLS.least_reach * limits.largest_m)
    short_s = PROTOCOLS.short_s
    hold_s, rest_s = (
        max((wait_s + short_s) * factor - short_s, 0.0)
        for wait_s, factor in zip((cycle.hold_s, cycle.rest_s), factors[2:], strict=True)
    )
    return Cycle(float(reach_m), float(cycle.speed_m_s * factors[1]), float(hold_s), float(rest_s))


def own(motion: PadMotion) -> tuple[float, float, float]:
    """Returns the amplitude [m], the mean speed of the ramps [m/s] and the median hold [s] of a motion.

    The hold is limited to the range from 10 to 60 s. Raises InputError for pads that never move.
    """
    lasts = np.diff(motion.time_s)
    travel = np.diff(motion.displacement_m)
    speed = np.abs(travel) / lasts
    amplitude = float(np.ptp(motion.displacement_m))
    if amplitude <= 0.0:
        raise InputError("motion", "the pads never move", "it needs at least one ramp")
    moving = speed > PROTOCOLS.moving * speed.max()
    mean_speed = float(np.abs(travel[moving]).sum() / lasts[moving].sum())
    level = 0.5 * (motion.displacement_m[1:] + motion.displacement_m[:-1]) - motion.displacement_m.min()
    held = ~moving & (level > PROTOCOLS.moving * amplitude)
    runs = np.split(np.arange(len(lasts)), np.flatnonzero(np.diff(held)) + 1)
    holds = [float(lasts[run].sum()) for run in runs if held[run[0]]]
    return amplitude, mean_speed, float(np.clip(np.median(holds) if holds else 0.0, *PROTOCOLS.still_s))


def phases_of(motion: PadMotion) -> tuple[Phase, ...]:
    """Returns the phases of a piecewise-linear motion: rest near the lowest level, load, hold and unload."""
    travel = np.diff(motion.displacement_m)
    lowest, reach = float(motion.displacement_m.min()), float(np.ptp(motion.displacement_m))
    phases: list[Phase] = []
    cycle, turned = 0, True  # a loading after an unloading or a rest begins a cycle
    for i, step in enumerate(travel):
        kind: PhaseKind = "load" if step > 0.0 else "unload"
        if step == 0.0:
            kind = "hold" if motion.displacement_m[i] - lowest > PROTOCOLS.moving * reach else "rest"
        if kind == "load" and turned:
            cycle, turned = cycle + 1, False
        turned = turned or kind in ("unload", "rest")
        phases.append(Phase(kind, cycle, float(motion.time_s[i]), float(motion.time_s[i + 1])))
    return tuple(phases)
