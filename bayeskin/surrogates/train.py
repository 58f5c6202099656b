"""Trains a surrogate on a design and measures its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from bayeskin import __version__
from bayeskin.errors import InputError
from bayeskin.surrogates.chaos import LatentChaos, SparseFit, fit_sparse
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import LatentFit, fit_latent
from bayeskin.surrogates.shapes import ShapeTransform, all_components, split
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.surrogate import ROUNDING, Latents, ShapeSurrogate
from bayeskin.surrogates.validate import Validation, compare, validate
from bayeskin.types import Array, Design, ParameterSpace

Kind = Literal["gp", "chaos"]
F = TypeVar("F", LatentFit, SparseFit)


@dataclass(frozen=True)
class TrainSettings:
    """Settings of the training of a surrogate.

    most_components : largest number of principal components
    truncation_share : components are added until the remainder is at most this share of the shape's squared
        error; the remainder counts as noise of single bins
    margin : share of the region's width; rows just outside the region support the surrogate at its faces
    folds : number of folds that choose the kind where no row is held out
    """

    most_components: int = 12
    truncation_share: float = 0.01
    margin: float = 0.15
    folds: int = 4


TRAINING = TrainSettings()


def train(
    design: Design,
    kind: Literal["auto", "gp", "chaos"] = "auto",
    seed: int = 0,
    focus: Array | None = None,
    region: tuple[Array, Array] | None = None,
    active: NDArray[np.int64] | None = None,
) -> tuple[ShapeSurrogate, Validation]:
    """Returns the surrogate that is trained on the design's training rows, and its validation.

    The held-out rows only measure the error.

    kind : "auto" takes the kind with the smaller held-out error. Without held-out rows it takes the kind with
        the smaller error over four folds, which are drawn with `seed`.
    focus : (n,) weights of the design's rows in the principal components and in the decisive error
    region : lower and upper corner (d,) in the design's unit cube. The surrogate then predicts only inside
        this region, and learns from rows in the region and slightly around it.
    active : indices of the inputs of `Similarity` that matter (None: all)

    Raises InputError for too few rows, unsuitable weights, an empty region, or a force that is not finite.
    """
    space = design.space if region is None else narrowed(design.space, *region)
    focus = np.ones(len(design.theta)) if focus is None else np.asarray(focus, dtype=float)
    if focus.shape != (len(design.theta),) or not (np.all(focus >= 0.0) and np.all(np.isfinite(focus))):
        raise InputError(
            "focus",
            f"the shape is {focus.shape}",
            f"{len(design.theta)} finite weights of at least 0 are needed",
        )
    inputs = Similarity(space).inputs(design.theta)
    active = np.arange(inputs.shape[1]) if active is None else active
    training = design.training & _near_cube(inputs, TRAINING.margin) & (focus > 0.0)
    testing = design.testing & space.contains(design.theta) & (focus > 0.0)
    _refuse_unusable(design, space, training)
    kinds: tuple[Kind, ...] = ("gp", "chaos") if kind == "auto" else (kind,)
    if kind == "auto" and not testing.any():
        kinds = (_best_of_folds(kinds, space, design, training, focus, seed, active),)
    provenance = {
        "version": __version__,
        "design_seed": design.seed,
        "model_hash": design.model_hash,
        "seed": seed,
        "waves": int(design.wave.max(initial=0)) + 1,
    }
    results = []
    for name in kinds:
        surrogate = _fit(name, space, design, training, focus, provenance, active)
        results.append((surrogate, _validate_surrogate(surrogate, design, training, testing, focus)))
    return min(results, key=lambda result: result[1].relative_error)


def narrowed(space: ParameterSpace, lower: Array, upper: Array) -> ParameterSpace:
    """Returns the part of a space between two corners (d,) of its unit cube. Raises InputError if empty."""
    low, high = np.clip(np.asarray(lower, dtype=float), 0, 1), np.clip(np.asarray(upper, dtype=float), 0, 1)
    if low.shape != (space.dim,) or high.shape != (space.dim,) or not np.all(low < high):
        raise InputError(
            "region",
            f"its corners are {lower} and {upper}",
            f"they must be two corners of the {space.dim}-dimensional unit cube, the lower first",
        )
    corners = zip(space.parameters, space.from_unit(low), space.from_unit(high), strict=True)
    return ParameterSpace(tuple(replace(p, lower=float(a), upper=float(b)) for p, a, b in corners))


def _refuse_unusable(design: Design, space: ParameterSpace, training: NDArray[np.bool_]) -> None:
    fewest = space.dim + 3
    if training.sum() < fewest:
        problem = f"it has {training.sum()} finished training rows in the box"
        raise InputError("design", problem, f"at least {fewest} are needed")
    wrong = np.flatnonzero(design.ok & ~np.isfinite(design.force_n).all(axis=1))
    if len(wrong):
        where = f"design: row {wrong[0]}"
        raise InputError(where, "its force is not finite", "the force of every finished run must be finite")


def _near_cube(inputs: Array, margin: float) -> NDArray[np.bool_]:
    """Returns whether each row lies in the unit cube or at most `margin` outside it, (n,)."""
    return np.asarray(np.all((inputs >= -margin) & (inputs <= 1.0 + margin), axis=1))


def _fit(
    kind: Kind, space: ParameterSpace, design: Design, rows: NDArray[np.bool_], focus: Array,
    provenance: dict[str, Any], active: NDArray[np.int64],
) -> ShapeSurrogate:  # fmt: skip
    """Returns a surrogate of the given kind, trained on the given rows."""
    similarity = Similarity(space)
    inputs = similarity.inputs(design.theta)
    if kind == "chaos":
        # Polynomials grow steeply outside [-1, 1], so rows in a margin would dominate the fit.
        rows = rows & _near_cube(inputs, ROUNDING)
    inputs, log_scale, force_n = (
        inputs[rows][:, active],
        Similarity(space).log_scale(design.theta[rows]),
        design.force_n[rows],
    )
    latents: Latents
    if kind == "gp":
        transform, targets, gp_fits = fit_latents(fit_latent, inputs, log_scale, force_n, focus[rows])
        latents = LatentGPs.assemble(inputs, targets, gp_fits)
    else:
        transform, targets, chaos_fits = fit_latents(fit_sparse, inputs, log_scale, force_n, focus[rows])
        latents = LatentChaos.assemble(inputs, targets, chaos_fits)
    return ShapeSurrogate(space, design.edges_s, transform, latents, {**provenance, "kind": kind}, active)


def fit_latents(
    fit_one: Callable[[Array, Array, Array], F],
    inputs: Array,
    log_scale: Array,
    force_n: Array,
    weights: Array,
) -> tuple[ShapeTransform, Array, list[F]]:
    """Returns the transform, the targets, and the fits of the amplitude and of the components.

    Components are fitted until the remainder is negligible compared with the error of the fitted components.
    A component that no input predicts is kept too, because its error is common to all bins. If it were left
    out, it would count as independent noise of each bin, and would shift a posterior by many of its sd.
    """
    amplitude, shapes = split(force_n)
    full, variances = all_components(shapes, weights)
    scores = (shapes - full.mean) @ full.components.T
    fits = [fit_one(inputs, amplitude - log_scale, weights)]
    error, remainder = 0.0, float(variances.sum())  # the squares of a shape sum to the number of bins
    usable = int(np.sum(variances > 1e-14 * remainder))
    for k in range(min(TRAINING.most_components, len(inputs) // 3, usable)):
        if remainder <= max(TRAINING.truncation_share * error, 1e-14 * shapes.shape[1]):
            break
        fit = fit_one(inputs, scores[:, k], weights)
        fits.append(fit)
        error += fit.error
        remainder -= float(variances[k])
    transform = full.keep(len(fits) - 1, shapes, weights, fitted=len(fits))
    targets = transform.encode(force_n)
    targets[:, 0] -= log_scale
    return transform, targets, fits


def _validate_surrogate(
    surrogate: ShapeSurrogate, design: Design, training: NDArray[np.bool_], testing: NDArray[np.bool_],
    focus: Array,
) -> Validation:  # fmt: skip
    """Returns the validation on the held-out rows, or by leave-one-out if there are none."""
    if testing.any():
        return validate(surrogate, design.theta[testing], design.force_n[testing], focus[testing])
    if surrogate.provenance["kind"] == "chaos":
        training = training & _near_cube(surrogate.similarity.inputs(design.theta), ROUNDING)
    theta = design.theta[training]
    return compare(
        surrogate, surrogate.leave_one_out(theta), theta, design.force_n[training],
        "leave-one-out", focus[training],
    )  # fmt: skip


def _best_of_folds(
    kinds: tuple[Kind, ...], space: ParameterSpace, design: Design, training: NDArray[np.bool_],
    focus: Array, seed: int, active: NDArray[np.int64],
) -> Kind:  # fmt: skip
    """Returns the kind with the smaller squared error over folds that neither fit nor selection has used."""
    rows = np.flatnonzero(training & space.contains(design.theta))
    order = np.random.default_rng(seed).permutation(rows)
    errors = dict.fromkeys(kinds, 0.0)
    for k in range(TRAINING.folds):
        fold_rows = np.zeros_like(training)
        fold_rows[order[k :: TRAINING.folds]] = True
        for kind in kinds:
            surrogate = _fit(kind, space, design, training & ~fold_rows, focus, {}, active)
            residual = surrogate.predict_mean(design.theta[fold_rows]) - design.force_n[fold_rows]
            errors[kind] += float(focus[fold_rows] @ np.sum(residual**2, axis=1))
    return min(kinds, key=lambda kind: errors[kind])
