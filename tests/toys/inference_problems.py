"""A fast surrogate of the toy with a known error of its own, and recordings drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from toys import closed_form_model

from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.noise_model import draw_noise, noise_chain
from bayeskin.types import Array, BinnedForce, Parameter, ParameterSpace, Phase, Prediction, Simulation

SCALE = 1e-3  # brings the toy's force to that of a skin test, below 1 N
EDGES_S = np.arange(0.0, 131.0, 1.0)
_CORNERS = closed_form_model.MOTION.time_s
_KINDS = ("rest", "load", "hold", "unload", "rest", "load", "hold", "unload", "rest")
PHASES = tuple(
    Phase(kind, int(a > 0) + int(a >= 65), float(a), float(b))
    for kind, a, b in zip(_KINDS, _CORNERS[:-1], _CORNERS[1:], strict=True)
)
TRUTH = {"E_c": 1e5, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
NOISE = {
    "sd_rest": 2e-3, "sd_load": 4e-3, "sd_hold": 2e-3, "sd_unload": 4e-3, "tau_noise": 2.0, "nu_noise": 6.0,
}  # fmt: skip
HOLDS = ((15.0, 45.0), (75.0, 105.0))  # windows of the two holds [s]


class ToySurrogate:
    """The toy in closed form but for a table over its relaxation time: wrong by less than 0.1 mN.

    `bias_n` is an error that it knows nothing of; `repaired` holds points at which it was told the truth.
    """

    def __init__(self, bias_n: float = 0.0, sd_n: float = 5e-4) -> None:
        self.bias_n, self.sd_n = bias_n, sd_n
        self.space, self.edges_s = closed_form_model.SPACE, EDGES_S
        self.provenance = {"model": "toy", "sd_n": sd_n}
        self.log_tau = np.linspace(np.log(3.0 * 0.3**0.5), np.log(3.0 * 300.0**0.5), 80)
        k_s = 3e-8 / ((np.exp(self.log_tau) / 3.0) ** 2 * 2e4)
        theta = np.stack([np.full(80, v) for v in (1e5, 2e4, 1e-14, 0.0, 0.0)], axis=1)
        theta[:, 3] = k_s
        share = 0.02 + 0.1 / 6.0
        fine = EDGES_S[:-1, None] + np.linspace(0, 1, 11)
        u = closed_form_model.MOTION.at(fine)
        self.elastic = np.trapezoid(u * (1 + 30 * u), dx=0.1, axis=1)
        unit = closed_form_model.toy_bin_means(theta, EDGES_S) / (0.4 * 1.52e5)
        self.memory = (unit - (1 - share) * self.elastic) / share
        time = 0.5 * (EDGES_S[1:] + EDGES_S[:-1]) / EDGES_S[-1]
        self.modes = np.stack([np.cos(np.pi * a * time) for a in range(3)], axis=-1)

    def predict(self, theta: ArrayLike) -> Prediction:
        theta = np.atleast_2d(theta)
        e_c, e_s, k_c, k_s = theta[:, :4].T
        tau = np.clip(3e-8 / (k_s * e_s), 0.3, 300.0) ** 0.5 * 3.0
        place = (np.log(tau) - self.log_tau[0]) / (self.log_tau[1] - self.log_tau[0])
        left = np.clip(place.astype(int), 0, len(self.log_tau) - 2)
        weight = (place - left)[:, None]
        memory = (1 - weight) * self.memory[left] + weight * self.memory[left + 1]
        share = (0.02 + 0.1 * e_s / (e_s + e_c) + 0.02 * np.tanh(np.log10(k_c * 1e14)))[:, None]
        stiffness = SCALE * 0.4 * (e_c + 2.6 * e_s)[:, None]
        mean = stiffness * ((1 - share) * self.elastic + share * memory) + self.bias_n
        factor = np.repeat(self.sd_n * self.modes[None], len(theta), axis=0)
        return Prediction(mean, factor, np.full(mean.shape, (0.1 * self.sd_n) ** 2))

    def predict_mean(self, theta: ArrayLike) -> Array:
        return self.predict(theta).mean


class LineSurrogate:
    """force = a + b t: a linear model, whose posterior is Gaussian when the noise is known."""

    def __init__(self, bins: int = 40) -> None:
        self.space = ParameterSpace(
            (Parameter("a", "N", -1.0, 1.0, "uniform"), Parameter("b", "N/s", -1.0, 1.0, "uniform"))
        )
        self.edges_s = np.linspace(0.0, 1.0, bins + 1)
        self.provenance = {"model": "line"}
        self.columns = np.stack([np.ones(bins), 0.5 * (self.edges_s[1:] + self.edges_s[:-1])])

    def predict(self, theta: ArrayLike) -> Prediction:
        mean = np.atleast_2d(theta) @ self.columns
        factor = np.repeat(0.01 * self.columns[1][None, :, None], len(mean), axis=0)
        return Prediction(mean, factor, np.full(mean.shape, 1e-6))

    def predict_mean(self, theta: ArrayLike) -> Array:
        return self.predict(theta).mean


def line_problem(seed: int = 0) -> LogPosterior:
    """A line with noise known to within a thousandth: sd 0.05 N, nearly white, nearly Gaussian."""
    surrogate = LineSurrogate()
    force = surrogate.predict([0.2, -0.3]).mean[0]
    force = force + 0.05 * np.random.default_rng(seed).standard_normal(len(force))
    bins = len(force)
    binned = BinnedForce(
        surrogate.edges_s, force, np.zeros(bins), np.zeros(bins - 1), np.zeros(bins, dtype=int),
        (Phase("hold", 1, 0.0, 1.0),),
    )  # fmt: skip
    priors = NoisePriors(sd_n=(0.05, 0.05005), tau_s=(0.001, 0.001001), nu=(1e6, 1.001e6))
    return LogPosterior(surrogate, binned, noise_priors=priors)


def empty_recording(edges_s: Array = EDGES_S) -> BinnedForce:
    """The toy's bins and phases with a force of zero."""
    centre = 0.5 * (edges_s[1:] + edges_s[:-1])
    phase = np.searchsorted([p.end_s for p in PHASES], centre)
    bins = len(centre)
    return BinnedForce(edges_s, np.zeros(bins), np.full(bins, 1e-6), np.full(bins - 1, 0.2), phase, PHASES)


def toy_problem(
    seed: int = 5,
    windows: tuple[tuple[float, float], ...] | None = None,
    surrogate: ToySurrogate | None = None,
) -> LogPosterior:
    """A recording drawn from the toy at TRUTH: surrogate error, noise and all, as the likelihood has it."""
    rng = np.random.default_rng(seed)
    honest, binned = ToySurrogate(), empty_recording()
    prediction = honest.predict([list(TRUTH.values())])
    force = prediction.mean[0] + prediction.factor[0] @ rng.standard_normal(3)
    noise = np.array([list(NOISE.values())])
    force = force + draw_noise(noise_chain(binned), noise, prediction.diagonal, rng)[0]
    return LogPosterior(surrogate or honest, dataclasses.replace(binned, force_n=force), windows)


def full_run(theta: Mapping[str, float]) -> Simulation:
    """The toy itself, at the surrogate's scale."""
    run = closed_form_model.toy_simulate(theta)
    return dataclasses.replace(run, force_n=SCALE * run.force_n)


def around_truth(n: int, spread: float, seed: int = 0) -> Array:
    """Draws (n, D) about the truth in SI, for what takes draws as they come."""
    problem = toy_problem()
    rng = np.random.default_rng(seed)
    centre = problem.vector({**TRUTH, **NOISE})
    return problem.from_sampling(centre + spread * rng.standard_normal((n, problem.dim)))
