"""The stiffness-ratio prior: a subcutis that is much stiffer than the cutis is ruled out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import STIFFEST_BELOW, Array, ParameterSpace


def subcutis_too_stiff(space: ParameterSpace, theta: Array) -> NDArray[np.bool_]:
    """Returns for points (n, d) whether the subcutis is too stiff, (n,).

    This is the case where E_s exceeds `STIFFEST_BELOW` times E_c, and never for a space without these moduli.
    """
    names = space.names
    if not {"E_c", "E_s"} <= set(names):
        return np.zeros(len(theta), dtype=bool)
    return np.asarray(theta[:, names.index("E_s")] > STIFFEST_BELOW * theta[:, names.index("E_c")])
