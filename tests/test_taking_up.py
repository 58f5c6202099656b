"""The full model takes up a fit: coarse runs, lifted by one of its own mesh, save most of those."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import toy
from test_mismatch import KNOWN, QUIET, Scaled, building, concealing
from toy_inference import TRUTH

from bayeskin.mismatch.fit import fit_near
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline import taking_up

OFF = 0.97  # of the force: what the coarse mesh makes of it


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Counts runs of a full model that is the toy's, a little stiffer, and of a coarse one that is softer."""
    made = {"coarse": 0, "fine": 0}

    class Full:
        def __init__(self, spec, motion, edges_s):
            self.coarse = spec.refinement == 0

        def __call__(self, case):
            return self.with_slopes(case, {})[0]

        def with_slopes(self, case, changes):
            made["coarse" if self.coarse else "fine"] += 1
            names, values = case
            surrogate = building(concealing(0), names).surrogate

            def force(theta):
                row = [theta[name] for name in surrogate.space.names]
                return (OFF if self.coarse else 1.02) * surrogate.predict_mean([row])[0]

            moved = [(force({**values, name: values[name] + 1e-4 * by}) - force(values)) / 1e-4
                     for name, by in changes.items()]  # fmt: skip
            return force(values), np.array(moved).T

    monkeypatch.setattr(taking_up, "FullForce", Full)
    return made


@pytest.mark.parametrize("names", [(), ("force-offset",)])
def test_the_coarse_mesh_leads_the_full_model_to_its_own_maximum(
    names: tuple[str, ...], runs: dict[str, int]
) -> None:
    right = building(dataclasses.replace(concealing(0, names, F0=-0.04), noise_priors=QUIET), names)
    truth = {**TRUTH, **({"F0": -0.04} if names else {})}
    noise = {name: 2e-3 if name.startswith("sd_") else 0.5 for name in right.names if name not in truth}
    start = fit_near(names, right, {**truth, **noise, "nu_noise": 60.0}, None)
    bench = SimpleNamespace(
        spec=ModelSpec(), motion=toy.MOTION, binned=right.binned, with_mesh_error=lambda surrogate: surrogate,
        known={name: KNOWN[name] for name in names},
        run=SimpleNamespace(config=SimpleNamespace(seed=1)),
    )  # fmt: skip
    full, about = taking_up._full(bench, start)
    assert full.settled
    exact = dataclasses.replace(right, surrogate=Scaled(right.surrogate, 1.02))
    best = fit_near(names, exact, full.theta, None)
    assert full.value > best.value - 2.5
    assert runs["fine"] <= 3
    assert about is not None
