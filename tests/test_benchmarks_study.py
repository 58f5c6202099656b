"""The benchmark of a population's intervals: few small studies, whose true values the intervals contain."""

from __future__ import annotations

import numpy as np
import pytest

from bayeskin.study import SamplerSettings


def test_posteriors_of_the_benchmark_contain_their_true_values(benchmark):
    """The draws are exact: each true value has a uniform rank among them."""
    study, rng = benchmark("study_coverage"), np.random.default_rng(0)
    x = np.log([8e4, 2e4, 2e-14, 2e-14])
    ranks = np.array([(study.posterior(x, rng) < x).mean(axis=0) for _ in range(150)])
    informed = ranks[:, [0, 1, 3]]
    assert np.mean((informed > 0.05) & (informed < 0.95)) == pytest.approx(0.9, abs=0.06)
    assert informed.std() == pytest.approx(np.sqrt(1.0 / 12.0), abs=0.04)


def test_intervals_of_a_study_contain_their_true_values(benchmark, monkeypatch):
    """A study has 20 intervals; intervals of half the width would contain 12 of the true values."""
    study = benchmark("study_coverage")
    monkeypatch.setattr(study, "DRAWS", 400)
    row = study.infer({"sources": "", "seed": 2, "index": 1}, SamplerSettings(max_sweeps=100))
    assert set(row) == set(study.ROWS.columns)
    inside = [
        study.inside([row], name, quantity)[0] for name in study.SPACE.names for quantity in study.QUANTITIES
    ]
    assert 16 <= np.sum(inside) <= 20
    assert not row["contradictions"]
    shrunk, alone = (np.mean([row[f"{n} error {w}"] for n in study.SPACE.names]) for w in ("shrunk", "alone"))
    assert shrunk < 0.8 * alone
    assert study.coverage_table([row]).count("%") == 25
    assert study.shrinkage_table([row]).count("%") == 8
