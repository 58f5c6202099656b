"""What the samples of a recording, between which bins take means, speak against."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mechanisms.mechanism import Instrument, Place
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Jumps, PadMotion


def refuted(found: Fit, known: Mapping[str, Mechanism], motion: PadMotion, jumps: Jumps) -> list[str]:
    """Mechanisms of a fit that the samples it is of speak against.

    None beside an amplifier that smooths, or a clock that is off.
    """
    acts = {name: known[name].act for name in found.names}
    instrument = {name: act for name, act in acts.items() if isinstance(act, Instrument)}
    if any(act.place >= Place.AMPLIFIER for act in instrument.values()):
        return []
    values = {name: np.array([value]) for name, value in found.theta.items()}
    fitted = found.log_posterior
    seen = jumps.until(fitted.binned.edges_s[fitted.chain.bins[-1] + 1])
    return [name for name, act in instrument.items()
            if act.refuted is not None and act.refuted(values, motion, seen)[0]]  # fmt: skip
