"""Kept factorisations: each solves with its own matrix, to the precision that their users correct."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from bayeskin.finite_element.linear import Pardiso, SuperLU, pypardiso

SOLVERS = [
    pytest.param(
        lambda: Pardiso(symmetric=True),
        1e-4,
        id="symmetric",
        marks=pytest.mark.skipif(pypardiso is None, reason="no MKL"),
    ),
    pytest.param(
        lambda: Pardiso(symmetric=False),
        1e-4,
        id="whole",
        marks=pytest.mark.skipif(pypardiso is None, reason="no MKL"),
    ),
    pytest.param(SuperLU, 1e-10, id="SuperLU"),
]


def matrices() -> list[sp.csr_matrix]:
    """Three saddle-point matrices of one pattern, unknowns many decades apart as in the model."""
    rng, n = np.random.default_rng(3), 60
    pattern = sp.random(n, n, 0.1, random_state=3) + sp.eye(n)
    pattern = ((pattern + pattern.T) != 0).astype(float)
    size = np.where(np.arange(n) < 45, 1.0, 1e-5)
    sign = np.where(np.arange(n) < 45, 1.0, -1.0)
    factorised = []
    for _ in range(3):
        matrix = pattern.multiply(0.3 * rng.standard_normal((n, n)))
        matrix = 0.5 * (matrix + matrix.T) + sp.diags(8.0 * sign)
        matrix = (sp.diags(size) @ matrix @ sp.diags(size)).tocsr()
        matrix.sort_indices()
        factorised.append(matrix)
    return factorised


@pytest.mark.parametrize(("solver", "accuracy"), SOLVERS)
def test_each_factorisation_solves_with_its_own_matrix(solver, accuracy):
    kept, given = solver(), matrices()
    scale = np.where(np.arange(60) < 45, 1.0, 1e5)
    for number, matrix in enumerate(given):
        kept.factorise(number, matrix, scale)
    assert kept.room >= 3
    rng = np.random.default_rng(1)
    for number in (2, 0, 1, 0):
        exact = rng.standard_normal((60, 4)) * scale[:, None] * [1.0, 1e-30, 1e20, 0.0]
        computed = kept.solve(number, given[number] @ exact)
        largest = np.abs(exact / scale[:, None]).max(axis=0)
        assert np.all(np.abs((computed - exact) / scale[:, None]).max(axis=0) <= accuracy * largest)
        column = kept.solve(number, given[number] @ exact[:, 0])
        np.testing.assert_allclose(column / scale, exact[:, 0] / scale, atol=accuracy * largest[0])
    kept.factorise(0, given[2], scale)  # replaced
    exact = rng.standard_normal(60) * scale
    np.testing.assert_allclose(kept.solve(0, given[2] @ exact) / scale, exact / scale, atol=4 * accuracy)
    kept.release()
