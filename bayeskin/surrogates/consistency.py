"""Checks that the arrays of a surrogate match: shapes, finite numbers, and the order of bins and bounds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.surrogates.chaos import LatentChaos
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.kernels import KERNELS
from bayeskin.surrogates.surrogate import Latents, ShapeSurrogate
from bayeskin.surrogates.two_fidelities import CorrectedLatents

Shaped = tuple[str, NDArray[Any], tuple[int, ...]]  # name, array, expected shape


def check_consistency(surrogate: ShapeSurrogate) -> None:
    """Raises an InputError that names the first array that does not match the others."""
    space, edges_s, active = surrogate.space, surrogate.edges_s, surrogate.active
    for p in space.parameters:
        if not (np.isfinite([p.lower, p.upper]).all() and p.lower < p.upper):
            raise InputError(
                f"space: {p.name}",
                f"it reaches from {p.lower:g} to {p.upper:g}",
                "the lower bound must be below the upper",
            )
    for name, array, shape in _expected_shapes(surrogate):
        if array.shape != shape:
            raise InputError(name, f"the shape is {array.shape}", f"it must be {shape}")
        if not np.isfinite(array).all():
            raise InputError(name, "some values are not finite", "all must be finite numbers")
    if not np.all(np.diff(edges_s) > 0.0):
        raise InputError("edges_s", "the edges do not increase", "they must increase")
    if not np.all((active >= 0) & (active < surrogate.similarity.dim)):
        raise InputError(
            "active",
            f"it contains {active.tolist()}",
            f"its indices must be from 0 to {surrogate.similarity.dim - 1}",
        )


def _expected_shapes(surrogate: ShapeSurrogate) -> Iterator[Shaped]:
    transform, inputs = surrogate.transform, surrogate.active.size
    bins, components = surrogate.edges_s.size - 1, len(np.atleast_1d(transform.components))
    yield "edges_s", surrogate.edges_s, (bins + 1,)
    yield "transform: mean", transform.mean, (bins,)
    yield "transform: components", transform.components, (components, bins)
    yield "transform: truncation", transform.truncation, (bins,)
    yield "active", surrogate.active, (inputs,)
    yield from _expected_latent_shapes(surrogate.latents, inputs, 1 + components)


def _expected_latent_shapes(latents: Latents, inputs: int, count: int) -> Iterator[Shaped]:
    if isinstance(latents, CorrectedLatents):
        yield from _expected_latent_shapes(latents.coarse, inputs, min(count, _latent_count(latents.coarse)))
        yield from _expected_latent_shapes(latents.correction, inputs, count)
    if not isinstance(latents, LatentGPs | LatentChaos):
        return
    rows = len(np.atleast_1d(latents.inputs))
    yield "latents: inputs", latents.inputs, (rows, inputs)
    yield "latents: targets", latents.targets, (rows, count)
    if isinstance(latents, LatentChaos):
        terms = len(np.atleast_1d(latents.indices))
        yield "latents: indices", latents.indices, (terms, inputs)
        yield "latents: active", latents.active, (terms, count)
        yield "latents: errors", latents.errors, (count,)
        return
    yield "latents: linear_maps", latents.linear_maps, (count, inputs, inputs)
    yield "latents: nuggets", latents.nuggets, (count,)
    yield "latents: inflation", latents.inflation, (count,)
    known = [name for name in latents.kernels if name in KERNELS]
    yield "latents: kernels", np.zeros(len(known)), (count,)


def _latent_count(latents: Latents) -> int:
    """Returns the number of latents of the coarse model.

    Only the fine model has latents of further components.
    """
    known = latents.targets if isinstance(latents, LatentGPs | LatentChaos) else np.zeros((1, 1))
    return known.shape[-1] if known.ndim > 1 else 0
