"""How well a set of mechanisms predicts phases that its parameters were not fitted to.

The set is kept. Each phase in turn is taken from the fit, all parameters climb anew from where they were, and
the force that follows there is compared with the recorded one. Whole phases, because what is left hangs
together within one: an error at a bin is no news where its neighbour is known (Roberts et al., Ecography 40
(2017), 913-929).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.noise_model import Windows
from bayeskin.inference.straighten import Shear
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array

ROUNDS = 6  # of a climb without a phase, from where the fit is with it


def errors_left_out(found: Fit, shear: Shear | None) -> Array:
    """Errors [N] (k,) of the fitted bins, each predicted by a fit without its phase.

    `shear` straightens the ridges of the fit's posterior, where it is known. Raises ValueError where only one
    phase is fitted, so that nothing can be left out.
    """
    whole = found.log_posterior
    binned, bins = whole.binned, whole.chain.bins
    spans = whole.fit_windows or ((float(binned.edges_s[0]), float(binned.edges_s[-1])),)
    phase_of = binned.phase[bins]
    indices = np.unique(phase_of)
    if len(indices) < 2:
        raise ValueError("one phase alone is fitted: nothing can be left out")
    errors = np.empty(len(bins))
    for index in indices:
        phase = binned.phases[index]
        part = replace(whole, fit_windows=without(spans, phase.start_s, phase.end_s))
        force_n = _refitted(found, part, shear)
        errors[phase_of == index] = (binned.force_n - force_n)[bins[phase_of == index]]
    return errors


def without(spans: Windows, start_s: float, end_s: float) -> tuple[tuple[float, float], ...]:
    """What of windows lies outside a stretch of time."""
    parts = [(a, min(b, start_s)) for a, b in spans] + [(max(a, end_s), b) for a, b in spans]
    return tuple(sorted((a, b) for a, b in parts if b > a))


def _refitted(found: Fit, part: LogPosterior, shear: Shear | None) -> Array:
    """The force (m,) of a fit to a part of the recording, climbed to from one to more of it."""
    low, high = part.bounds
    wide = found.log_posterior.names
    top = gauss_newton(
        part, np.clip(part.vector(found.theta), low, high),
        shear.among(wide, part.names) if shear else None, ROUNDS,
    )  # fmt: skip
    return part.force_n(top.vector, top.latent)
