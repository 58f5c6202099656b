"""The maximum polished on the full model itself: Gauss-Newton, the force linearised at each full run.

The surrogate's error moves the most probable point; on a ridge, far. From a point of the surrogate's, each
round runs the full model with its derivatives, maximises the posterior with the force linear about that run
(material within a trust region, noise free), and takes the new point if the full model agrees that it is
better. The posterior compared is the exact one: no surrogate, so no surrogate error in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.inference.optimise import climb
from bayeskin.inference.problem import LogPosterior
from bayeskin.types import Array, ParameterSpace, Prediction, Simulation

FullRun = Callable[[Mapping[str, float]], Simulation]

TRUST, SMALLEST_TRUST, RUN_ITSELF = 1.0, 0.02, 1e-9  # of a logarithm, either side
ENOUGH = 0.05  # nats still to be gained: far below what tells two points apart


@dataclass(frozen=True)
class LinearForce:
    """A `types.Surrogate` without error: the force linear about one full run.

    theta (d,) of the run, force_n (m,), gradient_n (m, d) by logarithms. Linear in what the force is all but
    proportional to (`Parameter.stress_power` 1), else in the logarithm.
    """

    space: ParameterSpace
    edges_s: Array
    theta: Array
    force_n: Array
    gradient_n: Array
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Whether each parameter has a derivative, (d,)."""
        return np.any(self.gradient_n != 0.0, axis=0)

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d)."""
        mean = self.predict_mean(theta)
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Force (n, m) at theta (n, d)."""
        ratio = np.atleast_2d(np.asarray(theta, dtype=float)) / self.theta
        moduli = np.array([p.stress_power == 1 for p in self.space.parameters])
        change = np.where(moduli, ratio - 1.0, np.log(np.where(self.moves & ~moduli, ratio, 1.0)))
        return np.asarray(self.force_n + np.where(self.moves, change, 0.0) @ self.gradient_n.T)


@dataclass(frozen=True)
class Polished:
    """theta: all parameters (SI) of the best full run; value: its exact log posterior; gained: on the start.

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
) -> Polished:
    """Gauss-Newton from `start` (all parameters, SI) on runs of the full model that carry derivatives.

    A full run that fails ends the polish with the best point so far; the first one failing leaves the start.
    """
    best, value, trust = dict(start), -np.inf, TRUST
    local: LogPosterior | None = None
    trial, first = dict(start), -np.inf
    runs: list[tuple[float, Simulation]] = []
    for _ in range(rounds):
        run = full_run({name: trial[name] for name in log_posterior.surrogate.space.names})
        if run.status != "ok":
            return Polished(best, value, value - first, runs, f"a full run failed: {run.message}")
        about = _linearised(log_posterior, run)
        exact = _maximum(about, trial, RUN_ITSELF)  # the noise that suits the run best
        runs.append((exact[1], run))
        if exact[1] > value:
            first = exact[1] if len(runs) == 1 else first
            best, value, local = exact[0], exact[1], about
            trust = trust if len(runs) == 1 else min(2.0 * trust, TRUST)
        else:
            trust *= 0.25
        if local is None or trust < SMALLEST_TRUST:
            break
        trial, promised = _maximum(local, best, trust)
        if promised - value < ENOUGH:
            return Polished(best, value, value - first, runs, f"converged after {len(runs)} full runs")
    return Polished(best, value, value - first, runs, f"stopped after {len(runs)} full runs")


def _linearised(log_posterior: LogPosterior, run: Simulation) -> LogPosterior:
    """The posterior with the force linear about a run, in the same prior box."""
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
    """Maximum within `trust` of the centre's material parameters, noise free.

    A parameter without derivative, such as p_init, stays where it is: nothing here moves the force by it.
    """
    linear, narrowed = about.surrogate, []
    assert isinstance(linear, LinearForce)
    for p, moves in zip(linear.space.parameters, linear.moves, strict=True):
        reach = trust if moves else RUN_ITSELF
        middle = float(np.clip(centre[p.name], p.lower, p.upper))
        if p.in_log:
            low, high = middle * np.exp(-reach), middle * np.exp(reach)
        else:
            low, high = middle - reach * (p.upper - p.lower), middle + reach * (p.upper - p.lower)
        narrowed.append(replace(p, lower=max(low, p.lower), upper=min(high, p.upper)))
    found = climb(replace(about, material=replace(linear.space, parameters=tuple(narrowed))), centre)
    return dict(found.theta), _density(about, found.theta)


def _density(about: LogPosterior, theta: Mapping[str, float]) -> float:
    return float(about.log_prob(about.vector(theta)[None])[0])
