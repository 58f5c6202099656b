"""The reduced model as a forward model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import solved

from bayeskin.forward import reduced
from bayeskin.types import Simulation


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_run_whose_derivatives_are_not_finite_is_its_message(
    monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    context = solved.bench(monkeypatch, solved.recorded(0))
    simulate = reduced.simulate_reduced

    def overflowing(*arguments, **options) -> Simulation:
        simulation = simulate(*arguments, **options)
        if simulation.gradient_names:
            gradient_n = simulation.gradient_n.copy()
            gradient_n[5, 0] = value
            simulation = replace(simulation, gradient_n=gradient_n)
        return simulation

    monkeypatch.setattr(reduced, "simulate_reduced", overflowing)
    assert context.run((), solved.TRUTH) == "the derivatives of the run are not finite"
    assert not isinstance(context.run((), solved.TRUTH, derive=False), str)
