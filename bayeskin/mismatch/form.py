"""Proposes a form for the unexplained force: the fewest terms of a library that predict phases left out.

Residual and terms are compared by least squares, after the part that the parameters could explain is removed
from both (`unexplained`). Terms are added one by one. Each time the term is added that most lowers the
squared error in phases left out; the coefficients that predict a phase are fitted to all other phases. The
term is kept if its gain is

    more than the best term of the whole library gains from noise alone in 19 of 20 draws,
    more than the standard error of the gain over phases (a gain in one phase alone is no form), and
    at least the share `WORTH` of the squared residual.

All terms together are proposed if they predict a third of the squared residual that exceeds the noise. Such a
form is a proposal that needs a test, not a finding. Suppose that each of nine phases has a smooth error of
its own, and that two holds and three rests can agree by chance. Then one recording in four is still given a
form.

The method is a sparse regression on a library of functions: Brunton, Proctor & Kutz 2016, PNAS 113:3932.
Whole phases are left out because neighbouring residuals are correlated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.terms import Term, library
from bayeskin.mismatch.unexplained import Unexplained, unexplained
from bayeskin.number_format import number, unit_text
from bayeskin.types import Array, PadMotion

MOST = 4  # largest number of terms
WORTH = 0.05  # smallest gain of a term, as a share of the squared residual
ENOUGH = 1.0 / 3.0  # smallest gain of all terms, as a share of the squared residual beyond the noise
LEVEL = 0.05  # probability that the best term of the library gains more than the limit from noise alone
DRAWS = 400  # number of draws of the noise
# Added to the diagonal for terms of unit norm. It keeps the equations solvable for two terms that differ only
# in the phase left out.
RIDGE = 1e-9
SEEN = 1e-3  # smallest share of a term's norm that must remain after the parameters' part is removed
ONE_PHASE = 0.9  # share of a term's square in a single phase above which no other phase can test it
ALIKE = 0.98  # correlation of two terms above which they cannot be told apart
NEARLY_BEST = 0.98  # share of the best gain from which a simpler term is preferred


@dataclass(frozen=True)
class FormTerm:
    """One term of a form: its coefficient and the coefficient's standard error over phases, in SI `unit`.

    alike : names of the terms that cannot be told apart from it
    """

    name: str
    coefficient: float
    standard_error: float
    unit: str
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Form:
    """A proposed form, without terms where no form was found.

    r2_left_out : share of the squared residual that the form predicts in phases left out
    force_n : force (k,) [N] of the form on the fitted bins, without the part that parameters could explain
    sentence : the form in plain words
    """

    terms: tuple[FormTerm, ...]
    r2_left_out: float
    force_n: Array
    sentence: str

    @property
    def found(self) -> bool:
        """Returns whether a form was found."""
        return bool(self.terms)


@dataclass(frozen=True)
class _Blocks:
    """The products of p terms and the residual, summed over each of b phases.

    gram : products of terms with each other, (b, p, p); cross : products of terms with the residual, (b, p)
    square : sum of squares of the residual, (b,)
    noise : covariance (p, p) of the products of terms with the noise, over all phases
    """

    gram: Array
    cross: Array
    square: Array
    noise: Array

    def left_out(self, chosen: list[int]) -> Array:
        """Returns the squared error (b,) in each phase, with coefficients fitted to the other phases."""
        if not chosen:
            return self.square
        gram, cross = self._among(chosen)
        value = _coefficients(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        fitted = np.einsum("bi,bij,bj->b", value, gram, value)
        return np.asarray(self.square - 2.0 * np.einsum("bi,bi->b", value, cross) + fitted)

    def coefficients(self, chosen: list[int]) -> tuple[Array, Array]:
        """Returns coefficients fitted to all phases, and their standard errors, (p,) each.

        The standard error is the larger of the one by the noise and the one by the jackknife over phases.
        """
        gram, cross = self._among(chosen)
        fits = _coefficients(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        jackknife = (1.0 - 1.0 / len(gram)) * np.sum((fits - fits.mean(axis=0)) ** 2, axis=0)
        inverse = np.linalg.inv(gram.sum(axis=0) + RIDGE * np.eye(len(chosen)))
        noise_variance = np.diag(inverse @ self.noise[np.ix_(chosen, chosen)] @ inverse)
        return _coefficients(gram.sum(axis=0), cross.sum(axis=0)), np.sqrt(
            np.maximum(jackknife, noise_variance)
        )

    def _among(self, chosen: list[int]) -> tuple[Array, Array]:
        """Returns `gram` and `cross` of the chosen terms."""
        return self.gram[:, chosen][:, :, chosen], self.cross[:, chosen]


def _coefficients(gram: Array, cross: Array) -> Array:
    """Returns the coefficients (..., p) that solve normal equations (..., p, p) and (..., p)."""
    return np.asarray(np.linalg.solve(gram + RIDGE * np.eye(gram.shape[-1]), cross[..., None])[..., 0])


def propose_form(found: Fit, motion: PadMotion, seed: int) -> Form:
    """Returns a form for the force that a fit leaves unexplained; `motion` is the recording's protocol."""
    remainder = unexplained(found, motion)
    binned = found.log_posterior.binned
    terms = library(remainder, binned.edges_s, binned.phases, motion)
    shapes, terms, norm = _testable_terms(remainder, terms)
    target_n = remainder.beyond(remainder.residual_n)
    blocks = _blocks(shapes, target_n, remainder)
    chosen = (
        _chosen(blocks, _gain_from_noise(shapes, remainder, seed))
        if len(terms) and len(blocks.square) > 1 else []
    )  # fmt: skip
    total, gain = float(blocks.square.sum()), float((blocks.square - blocks.left_out(chosen)).sum())
    noise_square = float(np.trace(remainder.basis.T @ remainder.noise_n2 @ remainder.basis))
    if not chosen or gain < ENOUGH * (total - noise_square):
        sentence = "No form found: no term of the library predicts the unexplained force in held-out phases."
        return Form((), 0.0, np.zeros(len(target_n)), sentence)
    values, standard_errors = blocks.coefficients(chosen)
    correlation = shapes.T @ shapes
    form_terms = tuple(
        FormTerm(
            terms[i].name, float(value / norm[i]), float(sd / norm[i]), terms[i].unit,
            tuple(terms[j].name for j in np.flatnonzero(np.abs(correlation[i]) > ALIKE) if j != i),
        )
        for i, value, sd in zip(chosen, values, standard_errors, strict=True)
    )  # fmt: skip
    r2 = gain / total
    return Form(
        form_terms, r2, shapes[:, chosen] @ values, _in_words(form_terms, [terms[i] for i in chosen], r2)
    )


def _testable_terms(remainder: Unexplained, terms: list[Term]) -> tuple[Array, list[Term], Array]:
    """Returns the terms (k, p) without the part that parameters could explain, scaled to unit norm.

    Only terms that can be tested are returned. The results are their values, the terms and their norms.
    """
    values = np.stack([term.values for term in terms], axis=1)
    remaining = remainder.beyond(values)
    norm = np.linalg.norm(remaining, axis=0)
    testable = norm > SEEN * np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    remaining = remaining / np.where(testable, norm, 1.0)
    largest_share = np.max([np.sum(remaining[inside] ** 2, axis=0) for inside in _phases(remainder)], axis=0)
    kept = np.flatnonzero(testable & (largest_share < ONE_PHASE))
    return remaining[:, kept], [terms[i] for i in kept], norm[kept]


def _phases(remainder: Unexplained) -> list[NDArray[np.bool_]]:
    """Returns for each phase which bins belong to it, (k,)."""
    return [remainder.at.phase == phase for phase in np.unique(remainder.at.phase)]


def _blocks(shapes: Array, target: Array, remainder: Unexplained) -> _Blocks:
    """Returns the products of terms `shapes` (k, p) and the residual `target` (k,) [N], by phase."""
    phases = _phases(remainder)
    return _Blocks(
        np.array([shapes[phase].T @ shapes[phase] for phase in phases]),
        np.array([shapes[phase].T @ target[phase] for phase in phases]),
        np.array([target[phase] @ target[phase] for phase in phases]),
        shapes.T @ remainder.noise_n2 @ shapes,
    )


def _gain_from_noise(shapes: Array, remainder: Unexplained, seed: int) -> float:
    """Returns the gain that the best single term exceeds with probability `LEVEL` where all is noise."""
    noise_n = np.random.default_rng(seed).standard_normal((remainder.basis.shape[1], DRAWS))
    noise_n = remainder.expand @ noise_n
    phases = _phases(remainder)
    cross = np.array([shapes[phase].T @ noise_n[phase] for phase in phases])  # (b, p, draws)
    square = np.array([np.sum(shapes[phase] ** 2, axis=0) for phase in phases])[:, :, None]
    coefficient = (cross.sum(axis=0) - cross) / (square.sum(axis=0) - square)
    gain = np.sum(2.0 * coefficient * cross - coefficient**2 * square, axis=0)
    return float(np.quantile(gain.max(axis=0), 1.0 - LEVEL))


def _chosen(blocks: _Blocks, noise_gain: float) -> list[int]:
    """Returns the numbers of the terms of the form, in the order in which they are added.

    noise_gain : smallest gain of a term, from `_gain_from_noise`
    """
    chosen: list[int] = []
    total = float(blocks.square.sum())
    while len(chosen) < MOST:
        before = blocks.left_out(chosen)
        unused = [i for i in range(blocks.cross.shape[1]) if i not in chosen]
        gains = np.array([before - blocks.left_out([*chosen, i]) for i in unused])  # (p, b)
        gain = gains.sum(axis=1)
        standard_error = np.sqrt(gains.shape[1]) * gains.std(axis=1, ddof=1)
        kept = (gain > noise_gain) & (gain > standard_error) & (gain > WORTH * total)
        if not kept.any():
            break
        chosen.append(unused[int(np.flatnonzero(kept & (gain >= NEARLY_BEST * gain[kept].max()))[0])])
    return chosen


def _in_words(picked: tuple[FormTerm, ...], terms: list[Term], r2: float) -> str:
    """Returns the form in plain words."""

    def text(fitted: FormTerm, term: Term) -> str:
        value, error = term.shown * fitted.coefficient, term.shown * fitted.standard_error
        also = f" (or {fitted.alike[0]})" if fitted.alike else ""
        return f"{number(value)} ± {number(error, 2)} {unit_text(term.shown_unit)} × {fitted.name}{also}"

    parts = " plus ".join(text(fitted, term) for fitted, term in zip(picked, terms, strict=True))
    share = f"{100 * r2:.0f} % of its square in held-out phases"
    return f"The unexplained force is approximately {parts}, which predicts {share}."
