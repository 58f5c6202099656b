"""The reduced model as a forward model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import closed_form_reduced

from bayeskin.forward import reduced
from bayeskin.types import Simulation


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_run_whose_derivatives_are_not_finite_is_its_message(
    monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    context = closed_form_reduced.bench(monkeypatch, closed_form_reduced.recorded(0))
    simulate = reduced.simulate_reduced

    def overflowing(*arguments, **options) -> Simulation:
        simulation = simulate(*arguments, **options)
        if simulation.gradient_names:
            gradient_n = simulation.gradient_n.copy()
            gradient_n[5, 0] = value
            simulation = replace(simulation, gradient_n=gradient_n)
        return simulation

    monkeypatch.setattr(reduced, "simulate_reduced", overflowing)
    assert context.run((), closed_form_reduced.TRUTH) == "the derivatives of the run are not finite"
    assert not isinstance(context.run((), closed_form_reduced.TRUTH, derive=False), str)
