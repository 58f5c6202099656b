"""A reduced model beside the full one: forces, derivatives, error, other layers, files, enrichment."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from toys.same_steps import on_steps_of, start_at_zero
from toys.small_reduced import NAMES, SETTINGS, built, one_by_one, unheard

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.finite_element import series
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import Mechanism, catalogue, laws
from bayeskin.reduced import equations as equations_module
from bayeskin.reduced import simulate as simulate_module
from bayeskin.reduced.build import Teacher
from bayeskin.reduced.cases import BASE, Case
from bayeskin.reduced.enrichment import EnrichmentSettings, enrich
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.files import load_reduced, save_reduced
from bayeskin.reduced.library import Library, Modes
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.runs import FullRuns, depends_on
from bayeskin.reduced.sensitivities import ReducedGradients
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.store import Store
from bayeskin.types import PadMotion, Simulation

THETA = {"E_c": 9e4, "E_s": 2e4, "k_c": 3e-14, "k_s": 4e-13, "p_init": 300.0}
IN_SERIES = {
    "opening": 0.03, "recovery_compliance": 5e-4, "recovery_time": 20.0, "gap": 1e-4,
    "frame_compliance": 5e-4,
}  # fmt: skip
STRONG = {"damage": 0.3, "damage_energy": 2e3, "g_1": 0.5, "tau_1": 2.0, "g_2": 0.3, "tau_2": 60.0}
MOTION = PadMotion(
    np.array([0.0, 8.0, 30.0, 38.0, 45.0, 55.0, 80.0]), 1e-3 * np.array([0.0, 8.0, 8.0, 1.0, 1.0, 9.0, 9.0])
)
SPEC = ModelSpec(refinement=0)


def of(names: Sequence[str]) -> list[Mechanism]:
    return [catalogue()[name] for name in names]


def full(theta, names=(), spec=SPEC) -> Simulation:
    simulation = simulate(spec, MOTION, theta, laws=laws(of(names)))
    assert simulation.status == "ok"
    return simulation


def rms(simulation: Simulation, right: Simulation) -> float:
    """RMS over the peak."""
    time_s = np.arange(0.0, MOTION.time_s[-1], 0.5)
    wrong = simulation.at(time_s) - right.at(time_s)
    return float(np.sqrt(np.mean(wrong**2)) / np.abs(right.force_n).max())


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("training") / "runs.store"


@pytest.fixture(scope="module")
def model(training) -> ReducedModel:
    return built(training)


@pytest.mark.parametrize("names", [(), ("preconditioning",), NAMES], ids=["base", "one", "two"])
def test_the_force_is_near_the_full_models_on_a_protocol_never_seen(model, names) -> None:
    theta = THETA | (STRONG if names else {})
    reduced = simulate_reduced(model, MOTION, theta, of(names), estimate=True)
    right = full(theta, names)
    assert reduced.status == "ok"
    assert reduced.stats["inside"] == 1.0
    assert rms(reduced, right) < 6e-3
    estimate = reduced.stats["error_estimate_n"] / reduced.stats["peak_force_n"]
    assert rms(reduced, right) / 2.0 < estimate < 5e-2


def test_the_estimate_sees_modes_that_are_missing(model) -> None:
    base = model.library.base
    poor = replace(
        model, library=Library(Modes(base.displacement[:8], base.pressure[:8]), model.library.beyond)
    )
    errors = [simulate_reduced(m, MOTION, THETA, estimate=True) for m in (model, poor)]
    whole, few = (run.stats["error_estimate_n"] for run in errors)
    missed = rms(errors[1], full(THETA)) * errors[1].stats["peak_force_n"]
    assert few > 3.0 * whole
    assert few > missed / 2.0


@pytest.mark.parametrize(
    ("names", "changes"),
    [
        ((), {"E_c": 9e4, "E_s": 2e4, "k_c": 3e-14, "k_s": 4e-13, "p_init": 100.0}),
        (NAMES, {"E_s": 2e4, "k_c": 3e-14, "damage": 0.1, "damage_energy": 2e3, "g_1": 0.1, "tau_2": 60.0}),
        (("pre-stretch",), {"opening": 0.01, "E_c": 9e4}),
        (("slow-recovery", "solid-viscoelasticity"), {"recovery_compliance": 1e-4, "tau_1": 2.0, "E_c": 9e4}),
        (("backlash",), {"frame_compliance": 1e-4, "k_s": 4e-13}),
    ],
    ids=["base", "memory", "opened", "in series", "play"],
)
def test_derivatives_are_those_of_two_runs(model, names, changes, monkeypatch) -> None:
    """Central differences of two runs, solved tightly on the steps of the first."""
    monkeypatch.setattr(equations_module, "SOLVER_TOLERANCE", 1e-9)
    monkeypatch.setattr(series, "SERIES_TOLERANCE", 1e-9)
    parameters = {p.name for m in of(names) for p in m.parameters} | set(THETA)
    theta = {name: value for name, value in (THETA | STRONG | IN_SERIES).items() if name in parameters}
    space = model.space([name for name in names if name in NAMES])
    binds = laws(of(names))
    equations = ReducedEquations(space, theta, binds, MOTION)
    slopes = ReducedGradients(equations, theta, changes, binds, MOTION, lambda values: space)
    steps: list[Step] = []

    def on_step(step: Step) -> None:
        steps.append(step)
        start_at_zero(equations, step)
        if step.stages:
            slopes.follow(step)

    assert integrate(equations, theta["p_init"], 1e-2, on_step, falls_too=False) == ""
    for name, change, column in zip(changes, changes.values(), np.array(slopes.force_n).T, strict=True):
        ends = []
        for sign in (1.0, -1.0):
            moved = theta | {name: theta[name] + 0.01 * sign * change}
            ends.append(on_steps_of(ReducedEquations(space, moved, binds, MOTION), moved["p_init"], steps))
        difference = (ends[0] - ends[1]) / 0.02
        allowed = 0.01 * np.abs(difference).max() + 1e-5 * np.abs(ends[0]).max()
        np.testing.assert_allclose(column, difference, rtol=0, atol=allowed, err_msg=name)


def test_a_run_gives_its_derivatives_beyond_the_start(model) -> None:
    reduced = simulate_reduced(model, MOTION, THETA, gradients={"E_s": 2e4, "k_s": 4e-13})
    assert reduced.gradient_names == ("E_s", "k_s")
    assert reduced.gradient_n.shape == (len(reduced.time_s), 2)
    np.testing.assert_array_equal(reduced.gradient_n[0], 0.0)
    with pytest.raises(InputError, match="viscosity"):
        simulate_reduced(model, MOTION, THETA, gradients={"viscosity": 1.0})


def test_other_layers_move_the_nodes(model) -> None:
    geometry = replace(Geometry(), cutis_m=2.4e-3, subcutis_m=6.5e-3, arm_radius_m=42e-3)
    reduced = simulate_reduced(model, MOTION, THETA, geometry=geometry)
    moved = full(THETA, spec=ModelSpec(refinement=0, geometry=geometry))
    assert reduced.status == "ok"
    assert rms(reduced, moved) < 1.2e-2
    assert rms(reduced, full(THETA)) > 3.0 * rms(reduced, moved)


def test_outside_of_the_trained_region_nothing_runs(model) -> None:
    reduced = simulate_reduced(model, MOTION, THETA | {"E_c": 5e6})
    assert reduced.status == "failed"
    assert reduced.stats["inside"] == 0.0
    assert "E_c is 5e+06" in reduced.message
    unknown = simulate_reduced(model, MOTION, THETA | {"leakage": 1e-9}, of(["fluid-leakage"]))
    assert "fluid-leakage was not trained" in unknown.message


def test_relaxed_skin_that_is_pushed_together_is_near_folding(model) -> None:
    """A cutis 313 times as stiff as its subcutis relaxes while stretched; then the pads come back."""
    theta = {"E_c": 344e3, "E_s": 1.1e3, "k_c": 4.6e-15, "k_s": 9.3e-16, "p_init": 500.0}
    theta |= {"g_1": 0.8, "tau_1": 0.87, "g_2": 1.4, "tau_2": 43.0}
    back = PadMotion(np.array([0.0, 9.0, 120.0, 126.0]), 1e-3 * np.array([0.0, 9.5, 9.5, 0.0]))
    reduced = simulate_reduced(model, back, theta, of(["solid-viscoelasticity"]))
    assert reduced.status == "failed"
    assert "near folding" in reduced.message
    assert reduced.stats["inside"] == 0.0
    soft = simulate_reduced(model, back, THETA | {"g_1": 0.1, "tau_1": 2.0, "g_2": 0.0, "tau_2": 60.0},
                            of(["solid-viscoelasticity"]))  # fmt: skip
    assert soft.status == "ok"
    assert reduced.stats["stiffness_left"] < 0.4 < soft.stats["stiffness_left"]
    nearer = simulate_reduced(model, back, theta, of(["solid-viscoelasticity"]), least_stiffness=0.0)
    assert nearer.status == "ok", nearer.message
    assert nearer.stats["stiffness_left"] == reduced.stats["stiffness_left"]


def test_a_run_that_is_inside_out_between_its_points_has_failed(model, monkeypatch) -> None:
    monkeypatch.setattr(simulate_module.DualWeightedResidual, "follow", lambda *_: np.inf)
    reduced = simulate_reduced(model, MOTION, THETA, (), estimate=True)
    assert reduced.status == "failed"
    assert reduced.stats["inside"] == 0.0
    assert "the mesh is inverted between the cubature points; run the full model" in reduced.message


def test_full_runs_are_made_once(model, training, tmp_path) -> None:
    def refuse(function, items):
        assert items == []
        yield from ()

    cases = [case for kind in (BASE, *NAMES) for case in SETTINGS.cases(model.trained, kind)]
    lines = training.read_bytes().splitlines(keepends=True)
    (tmp_path / "fewer.store").write_bytes(b"".join([*lines[:4], *lines[5:]]))
    requested: list[Case] = []
    with Store(training, "training runs") as store, Store(tmp_path / "fewer.store", "training runs") as fewer:
        FullRuns(SPEC, store).make(cases, refuse, unheard)
        FullRuns(SPEC, fewer).make(
            cases,
            lambda function, items: (requested.append(c) or (n, function(c)) for n, c in enumerate(items)),
            unheard,
        )
        again = FullRuns(SPEC, fewer).read(cases[3])
        for name, value in vars(FullRuns(SPEC, store).read(cases[3])).items():
            np.testing.assert_array_equal(getattr(again, name), value)
    assert requested == [cases[3]]


def test_a_full_run_of_another_law_is_not_taken_for_it(model, training, monkeypatch) -> None:
    case = SETTINGS.cases(model.trained, NAMES[0])[0]
    with Store(training, "training runs") as store:
        assert depends_on(SPEC, case) in store
        monkeypatch.setattr("bayeskin.reduced.runs.law_hashes", dict.fromkeys)
        assert depends_on(SPEC, case) not in store


@pytest.fixture(scope="module")
def kept(model, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("kept") / "small-reduced.h5"
    save_reduced(path, model, {"made_by": "a test"})
    return path


def test_a_file_holds_the_model(model, kept) -> None:
    again = load_reduced(kept)
    assert again.trained == model.trained
    before, after = (simulate_reduced(m, MOTION, THETA | STRONG, of(NAMES)) for m in (model, again))
    assert rms(after, before) < 1e-3
    manifest = json.loads(kept.with_suffix(".json").read_text())
    assert manifest["full_model_hash"] == SPEC.hash
    assert set(manifest["laws"]) == set(NAMES)


def test_a_damaged_file_is_refused_in_one_line(kept, tmp_path) -> None:
    whole = kept.read_bytes()
    damaged = {"short.h5": whole[: len(whole) // 2], "text.h5": b"no", "empty.h5": b""}
    for name, contents in damaged.items():
        (tmp_path / name).write_bytes(contents)
        with pytest.raises(InputError, match=name):
            load_reduced(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        load_reduced(tmp_path / "none.h5")
    altered = tmp_path / "altered.h5"
    altered.write_bytes(whole)
    with h5py.File(altered, "r+") as handle:
        handle["cubatures/base/factor"][0] *= 2.0
    with pytest.raises(InputError, match="stored hash"):
        load_reduced(altered)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda said: said["laws"].update(preconditioning="0" * 64),
            "another version of the mechanism preconditioning",
        ),
        (lambda said: said.update(full_model_hash="0" * 64), "another version of the full model"),
    ],
)
def test_another_version_of_the_laws_is_refused(kept, tmp_path, change, says) -> None:
    path = tmp_path / "other.h5"
    path.write_bytes(kept.read_bytes())
    with h5py.File(path, "r+") as handle:
        said = json.loads(handle.attrs["manifest"])
        change(said)
        handle.attrs["manifest"] = json.dumps(said)
        assert storage.contents_hash(handle) == handle.attrs["arrays_sha256"]
    with pytest.raises(InputError, match=says):
        load_reduced(path)


@pytest.mark.slow
def test_enrichment_ends_where_the_measured_error_is_small(model, tmp_path) -> None:
    settings = EnrichmentSettings(
        first=3, most=6, points=260, shadows=4, wanted=2e-3, modes=(60, 40), width=0.03
    )
    calls: list[int] = []

    def counted(function, items):
        if not isinstance(function, Teacher):  # the runs that train a cubature are reduced ones
            calls.append(len(items))
        yield from one_by_one(function, items)

    theta = THETA | STRONG
    with Store(tmp_path / "runs.store", "near") as store:
        enriched = enrich(model, theta, NAMES, MOTION, settings, store, counted, unheard)
    assert enriched.error <= settings.wanted
    assert sum(calls) == enriched.full_runs
    there = simulate_reduced(enriched.model, MOTION, theta, of(NAMES))
    before = simulate_reduced(model, MOTION, theta, of(NAMES))
    right = full(theta, NAMES)
    assert rms(there, right) < min(2e-3, rms(before, right))
    far = simulate_reduced(enriched.model, MOTION, theta | {"E_c": 1e6}, of(NAMES))
    assert far.stats["inside"] == 0.0
    calls.clear()
    with Store(tmp_path / "runs.store", "near") as store:
        enrich(model, theta, NAMES, MOTION, settings, store, counted, unheard)
    assert sum(calls) == 0
