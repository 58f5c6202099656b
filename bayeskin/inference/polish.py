"""Polishes the maximum on the full model: Gauss-Newton steps, with the force linearised at each full run.

The surrogate's error shifts the most probable point, and on a ridge it shifts it far. The polish starts from
a point of the surrogate's posterior. Each round runs the full model with its derivatives. It then maximises
the posterior with the force linear about that run; the material parameters stay within a trust region, and
the noise is free. The new point is accepted if the full model agrees that it is better. The compared
posterior is exact, because it contains no surrogate and hence no surrogate error.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.inference.optimise import climb
from bayeskin.inference.problem import HELD, LogPosterior
from bayeskin.types import Array, ParameterSpace, Prediction, Simulation

FullRun = Callable[[Mapping[str, float]], Simulation]


@dataclass(frozen=True)
class PolishSettings:
    """Settings of a polish; half-widths are in the logarithm of a parameter, or a share of its prior's range.

    largest, smallest : half-width of the trust region at the start, which is its largest, and the half-width
        below which the polish ends
    shrinks, grows : factors on the half-width after a run that is no better, and after a better one
    enough : gain [nats] below which the polish ends, because so small a gain does not distinguish two points
    """

    largest: float = 1.0
    smallest: float = 0.02
    shrinks: float = 0.25
    grows: float = 2.0
    enough: float = 0.05


@dataclass(frozen=True)
class LinearForce:
    """A `types.Surrogate` without error, whose force is linear about one full run.

    theta (d,) are the run's parameters, force_n (m,) [N] is its force, and gradient_n (m, d) [N] is the
    derivative by the parameters' logarithms. The force is linear in a parameter to which it is almost
    proportional (`Parameter.stress_power` 1), and in the logarithm of other parameters.
    """

    space: ParameterSpace
    edges_s: Array
    theta: Array
    force_n: Array
    gradient_n: Array
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Returns whether each parameter has a derivative, (d,)."""
        return np.any(self.gradient_n != 0.0, axis=0)

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d), with zero error."""
        mean = self.predict_mean(theta)
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns the force (n, m) [N] at theta (n, d)."""
        ratio = np.atleast_2d(np.asarray(theta, dtype=float)) / self.theta
        moduli = np.array([p.stress_power == 1 for p in self.space.parameters])
        change = np.where(moduli, ratio - 1.0, np.log(np.where(self.moves & ~moduli, ratio, 1.0)))
        return np.asarray(self.force_n + np.where(self.moves, change, 0.0) @ self.gradient_n.T)


@dataclass(frozen=True)
class Polished:
    """Result of a polish.

    theta : all parameters (SI) of the best full run
    value : exact log posterior of this run
    gained : nats gained over the start
    runs : (log posterior, full run) of every round, accepted or not
    """

    theta: Mapping[str, float]
    value: float
    gained: float
    runs: Sequence[tuple[float, Simulation]]
    message: str


def polish_map(
    log_posterior: LogPosterior,
    full_run: FullRun,
    start: Mapping[str, float],
    rounds: int = 6,
    settings: PolishSettings = PolishSettings(),
) -> Polished:
    """Returns the maximum by Gauss-Newton from `start` (all parameters, SI), on full runs with derivatives.

    A full run that fails ends the polish with the best point so far, which is `start` for the first run.
    """
    best, value, trust = dict(start), -np.inf, settings.largest
    local: LogPosterior | None = None
    trial, first = dict(start), -np.inf
    runs: list[tuple[float, Simulation]] = []
    for _ in range(rounds):
        run = full_run({name: trial[name] for name in log_posterior.surrogate.space.names})
        if run.status != "ok":
            return Polished(best, value, value - first, runs, f"a full run failed: {run.message}")
        linearised = _linearised(log_posterior, run)
        exact = _maximum(linearised, trial, HELD)  # finds the most probable noise for this run
        runs.append((exact[1], run))
        if exact[1] > value:
            first = exact[1] if len(runs) == 1 else first
            best, value, local = exact[0], exact[1], linearised
            trust = trust if len(runs) == 1 else min(settings.grows * trust, settings.largest)
        else:
            trust *= settings.shrinks
        if local is None or trust < settings.smallest:
            break
        trial, promised = _maximum(local, best, trust)
        if promised - value < settings.enough:
            return Polished(best, value, value - first, runs, f"converged after {len(runs)} full runs")
    return Polished(best, value, value - first, runs, f"stopped after {len(runs)} full runs")


def _linearised(log_posterior: LogPosterior, run: Simulation) -> LogPosterior:
    """Returns the posterior with the force linear about a run, in the same prior box."""
    space, edges = log_posterior.material or log_posterior.surrogate.space, log_posterior.surrogate.edges_s
    columns = dict(zip(run.gradient_names, run.gradient_bin_means(edges).T, strict=True))
    blank = np.zeros(len(edges) - 1)
    gradient = np.stack([columns.get(name, blank) for name in space.names], axis=1)
    theta = np.array([run.theta[name] for name in space.names])
    linear = LinearForce(space, edges, theta, run.bin_means(edges), gradient)
    return replace(log_posterior, surrogate=linear, material=None)


def _maximum(
    about: LogPosterior, centre: Mapping[str, float], trust: float
) -> tuple[dict[str, float], float]:
    """Returns the maximum within `trust` of the centre's material parameters, with the noise free.

    A parameter without a derivative, such as p_init, keeps its value, since the linear force does not depend
    on it.
    """
    linear, narrowed = about.surrogate, []
    assert isinstance(linear, LinearForce)
    for p, moves in zip(linear.space.parameters, linear.moves, strict=True):
        reach = trust if moves else HELD
        middle = float(np.clip(centre[p.name], p.lower, p.upper))
        if p.in_log:
            low, high = middle * np.exp(-reach), middle * np.exp(reach)
        else:
            low, high = middle - reach * (p.upper - p.lower), middle + reach * (p.upper - p.lower)
        narrowed.append(replace(p, lower=max(low, p.lower), upper=min(high, p.upper)))
    maximum = climb(replace(about, material=replace(linear.space, parameters=tuple(narrowed))), centre)
    return dict(maximum.theta), _density(about, maximum.theta)


def _density(about: LogPosterior, theta: Mapping[str, float]) -> float:
    return float(about.log_prob(about.vector(theta)[None])[0])
