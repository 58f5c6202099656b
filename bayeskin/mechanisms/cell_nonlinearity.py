"""The load cell's curve bends: F + c F^2, of the force that acts on it, before its zero is shifted.

Within 1 N the curve rises throughout, whatever c. The range is chosen for this test: a calibrated cell is far
straighter, ISO 376:2011 lets one of its widest class be off its curve by 0.2 %.

It is a look-alike of fibres (`strain-stiffening`, `fibre-anisotropy`), since they, too, change how the force
rises with displacement, alike in each cycle and at each speed. Weights hung on the cell tell them apart.
"""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds c F^2."""

    def bent(time_s: Array) -> Array:
        acting = force(time_s)
        return np.asarray(acting + values["cell_bend"][:, None] * acting**2)

    return bent


MECHANISM = Mechanism(
    name="cell-nonlinearity",
    parameters=(
        Parameter(
            "cell_bend", "1/N", -0.5, 0.5, "uniform", "share that the load cell reads too much, by force"
        ),
    ),
    neutral={"cell_bend": 0.0},
    statement=lambda v: (
        f"The load cell's curve bends: it reads {number(100 * abs(v['cell_bend']), 2)} % too "
        f"{'much' if v['cell_bend'] > 0 else 'little'} at 1 N, and at other forces a share in proportion."
    ),
    group=("cell-nonlinearity", "strain-stiffening", "fibre-anisotropy"),
    act=Instrument(Place.CELL, observe, adds=False),
)
