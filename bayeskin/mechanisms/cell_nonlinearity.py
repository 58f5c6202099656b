"""The load cell's curve bends: a force F reads as F + c F^2, before the cell's zero is shifted.

Within 1 N the curve rises throughout, for every c in the range. The range is chosen for this test. The curve
of a calibrated cell is far straighter: ISO 376:2011 allows a deviation of 0.2 % in its widest class.

It is a look-alike of the fibre mechanisms (`strain-stiffening`, `fibre-anisotropy`). They also change how the
force rises with displacement, in the same way in each cycle and at each speed. Weights hung on the cell tell
them apart.
"""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds c F^2 to the force."""

    def bent(time_s: Array) -> Array:
        acting = force(time_s)
        return np.asarray(acting + values["cell_bend"][:, None] * acting**2)

    return bent


MECHANISM = Mechanism(
    name="cell-nonlinearity",
    parameters=(
        Parameter(
            "cell_bend", "1/N", -0.5, 0.5, "uniform", "relative error of the load cell's reading, per force"
        ),
    ),
    neutral={"cell_bend": 0.0},
    statement=lambda v: (
        f"The load cell is not linear: at 1 N it reads {number(100 * abs(v['cell_bend']), 2)} % too "
        f"{'much' if v['cell_bend'] > 0 else 'little'}, and this percentage grows in proportion to the force."
    ),
    look_alikes=("fibre-anisotropy",),
    also_possible=("strain-stiffening",),
    act=Instrument(Place.CELL, observe, adds=False),
)
