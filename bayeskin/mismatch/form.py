"""Proposes a form for the unexplained force: the fewest terms of a library that predict phases left out.

Residual and terms are compared by least squares, after the part that the parameters could explain is removed
from both (`unexplained`). Terms are added one by one. Each time the term is added that most lowers the
squared error in phases left out; the coefficients that predict a phase are fitted to all other phases. The
term is kept if its gain is

    more than the best term of the whole library gains from noise alone in 19 of 20 draws,
    more than the standard error of the gain over phases (a gain in one phase alone is no form), and
    at least the share `worth` of the squared residual.

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
from bayeskin.mismatch.unexplained import UNEXPLAINED, Unexplained, unexplained
from bayeskin.number_format import number, unit_text
from bayeskin.types import Array, PadMotion


@dataclass(frozen=True)
class FormSettings:
    """Settings of the search for a form.

    most : largest number of terms
    worth : smallest gain of a term, as a share of the squared residual
    enough : smallest gain of all terms, as a share of the squared residual beyond the noise
    level : probability that the best term of the library gains more than the limit from noise alone
    draws : number of draws of the noise
    ridge : number that is added to the diagonal for terms of unit norm. It keeps the equations solvable for
        two terms that differ only in the phase left out.
    one_phase : share of a term's square in a single phase above which no other phase can test it
    alike : correlation of two terms above which they cannot be told apart
    nearly_best : share of the best gain from which a simpler term is preferred
    """

    most: int = 4
    worth: float = 0.05
    enough: float = 1.0 / 3.0
    level: float = 0.05
    draws: int = 400
    ridge: float = 1e-9
    one_phase: float = 0.9
    alike: float = 0.98
    nearly_best: float = 0.98


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


@dataclass(frozen=True)
class _Blocks:
    """The products of p terms and the residual, summed over each of b phases.

    gram : products of terms with each other, (b, p, p); cross : products of terms with the residual, (b, p)
    square : sum of squares of the residual, (b,)
    noise : covariance (p, p) of the products of terms with the noise, over all phases
    ridge : number that is added to the diagonal of the normal equations
    """

    gram: Array
    cross: Array
    square: Array
    noise: Array
    ridge: float

    def left_out(self, chosen: list[int]) -> Array:
        """Returns the squared error (b,) in each phase, with coefficients fitted to the other phases."""
        if not chosen:
            return self.square
        gram, cross = self._among(chosen)
        value = self._solved(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        fitted = np.einsum("bi,bij,bj->b", value, gram, value)
        return np.asarray(self.square - 2.0 * np.einsum("bi,bi->b", value, cross) + fitted)

    def coefficients(self, chosen: list[int]) -> tuple[Array, Array]:
        """Returns coefficients fitted to all phases, and their standard errors, (p,) each.

        The standard error is the larger of the one by the noise and the one by the jackknife over phases.
        """
        gram, cross = self._among(chosen)
        fits = self._solved(gram.sum(axis=0) - gram, cross.sum(axis=0) - cross)
        jackknife = (1.0 - 1.0 / len(gram)) * np.sum((fits - fits.mean(axis=0)) ** 2, axis=0)
        inverse = np.linalg.inv(gram.sum(axis=0) + self.ridge * np.eye(len(chosen)))
        noise_variance = np.diag(inverse @ self.noise[np.ix_(chosen, chosen)] @ inverse)
        standard_errors = np.sqrt(np.maximum(jackknife, noise_variance))
        return self._solved(gram.sum(axis=0), cross.sum(axis=0)), standard_errors

    def _among(self, chosen: list[int]) -> tuple[Array, Array]:
        """Returns `gram` and `cross` of the chosen terms."""
        return self.gram[:, chosen][:, :, chosen], self.cross[:, chosen]

    def _solved(self, gram: Array, cross: Array) -> Array:
        """Returns the coefficients (..., p) that solve normal equations (..., p, p) and (..., p)."""
        stable = gram + self.ridge * np.eye(gram.shape[-1])
        return np.asarray(np.linalg.solve(stable, cross[..., None])[..., 0])


def propose_form(fit: Fit, motion: PadMotion, seed: int, settings: FormSettings = FormSettings()) -> Form:
    """Returns a form for the force that a fit leaves unexplained; `motion` is the recording's protocol."""
    remainder = unexplained(fit, motion)
    binned = fit.log_posterior.binned
    terms = library(remainder, binned.edges_s, binned.phases, motion)
    shapes, terms, norm = _testable_terms(remainder, terms, settings.one_phase)
    target_n = remainder.beyond(remainder.residual_n)
    blocks = _blocks(shapes, target_n, remainder, settings.ridge)
    chosen = (
        _chosen(blocks, _gain_from_noise(shapes, remainder, seed, settings), settings)
        if len(terms) and len(blocks.square) > 1 else []
    )  # fmt: skip
    total, gain = float(blocks.square.sum()), float((blocks.square - blocks.left_out(chosen)).sum())
    noise_square = float(np.trace(remainder.basis.T @ remainder.noise_n2 @ remainder.basis))
    if not chosen or gain < settings.enough * (total - noise_square):
        sentence = "No form found: no term of the library predicts the unexplained force in held-out phases."
        return Form((), 0.0, np.zeros(len(target_n)), sentence)
    values, standard_errors = blocks.coefficients(chosen)
    correlation = shapes.T @ shapes
    form_terms = tuple(
        FormTerm(
            terms[i].name, float(value / norm[i]), float(sd / norm[i]), terms[i].unit,
            tuple(terms[j].name for j in np.flatnonzero(np.abs(correlation[i]) > settings.alike) if j != i),
        )
        for i, value, sd in zip(chosen, values, standard_errors, strict=True)
    )  # fmt: skip
    r2 = gain / total
    return Form(
        form_terms, r2, shapes[:, chosen] @ values, _in_words(form_terms, [terms[i] for i in chosen], r2)
    )


def _testable_terms(
    remainder: Unexplained, terms: list[Term], one_phase: float
) -> tuple[Array, list[Term], Array]:
    """Returns the terms (k, p) without the part that parameters could explain, scaled to unit norm.

    Only terms that can be tested are returned. The results are their values, the terms and their norms.
    """
    values = np.stack([term.values for term in terms], axis=1)
    remaining = remainder.beyond(values)
    norm = np.linalg.norm(remaining, axis=0)
    testable = norm > UNEXPLAINED.seen * np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    remaining = remaining / np.where(testable, norm, 1.0)
    largest_share = np.max([np.sum(remaining[inside] ** 2, axis=0) for inside in _phases(remainder)], axis=0)
    kept = np.flatnonzero(testable & (largest_share < one_phase))
    return remaining[:, kept], [terms[i] for i in kept], norm[kept]


def _phases(remainder: Unexplained) -> list[NDArray[np.bool_]]:
    """Returns for each phase which bins belong to it, (k,)."""
    return [remainder.at.phase == phase for phase in np.unique(remainder.at.phase)]


def _blocks(shapes: Array, target: Array, remainder: Unexplained, ridge: float) -> _Blocks:
    """Returns the products of terms `shapes` (k, p) and the residual `target` (k,) [N], by phase."""
    phases = _phases(remainder)
    return _Blocks(
        np.array([shapes[phase].T @ shapes[phase] for phase in phases]),
        np.array([shapes[phase].T @ target[phase] for phase in phases]),
        np.array([target[phase] @ target[phase] for phase in phases]),
        shapes.T @ remainder.noise_n2 @ shapes,
        ridge,
    )


def _gain_from_noise(shapes: Array, remainder: Unexplained, seed: int, settings: FormSettings) -> float:
    """Returns the gain that the best single term exceeds with probability `level` where all is noise."""
    noise_n = np.random.default_rng(seed).standard_normal((remainder.basis.shape[1], settings.draws))
    noise_n = remainder.expand @ noise_n
    phases = _phases(remainder)
    cross = np.array([shapes[phase].T @ noise_n[phase] for phase in phases])  # (b, p, draws)
    square = np.array([np.sum(shapes[phase] ** 2, axis=0) for phase in phases])[:, :, None]
    coefficient = (cross.sum(axis=0) - cross) / (square.sum(axis=0) - square)
    gain = np.sum(2.0 * coefficient * cross - coefficient**2 * square, axis=0)
    return float(np.quantile(gain.max(axis=0), 1.0 - settings.level))


def _chosen(blocks: _Blocks, noise_gain: float, settings: FormSettings) -> list[int]:
    """Returns the numbers of the terms of the form, in the order in which they are added.

    noise_gain : smallest gain of a term, from `_gain_from_noise`
    """
    chosen: list[int] = []
    total = float(blocks.square.sum())
    while len(chosen) < settings.most:
        before = blocks.left_out(chosen)
        unused = [i for i in range(blocks.cross.shape[1]) if i not in chosen]
        gains = np.array([before - blocks.left_out([*chosen, i]) for i in unused])  # (p, b)
        gain = gains.sum(axis=1)
        standard_error = np.sqrt(gains.shape[1]) * gains.std(axis=1, ddof=1)
        kept = (gain > noise_gain) & (gain > standard_error) & (gain > settings.worth * total)
        if not kept.any():
            break
        nearly_best = gain >= settings.nearly_best * gain[kept].max()
        chosen.append(unused[int(np.flatnonzero(kept & nearly_best)[0])])
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
