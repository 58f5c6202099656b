"""Compares single mechanisms with the base model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayeskin.mechanisms import Mechanism, with_one
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array


@dataclass(frozen=True)
class Gain:
    """The gain of log-evidence [nats] of a mechanism over the base model, and its standard error."""

    name: str
    nats: float
    standard_error: float


def gains(fits: Mapping[tuple[str, ...], Fit], known: Mapping[str, Mechanism]) -> list[Gain]:
    """Returns the gain of each fitted mechanism alone, or with the mechanisms that it needs.

    The largest gain comes first.
    """
    base = fits[()]
    alone = {name: fits.get(with_one((), name, known)) for name in known}
    entries = [
        Gain(name, fit.log_evidence - base.log_evidence, _score_error(base, fit))
        for name, fit in alone.items() if fit is not None
    ]  # fmt: skip
    return sorted(entries, key=lambda gain: -gain.nats)


def _score_error(base: Fit, fit: Fit) -> float:
    """Returns the standard error of a difference of log-likelihoods, from its scatter over the phases."""
    differences = _log_likelihood_by_phase(fit) - _log_likelihood_by_phase(base)
    return float(np.sqrt(len(differences)) * differences.std(ddof=1)) if len(differences) > 1 else 0.0


def _log_likelihood_by_phase(fit: Fit) -> Array:
    """Returns the log-likelihood of each phase at a fit, given the other phases, (b,)."""
    log_posterior = fit.log_posterior
    theta = log_posterior.from_sampling(log_posterior.vector(fit.theta))[None]
    return log_posterior.block_log_likelihood(theta)[0]
