"""The posterior as a function that takes vectors in sampling coordinates and returns log densities.

Sampling coordinates are log(theta) for a log-uniform or log-normal parameter and theta itself for a uniform
or normal parameter. A log-uniform prior is then uniform between its transformed bounds, because the Jacobian
d theta / d log theta = theta cancels the 1/theta of its density. Without normal priors, the prior density of
a vector is therefore constant in the box, and the most probable vector is also the most likely one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.errors import InputError
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.model_error import ModelError
from bayeskin.inference.noise_model import NoiseChain, NoisePriors, noise_chain, noise_space
from bayeskin.types import POINTS_AT_ONCE, Array, BinnedForce, ParameterSpace, Prediction, Surrogate

# Half-width of the prior of a parameter that is held, in its logarithm or as a share of its prior's range.
HELD = 1e-9
FORCE_STEP = 1e-4  # step of one-sided differences of a surrogate's force, as a share of the prior's box
UNIFORM_PRECISION = 12.0  # inverse variance of a uniform prior over the unit cube

# Returns for parameters (n, d) of a space whether the prior is zero there, (n,).
Excludes = Callable[[ParameterSpace, Array], NDArray[np.bool_]]


@dataclass(frozen=True)
class LogPosterior:
    """Posterior of material and noise parameters given one recording's bins.

    `model_error` is the error that is allowed for the full model itself, in addition to the surrogate's own
    error. `fit_windows` [s] select the fitted bins, which are those completely inside a window; None selects
    all bins. `material` replaces the surrogate's own prior; its box must lie in the surrogate's box.
    `excludes` takes rows (n, d) of the surrogate's parameters and returns True where the prior is zero. The
    density is also zero where the surrogate's sd, RMS over all bins, exceeds `sure_within_n` [N]. Otherwise a
    surrogate that knows next to nothing there could explain any recording.
    Raises InputError when surrogate, bins, windows or priors do not belong together.
    """

    surrogate: Surrogate
    binned: BinnedForce
    fit_windows: tuple[tuple[float, float], ...] | None = None
    noise_priors: NoisePriors = field(default_factory=NoisePriors)
    material: ParameterSpace | None = None
    sure_within_n: float | None = None
    excludes: Excludes | None = None
    model_error: ModelError | None = None

    def __post_init__(self) -> None:
        ours, theirs = self.binned.edges_s, self.surrogate.edges_s
        if len(ours) != len(theirs) or not np.allclose(ours, theirs, rtol=0, atol=1e-6):
            raise InputError(
                "surrogate", f"it has {len(theirs) - 1} bins up to {theirs[-1]:g} s",
                f"it needs those of the recording, {len(ours) - 1} bins up to {ours[-1]:g} s",
            )  # fmt: skip
        if self.material is not None:
            _check_inside(self.material, self.surrogate.space)
        if self.fit_windows is not None:  # windows from a file are lists and must equal tuples
            windows = tuple((float(start), float(end)) for start, end in self.fit_windows)
            object.__setattr__(self, "fit_windows", windows)
        _ = self.chain  # bad windows are refused here, not at the first evaluation

    @cached_property
    def chain(self) -> NoiseChain:
        """Returns the fitted bins in order."""
        return self._chain_without(None)

    def _chain_without(self, phase: int | None) -> NoiseChain:
        """Returns the fitted bins in order; the bins of a phase are left out as a gap."""
        noise = self.noise_priors
        return noise_chain(self.binned, self.fit_windows, phase, noise.by_kind, noise.by_recording)

    @cached_property
    def space(self) -> ParameterSpace:
        """Returns the priors of all sampled parameters: first the material's, then the noise's."""
        material = self.material or self.surrogate.space
        return ParameterSpace(
            material.parameters + noise_space(self.chain.kinds, self.noise_priors).parameters,
            material.correlations,
        )

    @property
    def names(self) -> tuple[str, ...]:
        return self.space.names

    @property
    def dim(self) -> int:
        return self.space.dim

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Returns the lower and upper corner of the box in sampling coordinates, (D,) each."""
        return self.to_sampling(self.space.lower), self.to_sampling(self.space.upper)

    def to_sampling(self, theta: ArrayLike) -> Array:
        """Returns the sampling coordinates of SI values, (..., D)."""
        return self.space.to_line(theta)

    def from_sampling(self, vectors: ArrayLike) -> Array:
        """Returns SI values of sampling coordinates, (..., D); rounding never moves them out of the box."""
        return np.clip(self.space.from_line(vectors), self.space.lower, self.space.upper)

    def split(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Returns the material (n, d) and noise (n, q) columns of SI values (n, D)."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        d = self.surrogate.space.dim
        return theta[:, :d], theta[:, d:]

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the prediction on all bins, with the model's error, at SI values (n, D), (n, d) or (d,)."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        return self.with_model_error(self.surrogate.predict(theta[:, : self.surrogate.space.dim]))

    def with_model_error(self, prediction: Prediction) -> Prediction:
        """Returns a prediction of the full model's force with the error that is allowed for that model."""
        return prediction if self.model_error is None else self.model_error.beside(prediction)

    def of_full_model(self, force_n: ArrayLike) -> Prediction:
        """Returns a prediction for runs of the full model, whose forces (n, m) [N] are known."""
        force = np.atleast_2d(np.asarray(force_n, dtype=float))
        return self.with_model_error(Prediction(force, np.zeros((*force.shape, 1)), np.zeros(force.shape)))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns the mean (n, m) [N] of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        return self.surrogate.predict_mean(theta[:, : self.surrogate.space.dim])

    def force_n(self, vector: Array, latent: Array) -> Array:
        """Returns the force (m,) [N] on all bins at sampling coordinates (D,).

        latent (r,) : the surrogate's error that the force contains, in sd of each column of its factor
        """
        prediction = self.predict(self.from_sampling(vector))
        return np.asarray(prediction.mean[0] + prediction.factor[0] @ latent)

    def log_prob(self, vectors: ArrayLike) -> Array:
        """Returns the log posterior density (n,) at vectors (n, D) in sampling coordinates.

        The log-evidence is left out. The density is -inf outside the box and wherever it is not a number. The
        method never raises an exception.
        """
        vectors = np.atleast_2d(np.asarray(vectors, dtype=float))
        low, high = self.bounds
        out = np.full(len(vectors), -np.inf)
        inside = np.flatnonzero(np.all((vectors >= low) & (vectors <= high), axis=1))
        for part in _chunks(inside):
            out[part] = self.log_prob_given(vectors[part], self.predict(self.from_sampling(vectors[part])))
        return out

    def log_prob_given(self, vectors: Array, prediction: Prediction) -> Array:
        """Returns `log_prob` (n,) at vectors (n, D) inside the box, for a given prediction at them."""
        theta = self.from_sampling(vectors)
        value = self._log_likelihood(theta, prediction) + self.space.log_density(vectors)
        return np.where(np.isnan(value), -np.inf, value)

    def log_likelihood(self, theta: ArrayLike) -> Array:
        """Returns the log-likelihood (n,) at SI values (n, D) in the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        return self._log_likelihood(theta, self.predict(theta))

    def _log_likelihood(self, theta: Array, prediction: Prediction) -> Array:
        value = log_likelihood(self.chain, prediction, self.split(theta)[1])
        return np.where(self.impossible(theta, prediction), -np.inf, value)

    def impossible(self, theta: Array, prediction: Prediction) -> NDArray[np.bool_]:
        """Returns which rows (n, D) in SI `excludes` or `sure_within_n` rules out, given the prediction."""
        out = np.zeros(len(prediction.mean), dtype=bool)
        if self.excludes is not None:
            out |= self.excludes(self.surrogate.space, self.split(theta)[0])
        if self.sure_within_n is not None:
            factor = (
                prediction.factor[..., : -self.model_error.columns] if self.model_error else prediction.factor
            )
            out |= np.mean(np.sum(factor**2, axis=2) + prediction.diagonal, axis=1) > self.sure_within_n**2
        return out

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Returns the indices of the phases that have fitted bins."""
        return tuple(int(p) for p in np.unique(self.binned.phase[self.chain.bins]))

    def block_log_likelihood(self, theta: ArrayLike) -> Array:
        """Returns log p(y_b | y without b, theta) of each phase b in `blocks`, (n, b), at SI values (n, D).

        Importance weights from these values give leave-one-phase-out scores of correlated data; weights from
        p(y_b | theta) do not (Buerkner, Gabry & Vehtari 2021, Computational Statistics 36:1243). The values
        do not sum to the log-likelihood.
        """
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        if len(self.blocks) == 1:
            return self._in_chunks([self.chain], theta)
        without_phase = [self._chain_without(b) for b in self.blocks]
        each = self._in_chunks([self.chain, *without_phase], theta)
        return each[:, :1] - each[:, 1:]

    def _in_chunks(self, chains: list[NoiseChain], theta: Array) -> Array:
        out = np.empty((len(theta), len(chains)))
        for part in _chunks(np.arange(len(theta))):
            prediction, noise = self.predict(theta[part]), self.split(theta[part])[1]
            for column, chain in enumerate(chains):
                out[part, column] = log_likelihood(chain, prediction, noise)
        return out

    def named(self, theta: ArrayLike) -> dict[str, float]:
        """Returns an SI vector (D,) as a mapping from names to values."""
        return {name: float(v) for name, v in zip(self.names, np.asarray(theta), strict=True)}

    def vector(self, theta: Mapping[str, float]) -> Array:
        """Returns the SI values of all parameters, given by name, as a vector (D,) in sampling coordinates.

        Raises InputError where a parameter is missing.
        """
        missing = [name for name in self.names if name not in theta]
        if missing:
            raise InputError(
                "theta", f"it lacks {', '.join(missing)}", f"it needs all of {', '.join(self.names)}"
            )
        return self.to_sampling([theta[name] for name in self.names])

    @cached_property
    def identity(self) -> dict[str, str]:
        """Returns hashes of all inputs of this posterior; a chain is continued only where they are equal."""
        b = self.binned
        arrays = (b.edges_s, b.force_n, b.variance_n2, b.correlation, b.phase)
        return {
            "parameters": _sha256(repr(self.space.without_texts), *self._restriction_texts()),
            "surrogate": _sha256(
                json.dumps(dict(self.surrogate.provenance), sort_keys=True, default=str),
                *self._probe_texts(),
            ),
            "recording": _sha256(repr(b.phases), *(np.ascontiguousarray(a).tobytes() for a in arrays)),
            "fit windows": _sha256(repr(self.fit_windows)),
            "model error": _sha256(*self._model_error_texts()),
        }

    def _restriction_texts(self) -> tuple[str, ...]:
        excludes = [] if self.excludes is None else [getattr(self.excludes, "__qualname__", "")]
        return (*excludes, *([] if self.sure_within_n is None else [f"{self.sure_within_n:.5g}"]))

    def _model_error_texts(self) -> tuple[str, ...]:
        if self.model_error is None:
            return ()
        motion = self.model_error.motion
        measured_n = self.model_error.measured_n
        measured = () if measured_n is None else (repr(measured_n.tolist()),)
        assumed = f"{self.model_error.amplitude:.5g}", repr(motion.time_s), repr(motion.displacement_m)
        return (*assumed, *measured)

    def _probe_texts(self) -> tuple[str, ...]:
        # The provenance may miss a change, such as a patched file, but the prediction itself shows it. Only
        # five digits are compared, because the order of sums differs between machines.
        unit = np.array([[0.5], [0.31], [0.69]]) * np.ones(self.surrogate.space.dim)
        prediction = self.surrogate.predict(self.surrogate.space.from_unit(unit))
        numbers = (prediction.mean.mean(1), prediction.mean.std(1), prediction.sd().mean(1))
        return tuple(f"{value:.5g}" for row in numbers for value in row)


def _chunks(index: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return [index[a : a + POINTS_AT_ONCE] for a in range(0, len(index), POINTS_AT_ONCE)]


def _check_inside(material: ParameterSpace, box: ParameterSpace) -> None:
    if material.names != box.names:
        raise InputError(
            "priors",
            f"they are those of {', '.join(material.names)}",
            f"the surrogate's parameters are {', '.join(box.names)}, and both must be the same",
        )
    for ours, theirs in zip(material.parameters, box.parameters, strict=True):
        if ours.lower < theirs.lower or ours.upper > theirs.upper or not ours.lower < ours.upper:
            raise InputError(
                f"prior of {ours.name}", f"it reaches from {ours.lower:g} to {ours.upper:g} {ours.unit}",
                f"it must lie inside the surrogate's bounds, {theirs.lower:g} to {theirs.upper:g}",
            )  # fmt: skip


def _sha256(*parts: str | bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else part.encode())
        digest.update(b"\0")
    return digest.hexdigest()
