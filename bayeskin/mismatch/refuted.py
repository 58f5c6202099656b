"""Finds fitted mechanisms that single samples of a recording contradict, although its bin means do not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mechanisms.mechanism import Instrument, Place
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Jumps, PadMotion
from bayeskin.types.joint import Span, values_in


def refuted(fit: Fit, known: Mapping[str, Mechanism], motion: PadMotion, jumps: Jumps) -> list[str]:
    """Returns the mechanisms of a fit that the recording's samples contradict.

    The list is empty if the fit has an amplifier that smooths the force, or a clock that is off.

    jumps : the force jumps that the samples allow; only those in the fitted part are used
    """
    acts = {name: known[name].act for name in fit.names}
    instrument = {name: act for name, act in acts.items() if isinstance(act, Instrument)}
    if any(act.place >= Place.AMPLIFIER for act in instrument.values()):
        return []
    values = {name: np.array([value]) for name, value in fit.theta.items()}
    log_posterior = fit.log_posterior
    fitted_jumps = jumps.until(log_posterior.binned.edges_s[log_posterior.chain.bins[-1] + 1])
    spans = motion.spans or (Span("", 0.0, float(motion.time_s[-1])),)
    parts = [
        (values_in(values, number), part, fitted_jumps.part(span) if motion.spans else fitted_jumps)
        for number, (part, span) in enumerate(zip(motion.parts, spans, strict=True))
    ]
    return [name for name, act in instrument.items()
            if act.refuted is not None and any(act.refuted(*part)[0] for part in parts)]  # fmt: skip
