"""The full model takes up a fit: coarse runs, lifted by one of its own mesh, save most of those."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import toy
from test_mismatch import KNOWN, QUIET, Scaled, Wrong, building, concealing
from toy_inference import TRUTH

from bayeskin.inference import LogPosterior
from bayeskin.mismatch.fit import Fit, fit_near
from bayeskin.mismatch.verdict import Evidence
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline import taking_up

COARSE, FINE = 0.97, 1.02  # of the toy's force: what either mesh makes of it
Values = Mapping[str, float]


@dataclasses.dataclass
class Runs:
    """All runs made, of the coarse mesh and of the model's own; `fails` says of which these fail."""

    coarse: list[Values] = dataclasses.field(default_factory=list)
    fine: list[Values] = dataclasses.field(default_factory=list)
    fails: Callable[[Values], bool] = lambda values: False


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    """Of a full model that is the toy."""
    made = Runs()

    class Full:
        def __init__(self, spec: ModelSpec, motion: object, edges_s: object) -> None:
            self.coarse = spec.refinement == 0

        def __call__(self, case: Any) -> Any:
            found = self.with_slopes(case, {})
            return found if isinstance(found, str) else found[0]

        def with_slopes(self, case: Any, changes: Values) -> Any:
            names, values = case
            (made.coarse if self.coarse else made.fine).append(dict(values))
            if not self.coarse and made.fails(values):
                return "did not converge"
            surrogate = building(concealing(0), names).surrogate

            def force(theta: Values) -> np.ndarray:
                row = [theta[name] for name in surrogate.space.names]
                return (COARSE if self.coarse else FINE) * surrogate.predict_mean([row])[0]

            moved = [(force({**values, name: values[name] + 1e-4 * by}) - force(values)) / 1e-4
                     for name, by in changes.items()]  # fmt: skip
            return force(values), np.array(moved).T

    monkeypatch.setattr(taking_up, "FullForce", Full)
    return made


def bench_of(names: tuple[str, ...], effects: int = 0) -> tuple[Any, Fit, LogPosterior]:
    """A workbench with a surrogate that is off, a fit to that, and the exact posterior."""
    right = building(dataclasses.replace(concealing(0, names, F0=-0.04), noise_priors=QUIET), names)
    skin = Wrong() if not names else dataclasses.replace(right.surrogate, inner=Wrong())
    wrong = dataclasses.replace(right, surrogate=skin)
    truth = {**TRUTH, **({"F0": -0.04} if names else {})}
    noise = {name: 2e-3 if name.startswith("sd_") else 0.5 for name in right.names if name not in truth}
    start = fit_near(names, wrong, {**truth, **noise, "nu_noise": 60.0}, None)
    learnt = [SimpleNamespace(mechanisms=names, own=(f"p{i}",)) for i in range(effects)]
    bench = SimpleNamespace(
        spec=ModelSpec(), motion=toy.MOTION, binned=right.binned,
        surrogate=lambda names: skin, effects=learnt, posterior=lambda until_s, these: building(wrong, these),
        known={name: KNOWN[name] for name in names}, run=SimpleNamespace(config=SimpleNamespace(seed=1)),
    )  # fmt: skip
    return bench, start, dataclasses.replace(right, surrogate=Scaled(right.surrogate, FINE))


def taken_up(names: tuple[str, ...], effects: int = 0) -> tuple[Any, Any, Fit, LogPosterior]:
    """What `_full` makes of a fit to a surrogate that is off, that fit, and the exact posterior."""
    bench, start, exact = bench_of(names, effects)
    return *taking_up._full(bench, start, None), start, exact


def unlike(made: list[Values]) -> bool:
    """Whether no two runs are of the same point."""
    points = np.array([[values[name] for name in TRUTH if name != "p_init"] for values in made])
    apart = [np.abs(a / b - 1.0).max() for i, a in enumerate(points) for b in points[:i]]
    return min(apart, default=1.0) > 1e-6


@pytest.mark.parametrize("names", [(), ("force-offset",)])
def test_the_coarse_mesh_leads_the_full_model_to_its_own_maximum(names: tuple[str, ...], runs: Runs) -> None:
    full, about, start, exact = taken_up(names)
    best = fit_near(names, exact, start.theta, None)
    assert full.settled
    assert full.value > best.value - 2.5
    assert full.runs == len(runs.fine)
    assert runs.coarse or not names  # without mechanisms the surrogate may do
    assert unlike(runs.coarse)
    assert unlike(runs.fine)
    assert len(runs.fine) <= taking_up.FULL_RUNS + (0 if names else taking_up.DIRECT_RUNS)
    assert about is not None


def test_only_several_effects_err_together(runs: Runs) -> None:
    assert [taken_up(("force-offset",), effects)[1].common > 0.0 for effects in (0, 1, 2)] == [
        False,
        False,
        True,
    ]


def test_a_full_run_that_fails_where_the_surrogate_s_fit_is_does_not_end_the_fit(runs: Runs) -> None:
    failed: list[Values] = []
    runs.fails = lambda values: not failed and not failed.append(values)  # type: ignore[func-returns-value]
    full, _, start, exact = taken_up(("force-offset",))
    assert failed
    assert full.value > fit_near(("force-offset",), exact, start.theta, None).value - 2.5


def test_a_full_model_of_which_no_run_converges_says_so(runs: Runs) -> None:
    runs.fails = lambda values: True
    assert taken_up(("force-offset",))[:2] == ("did not converge", None)


def test_the_fit_begins_at_other_tops_too_that_promise_more(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("force-offset",)
    bench, start, exact = bench_of(names)
    best = fit_near(names, exact, start.theta, None)
    low, high = start.log_posterior.bounds
    far = low + np.clip(start.unit + 0.3, 0.05, 0.95) * (high - low)
    theta = start.log_posterior.named(start.log_posterior.from_sampling(far))
    monkeypatch.setattr(taking_up, "COARSE_RUNS", 2)
    monkeypatch.setattr(taking_up, "FULL_RUNS", 1)
    reached = []
    for promised in (1e9, -1e9):
        top = dataclasses.replace(start, value=promised)
        monkeypatch.setattr(taking_up, "other_tops", lambda *rest, top=top: [top])
        full, _ = taking_up._full(bench, dataclasses.replace(start, theta=theta), None)
        assert isinstance(full, taking_up.FullFit)
        reached.append(full.value)
    assert reached[0] > best.value - 10.0
    assert reached[1] < reached[0] - 5.0


def test_a_set_that_stays_behind_is_left_before_the_model_s_own_mesh(runs: Runs) -> None:
    names = ("force-offset",)
    bench, start, exact = bench_of(names)
    best = fit_near(names, exact, start.theta, None)
    behind, _ = taking_up._full(bench, start, None, best.value + 100.0)
    assert isinstance(behind, taking_up.FullFit)
    assert len(runs.fine) == 1
    assert behind.value < best.value + 3.0
    ahead, _ = taking_up._full(bench, start, None, best.value - 5.0)
    assert isinstance(ahead, taking_up.FullFit)
    assert ahead.value == taking_up._full(bench, start, None)[0].value  # type: ignore[union-attr]


def test_the_mismatch_is_located_beside_the_best_run(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not beside the surrogate about it, whose error would take up what is missing."""
    bench, start, _ = bench_of(())
    bench.known = {}
    bumped = start.log_posterior.binned.force_n + 0.05 * (np.arange(len(start.force_n)) % 40 > 35)
    bench.binned = dataclasses.replace(start.log_posterior.binned, force_n=bumped)
    posterior = dataclasses.replace(start.log_posterior, binned=bench.binned)
    bench.posterior = lambda until_s, names: posterior
    sampled: list[Fit] = []
    for name, stand_in in (
        ("opened", lambda *rest: None), ("workbench", lambda run: bench),
        ("restored", lambda plain, posterior: dataclasses.replace(start, log_posterior=posterior)),
        ("resample", lambda found, *rest: sampled.append(found) or SimpleNamespace(draws=found.draws(20, 0))),
        ("propose_form", lambda *rest: None),
        ("discrepancy", lambda *rest: SimpleNamespace(without_log_evidence=1.0, log_evidence=2.0)),
    ):  # fmt: skip
        monkeypatch.setattr(taking_up, name, stand_in)
    taken = taking_up._whole_apart(Path("x"), {"names": []}, start.theta)
    assert not isinstance(taken.full, str | None)
    fitted = posterior.chain.bins
    left = bumped[fitted] - taken.full.force_n[fitted]
    assert taken.located.residual_n == pytest.approx(left, abs=1e-6)
    assert taken.located.windows
    assert taken.evidence == Evidence(1.0, 2.0)
    # What draws are made by is as unsure where the model was run as the surrogate itself.
    (drawn,) = sampled
    at = [taken.full.theta[name] for name in drawn.log_posterior.surrogate.space.names]
    unsure, own = (one.predict(at).sd() for one in (drawn.log_posterior.surrogate, bench.surrogate(())))
    assert np.mean(unsure**2) >= np.mean(own**2)
    # A rival that stays behind is left without draws.
    assert taking_up._whole_apart(Path("x"), {"names": []}, start.theta, 1e9) == taken.full_weight
    assert len(sampled) == 1
