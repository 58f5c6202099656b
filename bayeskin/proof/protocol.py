"""The protocol of every concealed recording, which is that of the shipped surrogate `healthy-skin-reaction`.

Its corners are those of the article's recording, idealised: times are rounded to 0.1 s and displacements to
0.01 mm (Lavigne et al., "Poromechanical modelling of the time-dependent response of in vivo human skin
during extension", supplement, data/Healthy_skin.xlsx).
"""

from __future__ import annotations

import numpy as np

from bayeskin.recordings import uniform_edges
from bayeskin.types import Array, PadMotion, PhaseKind

SURROGATE = "surrogates/healthy-skin-reaction.h5"
_CORNERS_S = (
    0.0, 9.6, 19.0, 79.0, 88.5, 97.9, 147.9, 157.4, 166.8, 206.8, 214.5, 222.2, 258.0, 267.4, 347.4,
)  # fmt: skip
_HEIGHTS_MM = (0.0, 0.0, 9.45, 9.45, 0.02, 9.45, 9.45, 0.02, 9.45, 9.45, 1.76, 9.45, 9.45, 0.0, 0.0)
KINDS: tuple[PhaseKind, ...] = (
    "rest", "load", "hold", "unload", "load", "hold", "unload",
    "load", "hold", "unload", "load", "hold", "unload", "rest",
)  # fmt: skip
MOTION = PadMotion(np.array(_CORNERS_S), np.round(1e-3 * np.array(_HEIGHTS_MM), 12))
RATE_HZ = 20.0
HELD_OUT_FROM_S = _CORNERS_S[6]  # the end of the second hold
EDGES_S = uniform_edges(_CORNERS_S[-1])


def samples_s() -> Array:
    """Returns the times (n,) [s] of a recording's samples."""
    return np.asarray(np.arange(round(_CORNERS_S[-1] * RATE_HZ) + 1) / RATE_HZ)


def kind_at(time_s: Array) -> np.ndarray:
    """Returns the index into `KINDS` of the phase at each time, in the same shape."""
    return np.clip(np.searchsorted(MOTION.time_s, time_s, side="right") - 1, 0, len(KINDS) - 1)
