"""The error of the full model itself: of its mesh, and of the calibration of the load cell.

A finer mesh changes the force, within a tenth of the change, by a factor; a cell's calibration is a factor,
too. The rest of the change goes with displacement, and relaxes after each movement, because a mesh resolves
the flow of the fluid to its own size only (`benchmarks/mesh_shapes.py`). All are errors of the force at every
point of the parameter space. They are added up from shapes of one sd each,

    a F(t) ,  b F(t) (2 d(t) / max d - 1)  and  c max |F| r_i(t) ,

F the predicted force, d the pads' displacement and r_i the answer of a spring and dashpot of relaxation time
tau_i to d / max d. Without them a fit takes the mesh for skin: intervals of moduli come out as narrow as the
noise alone lets them be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.types import Array, PadMotion, Prediction

CALIBRATION = 0.01  # sd of a factor on the force: what a load cell of class 1 is off by (ISO 7500-1:2018)
BEND = 3e-3  # b, of the force
RELAXING = 1.5e-3  # c, of the largest force
RELAXATION_S = (
    3.0,
    12.0,
    50.0,
)  # tau_i: an answer is told from one three times slower, hardly from one twice


@dataclass(frozen=True)
class ModelError:
    """The errors of a force over the bins between edges_s (m+1,); `amplitude` is the sd of the factor, a.

    measured_n (r, m) : further errors of one sd each, which runs near by have shown
    """

    motion: PadMotion
    edges_s: Array
    amplitude: float
    measured_n: Array | None = None

    def beside(self, prediction: Prediction) -> Prediction:
        """Returns the prediction with these errors as further columns of its factor."""
        rows = prediction.factor.transpose(0, 2, 1)  # as they lie in memory
        more = errors(prediction.mean, *self._shapes) * self._sd[:, None]
        if self.measured_n is not None:
            measured = np.broadcast_to(self.measured_n, (len(rows), *self.measured_n.shape))
            more = np.concatenate([more, measured], axis=1)
        factor = np.concatenate([rows, more], axis=1).transpose(0, 2, 1)
        return Prediction(prediction.mean, factor, prediction.diagonal)

    @property
    def columns(self) -> int:
        """Returns the number of these errors."""
        return 2 + len(RELAXATION_S) + (0 if self.measured_n is None else len(self.measured_n))

    @cached_property
    def _sd(self) -> Array:
        return np.array([self.amplitude, BEND, *[RELAXING] * len(RELAXATION_S)])

    @cached_property
    def _shapes(self) -> tuple[Array, Array]:
        return shapes(self.motion, self.edges_s)


def shapes(motion: PadMotion, edges_s: Array) -> tuple[Array, Array]:
    """Returns what multiplies the force in bins (2, m), and the relaxing answers (k, m)."""
    middle = 0.5 * (edges_s[1:] + edges_s[:-1])
    share = motion.at(middle) / float(np.max(np.abs(motion.displacement_m)))
    return np.stack([np.ones(len(middle)), 2.0 * share - 1.0]), relaxing(motion, middle)


def relaxing(motion: PadMotion, time_s: Array) -> Array:
    """Returns the force (k, m) at given times of springs and dashpots in series, stretched by d / max d.

    Exact, as a protocol is straight between its corners.
    """
    largest = float(np.max(np.abs(motion.displacement_m)))
    rate = np.diff(motion.displacement_m) / largest / np.diff(motion.time_s)
    out = np.zeros((len(RELAXATION_S), len(time_s)))
    for row, tau in zip(out, RELAXATION_S, strict=True):
        for start, end, speed in zip(motion.time_s[:-1], motion.time_s[1:], rate, strict=True):
            since = np.maximum(time_s - start, 0.0)
            after = np.maximum(time_s - end, 0.0)
            row += speed * tau * (np.exp(-after / tau) - np.exp(-since / tau))
    return out


def errors(mean_n: Array, multiplying: Array, added: Array) -> Array:
    """Returns all shapes (n, 2 + k, m) of the error of forces (n, m), of the size of the force."""
    largest = np.max(np.abs(mean_n), axis=1)[:, None, None]
    return np.concatenate([mean_n[:, None, :] * multiplying, largest * added], axis=1)
