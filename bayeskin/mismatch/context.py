"""The context of a diagnosis: a recording, a forward model of its test, and posteriors near runs of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bayeskin.forward.interface import ForwardModel, ModelRun
from bayeskin.forward.joint import JointForward
from bayeskin.forward.observed import FullForce
from bayeskin.forward.posterior import marker_likelihood, posterior_of
from bayeskin.forward.reduced import ReducedForward
from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.noise_model import ALL, MARKER_SD, noise_space
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, observed
from bayeskin.mechanisms.each_recording import in_each_recording, in_one_recording
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.mismatch.noise_bounds import instrument_noise
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.stiffness_ratio import subcutis_too_stiff
from bayeskin.mismatch.tangent import MarkerTangent, Tangent
from bayeskin.types import Array, BinnedForce, Jumps, Markers, PadMotion, ParameterSpace, Surrogate
from bayeskin.types.joint import own_name, plain_name, values_in

START_SD_M = 1e-4  # noise of the markers from which fits start


@dataclass(frozen=True)
class DiagnosisContext:
    """A recording and a forward model of its test.

    binned : the recording's bins, whose variances contain only quick noise; jumps : the jumps that its
        samples allow; motion : its protocol
    base : priors of the base model; stated_noise : bounds of noise parameters that replace the usual ones
    shared : what several recordings share besides the skin: "noise", or names of mechanisms of the instrument
    markers : tracks of points on the skin, which the forward model then computes too
    """

    binned: BinnedForce
    jumps: Jumps
    motion: PadMotion
    forward: ForwardModel
    base: ParameterSpace
    seed: int
    stated_noise: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    shared: tuple[str, ...] = ()
    markers: Markers | None = None

    @cached_property
    def known(self) -> dict[str, Mechanism]:
        """Returns the mechanisms of the catalogue that the forward model solves, or that act on the force.

        Each of several recordings has its own values of an instrument's mechanism, unless they share it.
        """
        solves, recordings = self.forward.solves, [span.name for span in self.binned.spans]
        known = {
            name: m for name, m in catalogue().items() if name in solves or not isinstance(m.act, Tissue)
        }
        return {
            name: m if name in self.shared else in_each_recording(m, recordings)
            for name, m in known.items()
            if set(m.needs) <= set(known)
        }

    @cached_property
    def alone(self) -> tuple[DiagnosisContext, ...]:
        """Returns the context of each of several recordings by itself, whose values have plain names."""
        assert isinstance(self.forward, JointForward)
        plain = tuple(p for p in self.base.parameters if p.name == plain_name(p.name))
        base = ParameterSpace(plain, self.base.correlations)
        return tuple(
            DiagnosisContext(
                binned, self.jumps.part(span), motion, forward, base, self.seed, self.stated_noise
            )
            for binned, span, motion, forward in zip(
                self.binned.parts, self.binned.spans, self.motion.parts, self.forward.parts, strict=True
            )
        )

    @cached_property
    def neutral(self) -> dict[str, float]:
        """Returns the neutral values of all mechanisms' parameters."""
        return {name: value for m in self.known.values() for name, value in m.neutral.items()}

    @cached_property
    def noise_priors(self) -> NoisePriors:
        """Returns the bounds of the noise parameters; all phases share one sd."""
        usual = replace(instrument_noise(self.binned), by_kind=False, by_recording="noise" not in self.shared)
        return replace(usual, **dict(self.stated_noise))  # type: ignore[arg-type]

    @property
    def noise(self) -> dict[str, float]:
        """Returns the noise parameters from which fits start: the middle of their priors."""
        recordings = range(len(self.binned.parts) if self.noise_priors.by_recording else 1)
        space = noise_space([own_name(ALL, number) for number in recordings], self.noise_priors)
        middle = dict(zip(space.names, map(float, space.from_unit(np.full(space.dim, 0.5))), strict=True))
        return middle if self.markers is None else {**middle, MARKER_SD: START_SD_M}

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

        With several recordings, the values that each has for itself are those of the first one.

        edges_s (m + 1,) : edges of the bins whose means are returned
        """
        plain = values_in(theta, 0)
        values = {name: plain[name] for name in self.space(names).names if name in plain}
        forward = self.forward.parts[0] if isinstance(self.forward, JointForward) else self.forward
        assert isinstance(forward, ReducedForward)
        run = forward.simulated(motion, values, self.solved(names))
        if run.status != "ok":
            return run.message
        beyond = [
            in_one_recording(self.known[name]) for name in sorted(names) if name not in self.forward.solves
        ]
        rows = {name: np.array([value]) for name, value in plain.items()}
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
        if self.markers is not None:
            model = MarkerTangent(self.space(names), tuple(runs))
            seen = self.markers if until_s is None else self.markers.until(until_s)
            markers = marker_likelihood(seen, model, self.forward.spec, self.motion)
            posterior = replace(posterior, markers=markers)
        if correction_n is None or posterior.model_error is None:
            return posterior
        return replace(posterior, model_error=replace(posterior.model_error, measured_n=correction_n[None]))
