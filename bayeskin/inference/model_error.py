"""The error of the full model itself: the error of its mesh, and the calibration error of the load cell.

A finer mesh changes the force by a factor, to within a tenth of the change. The calibration error of a load
cell is a factor, too. The remaining change by the mesh varies with displacement and relaxes after each
movement, because a mesh resolves the flow of the fluid only down to its own size
(`benchmarks/mesh_shapes.py`). All these errors affect the force at every point of the parameter space. They
are a sum of shapes, which are, at one sd each,

    a F(t) ,  b F(t) (2 d(t) / max d - 1)  and  c max |F| r_i(t) .

F is the predicted force, d the pads' displacement, and r_i the response of a spring and dashpot with
relaxation time tau_i to d / max d. Without these errors a fit mistakes the mesh's error for a property of the
skin: the intervals of the moduli become as narrow as the noise alone allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.types import Array, PadMotion, Prediction
from bayeskin.types.joint import recording_at


@dataclass(frozen=True)
class ErrorSizes:
    """Sizes (sd) and times of the errors that are allowed for the full model and the load cell.

    calibration : sd of a factor on the force, the error of a load cell of class 1 (ISO 7500-1:2018)
    bend : b, as a share of the force (`benchmarks/mesh_shapes.py`)
    relaxing : c, as a share of the largest force (`benchmarks/mesh_shapes.py`)
    relaxation_s : tau_i [s]. A response can be told from another that is three times slower, but hardly from
        one twice as slow.
    """

    calibration: float = 0.01
    bend: float = 3e-3
    relaxing: float = 1.5e-3
    relaxation_s: tuple[float, ...] = (3.0, 12.0, 50.0)


@dataclass(frozen=True)
class ModelError:
    """The errors of a force over the bins between edges_s (m+1,); `amplitude` is the sd of the factor, a.

    measured_n (r, m) : further errors [N], at one sd each, which runs at nearby points have shown
    """

    motion: PadMotion
    edges_s: Array
    amplitude: float
    measured_n: Array | None = None
    sizes: ErrorSizes = ErrorSizes()

    def beside(self, prediction: Prediction) -> Prediction:
        """Returns the prediction with these errors as further columns of its factor."""
        rows = prediction.factor.transpose(0, 2, 1)  # the layout of the factor in memory
        error_rows = errors(prediction.mean, *self._shapes) * self._sd[:, None]
        if self.measured_n is not None:
            measured = np.broadcast_to(self.measured_n, (len(rows), *self.measured_n.shape))
            error_rows = np.concatenate([error_rows, measured], axis=1)
        factor = np.concatenate([rows, error_rows], axis=1).transpose(0, 2, 1)
        return Prediction(prediction.mean, factor, prediction.diagonal)

    @property
    def columns(self) -> int:
        """Returns the number of these errors."""
        return 2 + len(self.sizes.relaxation_s) + (0 if self.measured_n is None else len(self.measured_n))

    @cached_property
    def _sd(self) -> Array:
        sizes = self.sizes
        return np.array([self.amplitude, sizes.bend, *[sizes.relaxing] * len(sizes.relaxation_s)])

    @cached_property
    def _shapes(self) -> tuple[Array, Array]:
        return shapes(self.motion, self.edges_s, self.sizes.relaxation_s)


def shapes(motion: PadMotion, edges_s: Array, relaxation_s: Sequence[float]) -> tuple[Array, Array]:
    """Returns the factors (2, m) that multiply the force in each bin, and the relaxing responses (k, m)."""
    middle = 0.5 * (edges_s[1:] + edges_s[:-1])
    share = motion.at(middle) / float(np.max(np.abs(motion.displacement_m)))
    return np.stack([np.ones(len(middle)), 2.0 * share - 1.0]), relaxing(motion, middle, relaxation_s)


def relaxing(motion: PadMotion, time_s: Array, relaxation_s: Sequence[float]) -> Array:
    """Returns the force (k, m) of springs and dashpots in series at given times, stretched by d / max d.

    It is exact, because a protocol is straight between its corners. Each of several recordings starts
    relaxed. The times (n,) [s] are in order.
    """
    if motion.spans:
        recording = recording_at(motion.spans, time_s)
        return np.concatenate(
            [
                relaxing(part, time_s[recording == number] - span.start_s, relaxation_s)
                for number, (part, span) in enumerate(zip(motion.parts, motion.spans, strict=True))
            ],
            axis=1,
        )
    largest = float(np.max(np.abs(motion.displacement_m)))
    rate = np.diff(motion.displacement_m) / largest / np.diff(motion.time_s)
    out = np.zeros((len(relaxation_s), len(time_s)))
    for row, tau in zip(out, relaxation_s, strict=True):
        for start, end, speed in zip(motion.time_s[:-1], motion.time_s[1:], rate, strict=True):
            since = np.maximum(time_s - start, 0.0)
            after = np.maximum(time_s - end, 0.0)
            row += speed * tau * (np.exp(-after / tau) - np.exp(-since / tau))
    return out


def errors(mean_n: Array, multiplying: Array, added: Array) -> Array:
    """Returns all shapes (n, 2 + k, m) [N] of the error of forces (n, m) [N], not multiplied by their sd."""
    largest = np.max(np.abs(mean_n), axis=1)[:, None, None]
    return np.concatenate([mean_n[:, None, :] * multiplying, largest * added], axis=1)
