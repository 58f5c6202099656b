"""Compares the derivatives that a tissue law states with central differences of its response.

The law acts on the response of the base law, at random points without a mesh.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element import poroelastic
from bayeskin.finite_element.problem import Material, Sites, material
from bayeskin.finite_element.tissue import Bind, TissueLaw
from bayeskin.types import Array

POINTS = 16
STEP = 1e-5  # step of the differences, relative to the sizes
NEGLIGIBLE = 1e-2  # share of the base law's derivative that stands for any smaller change by the law
TIME_S, ELAPSED_S = 1.0, 0.7
GIVEN = {"F": slice(9), "p": slice(9, 10), "grad p": slice(10, 13)}  # columns of a state (n, 13)
ANSWERED = {"stress": slice(9), "content": slice(9, 10), "flux": slice(10, 13)}  # a response (n, 13)
SIZES = np.array([0.1] * 9 + [1e3] + [1e5] * 3)  # sizes of F - I, p [Pa] and grad p [Pa/m]


def derivative_errors(bind: Bind, values: Mapping[str, float], seed: int = 0) -> dict[str, float]:
    """Returns the largest error of each derivative that a law states, such as that of stress by F.

    An error is relative to the largest change that the law makes to this derivative. Errors of a correct law
    are below 1e-5. Half of the points have a memory from an earlier deformation.

    values : parameters of the full model and of the law, which should be far from its neutral values
    Raises InputError where `respond` leaves a part of the memory without a value.
    """
    rng = np.random.default_rng(seed)
    sites = _sites(rng)
    law, solid = bind(values, sites), material(values, sites.cutis)
    before = np.zeros((POINTS, law.remembers))
    after = _response(law, solid, _states(rng), before)[1]
    unfilled = int(np.isnan(after).any(axis=0).sum())
    if law.respond is not None and unfilled:
        problem = f"it leaves {unfilled} of {law.remembers} numbers of the memory without a value"
        raise InputError("respond", problem, "it must fill all of `after`, at all points")
    before[::2] = after[::2]
    state, none = _states(rng), TissueLaw()
    base = _derivatives(none, solid, state, before)
    stated, measured = _derivatives(law, solid, state, before) - base, np.empty_like(base)
    for column, step in enumerate(np.diag(STEP * SIZES)):
        ahead, behind = (
            _response(law, solid, state + moved, before)[0] - _response(none, solid, state + moved, before)[0]
            for moved in (step, -step)
        )
        measured[:, :, column] = (ahead - behind) / (2.0 * step[column])
    errors = {}
    for answer, rows in ANSWERED.items():
        for given, columns in GIVEN.items():
            b, s, m = (np.abs(a[:, rows, columns]).max() for a in (base, stated, measured))
            error = np.abs(stated - measured)[:, rows, columns].max()
            errors[f"{answer} by {given}"] = float(error / max(s, m, NEGLIGIBLE * b)) if error else 0.0
    return errors


def _sites(rng: np.random.Generator) -> Sites:
    """Returns points in both layers on the article's arm."""
    cutis, angle = np.arange(POINTS) % 4 < 2, rng.uniform(-0.5, 0.5, POINTS)
    radius_m = rng.uniform(np.where(cutis, 56e-3, 48e-3), np.where(cutis, 58e-3, 56e-3))
    along_m = rng.uniform(0.0, 0.05, POINTS)
    return Sites(cutis, np.stack([along_m, radius_m * np.sin(angle), radius_m * np.cos(angle)]))


def _states(rng: np.random.Generator) -> Array:
    """Returns random deformations, pressures and gradients, (n, 13)."""
    undeformed = np.concatenate([np.eye(3).ravel(), np.zeros(4)])
    return undeformed + SIZES * rng.uniform(-1.0, 1.0, (POINTS, 13))


def _given(state: Array) -> tuple[Array, Array, Array]:
    """Returns F (n, 3, 3), p (n,) and grad p (n, 3) of states."""
    deformation, pressure, gradient = (np.ascontiguousarray(state[:, part]) for part in GIVEN.values())
    return deformation.reshape(-1, 3, 3), pressure.ravel(), gradient


def _response(law: TissueLaw, solid: Material, state: Array, before: Array) -> tuple[Array, Array]:
    """Returns the response (n, 13) of the base law as the law changes it, and the law's memory."""
    given, shape, past = _given(state), (POINTS, 1), (np.ones((POINTS, 1)), np.zeros((POINTS, 1)))
    stress, content, flux = np.empty((*shape, 3, 3)), np.empty(shape), np.empty((*shape, 3))
    poroelastic.respond(
        *(g[:, None] for g in given), solid.mu, solid.lam, solid.mobility, solid.storage, ELAPSED_S, *past,
        stress, content, flux, np.empty(shape),
    )  # fmt: skip
    stress, content, flux, after = stress[:, 0], content[:, 0], flux[:, 0], np.full_like(before, np.nan)
    if law.respond is not None:
        law.respond(TIME_S, ELAPSED_S, law.par, law.data, *given, before, after, stress, content, flux)
    return np.concatenate([stress.reshape(-1, 9), content[:, None], flux], axis=1), after


def _derivatives(law: TissueLaw, solid: Material, state: Array, before: Array) -> Array:
    """Returns the derivatives (n, 13, 13) of the base law as the law changes them."""
    given = _given(state)
    shapes = ((9, 9), (9,), (9,), (), (3, 9), (3, 3))
    by = [np.zeros((POINTS, 1, *shape)) for shape in shapes]
    poroelastic.linearise(
        *(g[:, None] for g in given), solid.mu, solid.lam, solid.mobility, solid.storage, ELAPSED_S,
        np.zeros((POINTS, 1)), *by,
    )  # fmt: skip
    stress_f, stress_p, content_f, content_p, flux_f, flux_g = (array[:, 0] for array in by)
    if law.linearise is not None:
        law.linearise(
            TIME_S, ELAPSED_S, law.par, law.data, *given, before,
            stress_f, stress_p, content_f, content_p, flux_f, flux_g,
        )  # fmt: skip
    derivatives = np.zeros((POINTS, 13, 13))
    derivatives[:, :9, :9], derivatives[:, :9, 9] = stress_f, stress_p
    derivatives[:, 9, :9], derivatives[:, 9, 9] = content_f, content_p
    derivatives[:, 10:, :9], derivatives[:, 10:, 10:] = flux_f, flux_g
    return derivatives
