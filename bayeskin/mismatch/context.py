"""The context of a diagnosis: a recording, a forward model of its test, and posteriors near runs of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bayeskin.forward.interface import ForwardModel, ModelRun
from bayeskin.forward.observed import FullForce
from bayeskin.forward.posterior import posterior_of
from bayeskin.forward.reduced import ReducedForward
from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.noise_model import ALL, noise_space
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, observed
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.mismatch.noise_bounds import instrument_noise
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.stiffness_ratio import subcutis_too_stiff
from bayeskin.mismatch.tangent import Tangent
from bayeskin.types import Array, BinnedForce, Jumps, PadMotion, ParameterSpace, Surrogate


@dataclass(frozen=True)
class DiagnosisContext:
    """A recording and a forward model of its test.

    binned : the recording's bins, whose variances contain only quick noise; jumps : the jumps that its
        samples allow; motion : its protocol
    base : priors of the base model; stated_noise : bounds of noise parameters that replace the usual ones
    """

    binned: BinnedForce
    jumps: Jumps
    motion: PadMotion
    forward: ForwardModel
    base: ParameterSpace
    seed: int
    stated_noise: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def known(self) -> dict[str, Mechanism]:
        """Returns the mechanisms of the catalogue that the forward model solves, or that act on the force."""
        solves = self.forward.solves
        known = {
            name: m for name, m in catalogue().items() if name in solves or not isinstance(m.act, Tissue)
        }
        return {name: m for name, m in known.items() if set(m.needs) <= set(known)}

    @cached_property
    def neutral(self) -> dict[str, float]:
        """Returns the neutral values of all mechanisms' parameters."""
        return {name: value for m in self.known.values() for name, value in m.neutral.items()}

    @cached_property
    def noise_priors(self) -> NoisePriors:
        """Returns the bounds of the noise parameters; all phases share one sd."""
        return replace(instrument_noise(self.binned), by_kind=False, **dict(self.stated_noise))  # type: ignore[arg-type]

    @property
    def noise(self) -> dict[str, float]:
        """Returns the noise parameters from which fits start: the middle of their priors."""
        space = noise_space([ALL], self.noise_priors)
        return dict(zip(space.names, map(float, space.from_unit(np.full(space.dim, 0.5))), strict=True))

    def solved(self, names: Sequence[str]) -> list[Mechanism]:
        """Returns the mechanisms of a set that the forward model solves, ordered by name."""
        return [self.known[name] for name in sorted(names) if name in self.forward.solves]

    def space(self, names: Sequence[str]) -> ParameterSpace:
        """Returns the parameters of the forward model for a set: the base model's, then the mechanisms'."""
        mechanisms = tuple(p for m in self.solved(names) for p in m.parameters)
        return ParameterSpace((*self.base.parameters, *mechanisms))

    def run(self, names: Sequence[str], theta: Mapping[str, float], derive: bool = True) -> ModelRun | str:
        """Returns a run of the forward model with a set, or the message of a run that failed.

        derive : whether the run computes derivatives
        """
        space = self.space(names)
        at = np.array([theta[name] for name in space.names])
        return self.forward.run(space, at, self.solved(names), derive)

    def force(self, names: Sequence[str], theta: Mapping[str, float]) -> Array | str:
        """Returns the force (m,) [N] of the skin with a set, or the message of a run that failed."""
        run = self.run(names, theta, derive=False)
        return run if isinstance(run, str) else run.force_n

    def full_force(self, names: Sequence[str], theta: Mapping[str, float]) -> Array | str:
        """Returns the force (m,) [N] of the skin by the full model, or the message of a run that failed."""
        full = FullForce(self.forward.spec, self.motion, self.binned.edges_s)
        return full((tuple(m.name for m in self.solved(names)), theta))

    def reported(self, names: Sequence[str], theta: Mapping[str, float]) -> Array | str:
        """Returns the force (m,) [N] that the instrument reports, or the message of a run that failed."""
        force_n = self.force(names, theta)
        return force_n if isinstance(force_n, str) else self.reported_of(names, theta, force_n)

    def reported_of(self, names: Sequence[str], theta: Mapping[str, float], force_n: Array) -> Array:
        """Returns the force (m,) [N] that the instrument reports for a force (m,) of the skin."""
        at = np.array([theta[name] for name in self.space(names).names])
        surrogate = self.observe(names, (), [ModelRun(at, force_n, np.zeros((len(force_n), len(at))))])
        return surrogate.predict_mean(np.array([theta[name] for name in surrogate.space.names]))[0]

    def reported_elsewhere(
        self, names: Sequence[str], theta: Mapping[str, float], motion: PadMotion, edges_s: Array
    ) -> Array | str:
        """Returns the force (m,) [N] that the instrument reports on another protocol, or why the run failed.

        edges_s (m + 1,) : edges of the bins whose means are returned
        """
        values = {name: theta[name] for name in self.space(names).names}
        assert isinstance(self.forward, ReducedForward)
        run = self.forward.simulated(motion, values, self.solved(names))
        if run.status != "ok":
            return run.message
        beyond = [self.known[name] for name in sorted(names) if name not in self.forward.solves]
        rows = {name: np.array([value]) for name, value in theta.items()}
        force = observed(beyond, rows, motion, lambda time_s: np.atleast_2d(run.at(time_s)))
        return bin_means(force, motion, edges_s, beyond)[0]

    def observe(self, names: Sequence[str], added: Sequence[str], runs: Sequence[ModelRun]) -> Surrogate:
        """Returns a surrogate of the reported force near runs of a set.

        added : further mechanisms, which act on the force of these runs
        """
        errors_n = self.forward.errors(runs[0].theta)
        tissue = Tangent(self.space(names), self.binned.edges_s, tuple(runs), errors_n)
        beyond = tuple(
            self.known[name] for name in sorted({*names, *added})
            if name in added or name not in self.forward.solves
        )  # fmt: skip
        return ObservedSurrogate(tissue, beyond, self.motion) if beyond else tissue

    def posterior(
        self, names: Sequence[str], runs: Sequence[ModelRun], correction_n: Array | None = None,
        until_s: float | None = None, added: Sequence[str] = (),
    ) -> LogPosterior:  # fmt: skip
        """Returns the posterior of a set near runs of the set.

        correction_n (m,) : force that was added to the runs to correct the forward model's error. This error
            varies between points by as much as its own size, so the likelihood allows for an error with this
            sd
        until_s : end of the part of the recording that is fitted [s]; None for the whole recording
        added : further mechanisms, which act on the force of these runs
        """
        force = self.observe(names, added, runs)
        priors = ParameterSpace(force.space.parameters, self.base.correlations)
        windows = None if until_s is None else ((float(self.binned.edges_s[0]), until_s),)
        posterior = posterior_of(
            force, self.forward.spec, self.binned, self.motion, self.noise_priors, priors, windows,
            subcutis_too_stiff,
        )  # fmt: skip
        if correction_n is None or posterior.model_error is None:
            return posterior
        return replace(posterior, model_error=replace(posterior.model_error, measured_n=correction_n[None]))
