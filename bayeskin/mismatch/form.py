"""A form for what is left unexplained: the fewest terms of a library that predict phases left out.

Residual and terms are whitened by the measured noise and orthogonal to what parameters could take up
(`unexplained`). Terms are added one by one, each the one that most lowers the squared error in phases left
out; the coefficients that predict a phase are fitted to all others. One is kept if what it gains is

    more than the best of the whole library gains from noise alone in 19 of 20 draws,
    more than the standard error of the gain over phases (a gain in one phase alone is no form), and
    a share of at least `WORTH` of the squared residual,

and all together are proposed if they predict a third of what exceeds the noise. Where each phase of nine errs in
a smooth way of its own, with two holds and three rests to agree by chance, one recording in six is still given
a form: it is a proposal, to be tried, and no finding.

Sparse regression on a library of functions: Brunton, Proctor & Kutz 2016, PNAS 113:3932. Whole phases are left
out because neighbouring residuals correlate.
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

    r2_left_out: share of the squared, whitened residual that is predicted in phases left out;
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
    """Gram matrices by phase: terms' (b, p, p), with the residual (b, p), and its own squares (b,)."""

    gram: Array
    cross: Array
    square: Array

    def left_out(self, chosen: list[int]) -> Array:
        """Squared error (b,) in each phase from coefficients fitted to the others."""
        if not chosen:
            return self.square
        g, c = self.gram[:, chosen][:, :, chosen], self.cross[:, chosen]
        others = np.linalg.solve(g.sum(axis=0) - g + _ridge(len(chosen)), (c.sum(axis=0) - c)[:, :, None])
        b = others[:, :, 0]
        return np.asarray(
            self.square - 2.0 * np.einsum("bi,bi->b", b, c) + np.einsum("bi,bij,bj->b", b, g, b)
        )

    def coefficients(self, chosen: list[int]) -> tuple[Array, Array]:
        """Of all phases, and their standard errors: the larger of the noise's and the jackknife's."""
        g, c = self.gram[:, chosen][:, :, chosen], self.cross[:, chosen]
        whole = np.linalg.solve(g.sum(axis=0) + _ridge(len(chosen)), c.sum(axis=0))
        each = np.linalg.solve(g.sum(axis=0) - g + _ridge(len(chosen)), (c.sum(axis=0) - c)[:, :, None])[..., 0]
        jackknife = np.sqrt((1.0 - 1.0 / len(g)) * np.sum((each - each.mean(axis=0)) ** 2, axis=0))
        noise = np.sqrt(np.diag(np.linalg.inv(g.sum(axis=0) + _ridge(len(chosen)))))
        return whole, np.maximum(jackknife, noise)


def _ridge(size: int) -> Array:
    return 1e-9 * np.eye(size)  # terms have unit length: keeps a term that all but one phase lack solvable


def propose_form(found: Fit, motion: PadMotion, seed: int) -> Form:
    """The form of what a fit leaves unexplained. `motion` is the recording's own."""
    rest = unexplained(found, motion)
    binned = found.log_posterior.binned
    terms = library(rest, binned.edges_s, binned.phases, motion)
    white, terms, length = _whitened(rest, terms)
    target = rest.basis @ (rest.reduce @ rest.residual_n)
    blocks = _blocks(white, target, rest.at.phase)
    chosen = _chosen(blocks, _by_noise(white, rest, seed)) if len(terms) and len(blocks.square) > 1 else []
    whole_square, gain = blocks.square.sum(), (blocks.square - blocks.left_out(chosen)).sum()
    if not chosen or gain < ENOUGH * (whole_square - rest.basis.shape[1]):
        sentence = "No form found: no term of the library predicts what is unexplained in phases left out."
        return Form((), 0.0, np.zeros(len(target)), sentence)
    whole, error = blocks.coefficients(chosen)
    overlap = white.T @ white
    picked = tuple(
        FormTerm(
            terms[i].name, float(value / length[i]), float(sd / length[i]), terms[i].unit,
            tuple(terms[j].name for j in np.flatnonzero(np.abs(overlap[i]) > ALIKE) if j != i),
        )
        for i, value, sd in zip(chosen, whole, error, strict=True)
    )  # fmt: skip
    r2 = float(gain / whole_square)
    force = rest.root @ (white[:, chosen] @ whole)
    return Form(picked, r2, force, _in_words(picked, [terms[i] for i in chosen], r2))


def _whitened(rest: Unexplained, terms: list[Term]) -> tuple[Array, list[Term], Array]:
    """Terms (k, p) of unit length beyond what parameters take up; those that can be tested; their lengths."""
    raw = np.stack([term.values for term in terms], axis=1)
    white = rest.basis @ (rest.reduce @ raw)
    length = np.linalg.norm(white, axis=0)
    whole = np.linalg.norm(np.linalg.solve(rest.root, raw), axis=0)
    seen = length > SEEN * np.maximum(whole, 1e-300)
    white = white / np.where(seen, length, 1.0)
    largest = np.max([np.sum(white[rest.at.phase == p] ** 2, axis=0) for p in np.unique(rest.at.phase)], axis=0)
    kept = np.flatnonzero(seen & (largest < ONE_PHASE))
    return white[:, kept], [terms[i] for i in kept], length[kept]


def _blocks(white: Array, target: Array, phase: NDArray[np.int64]) -> _Blocks:
    inside = [phase == p for p in np.unique(phase)]
    return _Blocks(
        np.array([white[m].T @ white[m] for m in inside]),
        np.array([white[m].T @ target[m] for m in inside]),
        np.array([target[m] @ target[m] for m in inside]),
    )


def _by_noise(white: Array, rest: Unexplained, seed: int) -> float:
    """What the best single term gains of noise, at LEVEL."""
    noise = np.random.default_rng(seed).standard_normal((len(rest.bins), DRAWS))
    noise = rest.basis @ (rest.basis.T @ noise)
    inside = [rest.at.phase == p for p in np.unique(rest.at.phase)]
    cross = np.array([white[m].T @ noise[m] for m in inside])  # (b, p, draws)
    square = np.array([np.sum(white[m] ** 2, axis=0) for m in inside])[:, :, None]
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
    return (
        f"What is unexplained is near {parts}, which predicts {100 * r2:.0f} % of its square in phases left out."
    )
