"""A skin in closed form in the reduced model's place: it solves `stiffness-drift`, and knows its derivatives.

Two springs, each with a share that relaxes as its fluid flows; moduli and permeabilities act together only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from bayeskin.design import default_space
from bayeskin.forward import reduced
from bayeskin.forward.interface import ModelRun
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import observed
from bayeskin.mismatch import context
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.reduced.region import REGION
from bayeskin.types import (
    Array,
    BinnedForce,
    Jumps,
    PadMotion,
    ParameterSpace,
    Phase,
    Prediction,
    Simulation,
    frozen_array,
)

MOTION = PadMotion(
    np.array([0.0, 4.0, 8.0, 25.0, 29.0, 50.0, 58.0, 66.0]),
    1e-3 * np.array([0.0, 0.0, 4.0, 4.0, 8.0, 8.0, 0.0, 0.0]),
)
_KINDS = ("rest", "load", "hold", "load", "hold", "unload", "rest")
PHASES = tuple(
    Phase(kind, 1, float(a), float(b))
    for kind, a, b in zip(_KINDS, MOTION.time_s[:-1], MOTION.time_s[1:], strict=True)
)
EDGES_S = np.arange(0.0, 66.5, 0.5)
NO_WORD = Jumps(np.zeros(1), np.full(1, -np.inf), np.full(1, np.inf))  # of samples on any jump
TRUTH = {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0}
NOISE_N = 1e-3
BASE = default_space()
KNOWN = {name: catalogue()[name] for name in ("force-offset", "sensor-drift", "stiffness-drift")}
TIME_S = np.unique(np.concatenate([np.arange(0.0, 66.125, 0.125), MOTION.time_s]))


def force(values: Mapping[str, ArrayLike], time_s: Array = TIME_S) -> Array:
    """Force [N] (n, t) at parameters (n,) or scalars, SI."""
    v = {name: np.atleast_1d(np.asarray(value, dtype=float))[:, None] for name, value in values.items()}
    open_ = MOTION.at(time_s) / 0.01
    cutis, subcutis = 2e-6 * v["E_c"], 4e-6 * v["E_s"]
    flows_c = 3.0 * np.sqrt(2e-9 / (v["k_c"] * v["E_c"]))
    flows_s = 12.0 * np.sqrt(3e-9 / (v["k_s"] * v["E_s"]))
    whole = cutis * (open_ + 0.5 * open_**2 + 0.2 * _relaxing(flows_c, time_s))
    whole = whole + subcutis * (open_ + 0.4 * _relaxing(flows_s, time_s))
    whole = whole + 1e-5 * v["p_init"] * (1.0 - np.exp(-time_s / 5.0)) * np.exp(-time_s / 20.0)
    if "stiffness_rate" not in v:
        return np.asarray(whole)
    lasts_s = v["stiffness_time"]
    return np.asarray(whole * (1.0 - v["stiffness_rate"] * lasts_s * np.expm1(-time_s / lasts_s)))


def _relaxing(tau_s: Array, time_s: Array) -> Array:
    """The opening that is not yet relaxed, (n, t)."""
    rate = np.diff(MOTION.displacement_m) / 0.01 / np.diff(MOTION.time_s)
    out = np.zeros((len(tau_s), len(time_s)))
    for start, end, speed in zip(MOTION.time_s[:-1], MOTION.time_s[1:], rate, strict=True):
        since, after = np.maximum(time_s - start, 0.0), np.maximum(time_s - end, 0.0)
        out += speed * tau_s * (np.exp(-after / tau_s) - np.exp(-since / tau_s))
    return out


def simulate(
    model: object, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[Mechanism],
    gradients: Mapping[str, float] | None = None, *, least_stiffness: float,
) -> Simulation:  # fmt: skip
    """Has the signature of `simulate_reduced`."""
    assert least_stiffness < REGION.least_stiffness
    slopes = []
    for name, by in (gradients or {}).items():
        ends = {**theta, name: theta[name] + 1e-5 * by * np.array([-1.0, 1.0])}
        back, ahead = force({key: np.broadcast_to(value, 2) for key, value in ends.items()})
        slopes.append((ahead - back) / 2e-5)
    return Simulation(
        theta=dict(theta), time_s=TIME_S, displacement_m=motion.at(TIME_S), force_n=force(theta)[0],
        corner=frozen_array(np.isin(TIME_S, MOTION.time_s), bool), status="ok", message="",
        stats={}, model_hash="toy", gradient_names=tuple(gradients or ()),
        gradient_n=np.array(slopes).T if slopes else np.zeros((0, 0)),
    )  # fmt: skip


class Exact:
    """The toy itself as a surrogate of a space that has its parameters."""

    def __init__(self, space: ParameterSpace) -> None:
        self.space, self.edges_s, self.provenance = space, EDGES_S, {"model": "solved"}

    def predict(self, theta: ArrayLike) -> Prediction:
        mean = self.predict_mean(theta)
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        rows = np.atleast_2d(np.asarray(theta, dtype=float))
        return means(dict(zip(self.space.names, rows.T, strict=True)))


def means(values: Mapping[str, ArrayLike]) -> Array:
    """Means of the toy's force over bins, (n, m)."""
    corner = frozen_array(np.isin(TIME_S, MOTION.time_s), bool)
    return np.array([
        Simulation({}, TIME_S, MOTION.at(TIME_S), row, corner, "ok", "", {}, "toy").bin_means(EDGES_S)
        for row in force(values)
    ])  # fmt: skip


def recorded(seed: int, friction_n: float = 0.0, **values: float) -> BinnedForce:
    """Bins of the toy with mechanisms at work, of these values, and white noise.

    friction_n : of the device, which no mechanism of the toy knows
    """
    acting = [m for m in KNOWN.values() if {p.name for p in m.parameters} & set(values)]
    own = {name: value for m in acting for name, value in {**m.neutral, **values}.items()}
    skin = means({**TRUTH, **{name: own[name] for name in own if name.startswith("stiffness")}})
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    at = {name: np.array([value]) for name, value in own.items()}
    more = observed(acting, at, MOTION, lambda t: np.zeros((1, np.shape(t)[-1])))(middle)
    rng, count = np.random.default_rng(seed), len(middle)
    moves = np.sign(MOTION.at(EDGES_S[1:]) - MOTION.at(EDGES_S[:-1]))
    force_n = skin[0] + more[0] + friction_n * moves + NOISE_N * rng.standard_normal(count)
    phase = np.searchsorted([part.end_s for part in PHASES], middle)
    return BinnedForce(EDGES_S, force_n, np.full(count, NOISE_N**2), np.zeros(count - 1), phase, PHASES)


@dataclass(frozen=True)
class Full:
    """Stands for `FullForce`, by a function of values."""

    force: Callable[[Mapping[str, float]], Array | str]

    def __call__(self, case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
        return self.force(case[1])


def bench(
    patch: pytest.MonkeyPatch, binned: BinnedForce, base: ParameterSpace = BASE,
    full: Callable[[Mapping[str, float]], Array | str] = lambda values: means(values)[0],
) -> DiagnosisContext:  # fmt: skip
    """A diagnosis's bench whose reduced model is the toy, and whose full model is a function of values."""
    model: Any = SimpleNamespace(
        trained=SimpleNamespace(geometry=Geometry(), mechanisms={"stiffness-drift": None}),
        refinement=2, hash="toy",
    )  # fmt: skip
    patch.setattr(reduced, "simulate_reduced", simulate)
    patch.setattr(context, "FullForce", lambda spec, motion, edges_s: Full(full))
    forward = reduced.ReducedForward(model, MOTION, binned.edges_s)
    return DiagnosisContext(binned, NO_WORD, MOTION, forward, base, 1)


def a_run(bench: DiagnosisContext, names: Sequence[str] = (), **values: float) -> ModelRun:
    """Returns a run with derivatives, at the truth except for these values."""
    neutral = {name: value for mechanism in names for name, value in KNOWN[mechanism].neutral.items()}
    run = bench.run(names, {**neutral, **TRUTH, **values})
    assert isinstance(run, ModelRun)
    return run
