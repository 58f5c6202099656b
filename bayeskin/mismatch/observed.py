"""Provides a surrogate of the force that an instrument with mechanisms reports.

The wrapped surrogate predicts only means over bins. The effect of the mechanisms is therefore computed from a
force that is linear between the middles of bins and has corners where the protocol has them. This effect is
added to the surrogate's means. It is exact for mechanisms that add the same force whatever the skin's force
is. The surrogate's own error does not change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.mechanisms import Mechanism, observed
from bayeskin.mechanisms.binned import BinnedForces
from bayeskin.mechanisms.each_recording import in_one_recording
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.distinct import at_distinct, mean_at_distinct
from bayeskin.mismatch.wrapper import Wrapper
from bayeskin.types import Array, PadMotion, ParameterSpace, Prediction
from bayeskin.types.joint import bins_of, edges_of, end_to_end, values_in


@dataclass(frozen=True)
class ObservedSurrogate(Wrapper):
    """A surrogate of the skin's force, `inner`, with the instrument's `mechanisms` applied to its force."""

    mechanisms: tuple[Mechanism, ...]
    motion: PadMotion

    @cached_property
    def space(self) -> ParameterSpace:
        """Returns the parameters of `inner`, then those of each mechanism."""
        added = tuple(p for mechanism in self.mechanisms for p in mechanism.parameters)
        return ParameterSpace((*self.inner.space.parameters, *added))

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.inner.provenance, "instrument": [m.name for m in self.mechanisms]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the reported force at theta (n, d) or (d,). Raises InputError outside the box."""
        inner, values = self._split(theta)
        prediction = at_distinct(lambda rows, _: self.inner.predict(rows), inner, inner)
        return Prediction(
            prediction.mean + self._added(values, prediction.mean), prediction.factor, prediction.diagonal
        )

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`."""
        inner, values = self._split(theta)
        mean = mean_at_distinct(lambda rows, _: self.inner.predict_mean(rows), inner, inner)
        return mean + self._added(values, mean)

    def _split(self, theta: ArrayLike) -> tuple[Array, dict[str, Array]]:
        """Returns the parameters of `inner` (n, k), and the mechanisms' parameters by name, (n,) each."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        count = self.inner.space.dim
        return theta[:, :count], dict(zip(self.space.names[count:], theta[:, count:].T, strict=True))

    def _added(self, values: Mapping[str, Array], mean_n: Array) -> Array:
        """Returns the force (n, m) [N] that the mechanisms add to the bins' means, recording by recording."""
        return end_to_end(
            [
                self._added_in(forces, motion, values_in(values, number), mean_n[:, bins])
                for number, (motion, forces, bins) in enumerate(self._recordings)
            ],
            0.0,
        )

    def _added_in(
        self, forces: BinnedForces, motion: PadMotion, values: Mapping[str, Array], mean_n: Array
    ) -> Array:
        """Returns the force (n, k) [N] that the mechanisms add to the bins' means of one recording."""
        if all(isinstance(m.act, Instrument) and m.act.adds for m in self.mechanisms):
            force = observed(
                self.mechanisms, values, motion, lambda t: np.zeros((len(mean_n), np.shape(t)[-1]))
            )
            return forces.bins.means(force)
        return forces.change(partial(observed, self.mechanisms, values, motion), mean_n)

    @cached_property
    def _recordings(self) -> list[tuple[PadMotion, BinnedForces, slice]]:
        """Returns the protocol, the forces and the bins of each recording."""
        spans, plain = self.motion.spans, tuple(in_one_recording(m) for m in self.mechanisms)
        return [
            (part, BinnedForces(edges_s, part, plain), bins)
            for part, edges_s, bins in zip(
                self.motion.parts, edges_of(spans, self.edges_s), bins_of(spans, self.edges_s), strict=True
            )
        ]
