"""Nonlinear solves where Newton's own step goes too far."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from bayeskin.model.newton import Equations, NewtonSolver


@pytest.mark.parametrize("start", [1.0, 3.0, -40.0])
def test_a_step_that_does_not_contract_is_damped(start: float) -> None:
    """arctan x = 0: undamped Newton diverges from |x| > 1.39."""
    equations = Equations(
        free=np.arange(2),
        residual=np.arctan,
        tangent=lambda x: (sp.csr_matrix(np.diag(1.0 / (1.0 + x**2))), sp.csr_matrix((2, 0))),
        weight=np.full(2, 1e8),
        scale=np.ones(2),
        place=np.zeros(1),
    )
    found = NewtonSolver().solve(equations, np.array([start, 0.5 * start]))
    assert found is not None
    np.testing.assert_allclose(found, 0.0, atol=1e-7)
