"""A form for what is left unexplained: the fewest terms of a library that predict phases left out.

Of residual and terms, only what parameters could not take up is compared (`unexplained`), by least squares.
Terms are added one by one, each the one that most lowers the squared error in phases left out; the
coefficients that predict a phase are fitted to all others. It is kept if what it gains is

    more than the best of the whole library gains from noise alone in 19 of 20 draws,
    more than the standard error of the gain over phases (a gain in one phase alone is no form), and
    a share of at least `WORTH` of the squared residual,

and all together are proposed if they predict a third of what exceeds the noise. Where each of nine phases
errs in a smooth way of its own, with two holds and three rests to agree by chance, one recording in four is
still given a form: it is a proposal, to be tried, and no finding.

Sparse regression on a library of functions: Brunton, Proctor & Kutz 2016, PNAS 113:3932. Whole phases are
left out because neighbouring residuals correlate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.terms import Term, library
from bayeskin.mismatch.unexplained import Unexplained, unexplained
from bayeskin.types import Array, PadMotion

MOST = 4  # terms
WORTH = 0.05
ENOUGH = 1.0 / 3.0  # of the squared residual beyond the noise
LEVEL = 0.05
DRAWS = 400  # of noise
RIDGE = 1e-9  # terms have unit length: keeps two solvable that only the phase left out tells apart
SEEN = 1e-3  # of a term's length that must remain beyond what parameters take up
ONE_PHASE = 0.9  # of a term's square in a single phase, above which nothing can test it
ALIKE = 0.98  # correlation of two terms beyond which they are not told apart
NEARLY_BEST = 0.98  # of the best gain, with which the simpler of two terms is taken


@dataclass(frozen=True)
class FormTerm:
    """One term: coefficient and standard error over phases, in SI `unit`, and what it is not told from."""

    name: str
    coefficient: float
    standard_error: float
    unit: str
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Form:
    """A proposed form, empty where no form was found.

    r2_left_out: share of the squared residual that is predicted in phases left out;
    force_n (k,) the form beyond what parameters take up, on the fitted bins; sentence: in plain words.
    """

    terms: tuple[FormTerm, ...]
    r2_left_out: float
    force_n: Array
    sentence: str

    @property
    def found(self) -> bool:
        return bool(self.terms)


@dataclass(frozen=True)
class _Blocks:
    """By phase: products of terms (b, p, p), with the residual (b, p), its squares (b,); noise's (p, p)."""

    gram: Array
    cross: Array
    square: Array
    noise: Array

    def left_out(self, chosen: list[int]) -> Array:
        """Squared error (b,) in each phase from coefficients fitted to the others."""
        if not chosen:
            return self.square
        gram, cross = self._among(chosen)
        value = _solved(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        fitted = np.einsum("bi,bij,bj->b", value, gram, value)
        return np.asarray(self.square - 2.0 * np.einsum("bi,bi->b", value, cross) + fitted)

    def coefficients(self, chosen: list[int]) -> tuple[Array, Array]:
        """Of all phases, and their standard errors: the larger of the noise's and the jackknife's."""
        gram, cross = self._among(chosen)
        each = _solved(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        jackknife = (1.0 - 1.0 / len(gram)) * np.sum((each - each.mean(axis=0)) ** 2, axis=0)
        bread = np.linalg.inv(gram.sum(axis=0) + RIDGE * np.eye(len(chosen)))
        noise = np.diag(bread @ self.noise[np.ix_(chosen, chosen)] @ bread)
        return _solved(gram.sum(axis=0), cross.sum(axis=0)), np.sqrt(np.maximum(jackknife, noise))

    def _among(self, chosen: list[int]) -> tuple[Array, Array]:
        return self.gram[:, chosen][:, :, chosen], self.cross[:, chosen]


def _solved(gram: Array, cross: Array) -> Array:
    """Coefficients (..., p) of normal equations (..., p, p) and (..., p)."""
    return np.asarray(np.linalg.solve(gram + RIDGE * np.eye(gram.shape[-1]), cross[..., None])[..., 0])


def propose_form(found: Fit, motion: PadMotion, seed: int) -> Form:
    """The form of what a fit leaves unexplained. `motion` is the recording's own."""
    rest = unexplained(found, motion)
    binned = found.log_posterior.binned
    terms = library(rest, binned.edges_s, binned.phases, motion)
    shapes, terms, length = _beyond(rest, terms)
    target = rest.beyond(rest.residual_n)
    blocks = _blocks(shapes, target, rest)
    chosen = _chosen(blocks, _by_noise(shapes, rest, seed)) if len(terms) and len(blocks.square) > 1 else []
    whole, gain = float(blocks.square.sum()), float((blocks.square - blocks.left_out(chosen)).sum())
    by_noise = float(np.trace(rest.basis.T @ rest.noise_n2 @ rest.basis))
    if not chosen or gain < ENOUGH * (whole - by_noise):
        sentence = "No form found: no term of the library predicts what is unexplained in phases left out."
        return Form((), 0.0, np.zeros(len(target)), sentence)
    values, errors = blocks.coefficients(chosen)
    overlap = shapes.T @ shapes
    picked = tuple(
        FormTerm(
            terms[i].name, float(value / length[i]), float(sd / length[i]), terms[i].unit,
            tuple(terms[j].name for j in np.flatnonzero(np.abs(overlap[i]) > ALIKE) if j != i),
        )
        for i, value, sd in zip(chosen, values, errors, strict=True)
    )  # fmt: skip
    r2 = gain / whole
    return Form(picked, r2, shapes[:, chosen] @ values, _in_words(picked, [terms[i] for i in chosen], r2))


def _beyond(rest: Unexplained, terms: list[Term]) -> tuple[Array, list[Term], Array]:
    """Terms (k, p) of unit length beyond what parameters take up, only what can be tested; their lengths."""
    raw = np.stack([term.values for term in terms], axis=1)
    shapes = rest.beyond(raw)
    length = np.linalg.norm(shapes, axis=0)
    seen = length > SEEN * np.maximum(np.linalg.norm(raw, axis=0), 1e-300)
    shapes = shapes / np.where(seen, length, 1.0)
    largest = np.max([np.sum(shapes[inside] ** 2, axis=0) for inside in _phases(rest)], axis=0)
    kept = np.flatnonzero(seen & (largest < ONE_PHASE))
    return shapes[:, kept], [terms[i] for i in kept], length[kept]


def _phases(rest: Unexplained) -> list[NDArray[np.bool_]]:
    return [rest.at.phase == phase for phase in np.unique(rest.at.phase)]


def _blocks(shapes: Array, target: Array, rest: Unexplained) -> _Blocks:
    inside = _phases(rest)
    return _Blocks(
        np.array([shapes[m].T @ shapes[m] for m in inside]),
        np.array([shapes[m].T @ target[m] for m in inside]),
        np.array([target[m] @ target[m] for m in inside]),
        shapes.T @ rest.noise_n2 @ shapes,
    )


def _by_noise(shapes: Array, rest: Unexplained, seed: int) -> float:
    """What the best single term gains of noise, at LEVEL."""
    noise = np.random.default_rng(seed).standard_normal((rest.basis.shape[1], DRAWS))
    noise = rest.expand @ noise
    inside = _phases(rest)
    cross = np.array([shapes[m].T @ noise[m] for m in inside])  # (b, p, draws)
    square = np.array([np.sum(shapes[m] ** 2, axis=0) for m in inside])[:, :, None]
    others = (cross.sum(axis=0) - cross) / (square.sum(axis=0) - square)
    gain = np.sum(2.0 * others * cross - others**2 * square, axis=0)
    return float(np.quantile(gain.max(axis=0), 1.0 - LEVEL))


def _chosen(blocks: _Blocks, by_noise: float) -> list[int]:
    chosen: list[int] = []
    whole = float(blocks.square.sum())
    while len(chosen) < MOST:
        before = blocks.left_out(chosen)
        rest = [i for i in range(blocks.cross.shape[1]) if i not in chosen]
        gains = np.array([before - blocks.left_out([*chosen, i]) for i in rest])  # (p, b)
        total = gains.sum(axis=1)
        standard_error = np.sqrt(gains.shape[1]) * gains.std(axis=1, ddof=1)
        fit = (total > by_noise) & (total > standard_error) & (total > WORTH * whole)
        if not fit.any():
            break
        chosen.append(rest[int(np.flatnonzero(fit & (total >= NEARLY_BEST * total[fit].max()))[0])])
    return chosen


def _in_words(picked: tuple[FormTerm, ...], terms: list[Term], r2: float) -> str:
    def one(found: FormTerm, term: Term) -> str:
        value, error = term.shown * found.coefficient, term.shown * found.standard_error
        also = f" (or {found.alike[0]})" if found.alike else ""
        return f"{value:.3g} ± {error:.2g} {term.shown_unit} × {found.name}{also}"

    parts = " plus ".join(one(found, term) for found, term in zip(picked, terms, strict=True))
    share = f"{100 * r2:.0f} % of its square in phases left out"
    return f"What is unexplained is near {parts}, which predicts {share}."
