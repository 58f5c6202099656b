"""Effects of mechanisms: which inputs matter, and few fine runs that correct many coarse ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from toy import EDGES_S, SPACE, toy_bin_means, toy_simulate
from toy import MOTION as PULL

from bayeskin import storage
from bayeskin.design import default_space, first_wave, sobol_points
from bayeskin.distinct import at_distinct
from bayeskin.errors import InputError
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.fibre_anisotropy import AT_ANY_ANGLE
from bayeskin.mechanisms.strain_stiffening import first_modulus
from bayeskin.pipeline import effects as effects_stage
from bayeskin.pipeline.effects import _pairs, coarse_wave, force_at, name_of, parts_of, with_own
from bayeskin.proof.cases import shipped_screen
from bayeskin.proof.protocol import MOTION, SURROGATE
from bayeskin.runner import run_design
from bayeskin.shipped import shipped
from bayeskin.storage import contents_hash
from bayeskin.surrogates import (
    Pair,
    composed,
    effect_of,
    effects_among,
    effects_beside,
    effects_in,
    load_manifest,
    load_surrogate,
    manifest_of,
    save_surrogate,
    train,
    train_effect,
)
from bayeskin.surrogates.effects import WithEffects
from bayeskin.surrogates.screening import active_inputs
from bayeskin.types import Array, BinnedForce, Design, Parameter, ParameterSpace, Phase, Prediction

WIDE = ParameterSpace(
    (*SPACE.parameters, Parameter("a", "1", 0.0, 2.0, "uniform"), Parameter("idle", "1", 0.0, 1.0, "uniform"))
)


def pair(rows: int, bias: float, seed: int, held_out: int = 0) -> Pair:
    """The toy and an effect that bends with its force and with a; a coarse mesh is off by `bias` in both."""
    theta = sobol_points(WIDE, rows, seed)
    without = (1.0 + 0.1 * bias) * toy_bin_means(theta[:, : SPACE.dim])
    effect = theta[:, 5:6] * (1.0 + bias * (1.0 + 0.3 * theta[:, 5:6])) * without * np.abs(without) ** 0.5
    design = Design(
        WIDE, EDGES_S, theta, without + effect, np.zeros(rows, int), np.arange(rows) >= rows - held_out,
        np.ones(rows, bool), ("",) * rows, np.zeros(rows), seed, f"bias {bias}",
    )  # fmt: skip
    return Pair(design, without)


COARSE, FINE = pair(128, 0.05, 1), pair(40, 0.0, 2, held_out=12)


def error(found: Array, truth: Array) -> float:
    return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2)))


def test_fine_runs_take_the_coarse_mesh_s_error_out_of_an_effect() -> None:
    rows = FINE.design.testing
    theta, base, truth = FINE.design.theta[rows], FINE.without_n[rows], FINE.change()[rows]
    left = []
    for fine in (COARSE, FINE):  # corrected by itself, and by the fine model
        effect, validation = train_effect("a", ["toy"], {"a": 0.0}, ("a", "idle"), COARSE, fine, "gp")
        left.append(error(effect.predict(theta, base).mean, truth))
    assert left[0] > 0.05
    assert left[1] < 0.012
    assert validation.rows == rows.sum()
    assert effect.surrogate.provenance["model_hash"] == "bias 0.0"


def test_inputs_that_do_nothing_are_left_out() -> None:
    change = replace(COARSE.design, force_n=COARSE.change() / COARSE.design.theta[:, 5:6].clip(1e-6))
    weights = np.where(COARSE.design.theta[:, 5] > 0.05, 1.0, 0.0)
    active = active_inputs(change, weights)
    names = [WIDE.names[i] for i in active]
    assert "idle" not in names
    assert {"E_c", "E_s"} <= set(names)


def test_a_surrogate_of_some_inputs_is_stored_with_them(tmp_path: Path) -> None:
    some = np.array([0, 1, 2, 3, 5])
    surrogate, _ = train(COARSE.design, "gp", active=some)
    moved = COARSE.design.theta[:5].copy()
    moved[:, 6] = 1.0 - moved[:, 6]
    np.testing.assert_array_equal(
        surrogate.predict(moved).mean, surrogate.predict(COARSE.design.theta[:5]).mean
    )
    save_surrogate(tmp_path / "s.h5", surrogate, {})
    found = load_surrogate(tmp_path / "s.h5")
    np.testing.assert_array_equal(found.active, some)
    np.testing.assert_array_equal(found.predict(moved).mean, surrogate.predict(moved).mean)


def test_a_file_of_the_format_before_has_all_inputs_active(tmp_path: Path) -> None:
    surrogate, _ = train(COARSE.design, "gp")
    save_surrogate(tmp_path / "s.h5", surrogate, {})
    with h5py.File(tmp_path / "s.h5", "r+") as handle:
        del handle["active"]
        handle.attrs.update(format_version=3, arrays_sha256=contents_hash(handle))
    found = load_surrogate(tmp_path / "s.h5")
    theta = COARSE.design.theta[:5]
    np.testing.assert_array_equal(found.predict(theta).mean, surrogate.predict(theta).mean)


@pytest.mark.parametrize("kappa", [0.0, 0.1, 1 / 3])
def test_fibre_stress_is_what_the_fibres_pull_with_in_skin_a_quarter_longer(kappa: float) -> None:
    k2, asked = 7.0, 2.0e4
    k1 = first_modulus({"fibre_stress": asked, "k2": k2, "dispersion": kappa})

    def energy(c_xx: float) -> float:
        across = 1.25**-1  # squared stretch of the other two at the same volume
        strain = kappa * (c_xx + 2.0 * across - 3.0) + (1.0 - 3.0 * kappa) * (c_xx - 1.0)
        return float(k1 / (2.0 * k2) * (np.exp(k2 * strain**2) - 1.0))

    h = 1e-5
    stress = 2.0 * (energy(1.25**2 + h) - energy(1.25**2 - h)) / (2.0 * h)
    assert stress == pytest.approx(asked, rel=1e-6)


def test_rows_that_agree_are_predicted_once_and_all_get_their_own() -> None:
    rng = np.random.default_rng(0)
    theta = np.array([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0], [0.0, 9.0], [3.0, 4.0]])
    factor = rng.standard_normal((10, 7, 3))
    asked: list[Array] = []

    def predict(these: Array, also: Array) -> Prediction:
        asked.append(these)
        place = these[:, 0].astype(int)
        return Prediction(also[:, None] + np.zeros((1, 7)), factor[place], factor[place][:, :, 0] ** 2)

    plain = predict(theta, theta[:, 1])
    once = at_distinct(predict, theta, theta[:, 1])
    assert len(asked[-1]) == 3
    for name in ("mean", "factor", "diagonal"):
        np.testing.assert_array_equal(getattr(once, name), getattr(plain, name))


def test_an_error_of_the_force_grows_with_what_is_estimated_of_it() -> None:
    """One sd of the base's first error, taken through fibres along the pull and branches."""
    screen = shipped_screen()
    by_part = {effect.part: effect for effect in screen.effects}
    lines, branch = by_part["fibre-anisotropy"], by_part["solid-viscoelasticity-g_2"]
    base, whole = screen.refit.surrogate, WithEffects(screen.refit.surrogate, (branch, lines))
    theta = whole.space.from_unit(np.full((1, whole.space.dim), 0.5))
    theta[0, whole.space.names.index("langer_angle")] = 0.1
    values = dict(zip(whole.space.names, theta.T, strict=True))
    own = [np.stack([values[name] for name in one.space.names], axis=1) for one in (lines, branch)]

    def through(force: Array) -> Array:
        force = force + lines.predict_mean(own[0], force)
        return force + branch.predict_mean(own[1], force)

    alone = base.predict(theta[:, :5])
    found = whole.predict(theta)
    error = alone.factor[..., 0]
    grown = through(alone.mean + error) - through(alone.mean)
    assert np.linalg.norm(found.factor[..., 0]) == pytest.approx(np.linalg.norm(grown), rel=0.1)
    assert np.linalg.norm(grown) > 2.0 * np.linalg.norm(error)


def test_an_effect_learnt_beside_another_estimate_is_refused() -> None:
    effects = {effect.part: effect for effect in shipped_screen().effects}
    lines, stiff = effects["fibre-anisotropy"], effects["strain-stiffening"]
    other = [None, lambda own, force: 2.0 * lines.estimate(own, force)]
    for effect, estimate in ((lines, other[0]), (lines, other[1]), (stiff, lambda own, force: force)):
        with pytest.raises(InputError, match=f"effect {effect.part}: found learnt beside another estimate"):
            effect_of(effect.about, effect.surrogate, estimate)


def test_a_file_of_a_former_version_is_refused() -> None:
    (lines,) = (effect for effect in shipped_screen().effects if effect.part == "fibre-anisotropy")
    former = {name: value for name, value in lines.about.items() if name != "estimate"}
    with pytest.raises(InputError, match="found a file of a former version"):
        effect_of(former, lines.surrogate, lines.estimate)


def test_a_pair_counts_where_both_parts_are_there() -> None:
    def one(*mechanisms: str) -> Any:
        return SimpleNamespace(mechanisms=mechanisms, own=mechanisms)

    effects = [one("a"), one("b"), one("a", "b"), one("b", "c")]
    assert [e.own for e in effects_among(effects, ("a", "b"))] == [("a",), ("b",), ("a", "b")]
    assert [e.own for e in effects_among(effects, ("b", "c"))] == [("b",)]
    assert [e.own for e in effects_among(effects, ("a",))] == [("a",)]


def test_values_of_a_mechanism_fill_the_box_beside_the_base_s() -> None:
    """Sequences scrambled apart go in step: seven of eight cells of a plane stay empty."""
    part = parts_of(catalogue()["strain-stiffening"])[0]
    wave = with_own([part], coarse_wave(default_space(), 512, 1))
    shorter = with_own([part], coarse_wave(default_space(), 100, 1))
    np.testing.assert_array_equal(wave.theta[:100], shorter.theta)
    unit = wave.space.to_unit(wave.theta)
    for i in range(5):
        for j in range(5, wave.space.dim):
            cells = np.histogram2d(unit[:, i], unit[:, j], bins=8, range=[[0, 1], [0, 1]])[0]
            assert np.sum(cells == 0) < 8, (i, j)


def test_an_estimate_is_of_the_force_that_the_other_effects_make() -> None:
    """Two branches beside fibres: each as Effect has it, of the force with fibres, whatever the order."""
    screen = shipped_screen()
    by_part = {effect.part: effect for effect in screen.effects}
    branches = [by_part[f"solid-viscoelasticity-g_{i}"] for i in (1, 2)]
    fibres, base = by_part["strain-stiffening"], screen.refit.surrogate
    rng = np.random.default_rng(3)
    found = []
    for effects in ((fibres, *branches), (*branches, fibres)):
        whole = WithEffects(base, effects)
        theta = whole.space.from_unit(rng.uniform(0.2, 0.8, (4, whole.space.dim)))
        theta[2, 5:] = theta[1, 5:]
        theta[2, :5] = theta[1, :5]  # a row twice
        values = {name: theta[:, i] for i, name in enumerate(whole.space.names)}
        own = {e.part: np.stack([values[n] for n in e.space.names], axis=1) for e in effects}
        force = base.predict_mean(theta[:, :5])
        stiff = force + fibres.predict_mean(own[fibres.part], force)
        expected = stiff + sum(e.predict_mean(own[e.part], stiff) for e in branches)
        np.testing.assert_allclose(whole.predict_mean(theta), expected, rtol=1e-6)
        np.testing.assert_allclose(whole.predict(theta).mean, expected, rtol=1e-6)
        apart = stiff + sum(e.predict_mean(own[e.part], force) for e in branches)
        found.append(np.abs(apart - expected).max())
    assert min(found) > 1e-3


BOTH = ParameterSpace((*SPACE.parameters, *(Parameter(name, "1", 0.0, 2.0, "uniform") for name in "ab")))
LATE = np.clip(np.linspace(-1.0, 1.0, len(EDGES_S) - 1), 0.0, 1.0)


def runs_with(names: str, rows: int, seed: int, held_out: int) -> Design:
    """The toy with an effect a of its force, one b that comes late, and what both do beyond."""
    theta = sobol_points(BOTH, rows, seed)
    a, b = (theta[:, 5 + i : 6 + i] * (name in names) for i, name in enumerate("ab"))
    force = toy_bin_means(theta[:, : SPACE.dim])
    size = np.abs(force).max(axis=1, keepdims=True)
    force = force * (1.0 + 0.3 * a) + 0.2 * b * size * LATE + 0.4 * a * b * force * LATE
    space = ParameterSpace(tuple(p for p in BOTH.parameters if p.name not in "ab" or p.name in names))
    columns = [BOTH.names.index(name) for name in space.names]
    return Design(
        space, EDGES_S, theta[:, columns], force, np.zeros(rows, int), np.arange(rows) >= rows - held_out,
        np.ones(rows, bool), ("",) * rows, np.zeros(rows), seed, "toy",
    )  # fmt: skip


def test_what_two_do_beyond_both_is_an_effect_of_its_own() -> None:
    effects, missed = [], []
    base, _ = train(runs_with("", 160, 1, 0), "gp")
    test = runs_with("ab", 40, 5, 0)
    for names in ("a", "b", "ab"):
        pairs = []
        for rows, seed, held_out in ((160, 1, 0), (40, 2, 8)):
            neither, *alone = (
                runs_with(n, rows, seed, held_out) for n in ("", *(names if names == "ab" else ""))
            )
            with_it = runs_with(names, rows, seed, held_out)
            without = force_at([neither], with_it)
            if alone:
                without = composed(
                    without, [force_at([one], with_it) for one in alone], [without] * 2, [None] * 2
                )
            pairs.append(Pair(with_it, without))
        effect, _ = train_effect(names, names, dict.fromkeys(names, 0.0), tuple(names), *pairs, "gp")
        effects.append(effect)
        if len(effects) > 1:
            missed.append(error(WithEffects(base, tuple(effects)).predict_mean(test.theta), test.force_n))
        assert effect_of(effect.about, effect.surrogate, None) == effect
    assert missed[0] > 0.1
    assert missed[1] < 0.02


def test_a_pair_is_of_two_mechanisms_that_there_are() -> None:
    def run(*pairs: tuple[str, str]) -> SimpleNamespace:
        config = SimpleNamespace(effects=SimpleNamespace(pairs=pairs))
        return SimpleNamespace(config=config, config_path="x.toml")

    (found,) = _pairs(run(("pre-stretch", "solid-viscoelasticity-g_2")))
    assert name_of(found) == "pre-stretch-with-solid-viscoelasticity-g_2"
    (found,) = _pairs(run(("backlash", "pre-stretch")))
    assert name_of(found) == "pre-stretch-with-backlash"  # which acts on what the tissue makes
    for pair, says in (
        (("pre-stretch", "lotion"), "x.toml: effects.pairs: found pre-stretch and lotion"),
        (("solid-viscoelasticity-g_1", "solid-viscoelasticity-g_2"), "parts of two mechanisms"),
    ):
        with pytest.raises(InputError, match=says):
            _pairs(run(pair))


def test_what_lies_between_skin_and_drive_acts_on_all_that_the_tissue_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = shipped(SURROGATE)
    made_by = SimpleNamespace(hash=load_manifest(base)["model_hash"])
    monkeypatch.setattr(effects_stage, "model_spec", lambda run: made_by)
    monkeypatch.setattr(effects_stage, "effect_files", lambda run: effects_in(effects_beside(base)))
    storage.save(tmp_path / "motion.h5", MOTION)
    run: Any = SimpleNamespace(at=lambda *parts: tmp_path / parts[-1])
    whole = WithEffects(load_surrogate(base), tuple(effects_stage.effects_of(run)))
    acts = [effect.mechanisms for effect, *_ in whole._ordered]
    assert acts[-3:] == [("backlash",), ("pad-slip",), ("slow-recovery",)]
    assert ("solid-viscoelasticity",) in acts


def test_lines_along_the_pull_make_a_skin_as_many_times_as_stiff_and_others_less() -> None:
    act, angles = catalogue()["fibre-anisotropy"].act, np.linspace(0.0, np.pi / 2, 91)
    for ratio in (1.0, 1.5, 4.0):
        values = {"langer_ratio": np.full(91, ratio), "langer_angle": angles}
        (factor,) = act.estimate(values, PULL, lambda t: np.ones((91, len(t))))(np.zeros(1)).T
        gain = factor - AT_ANY_ANGLE * (ratio - 1.0)
        assert gain[0] == pytest.approx(ratio)
        assert np.all(gain > 1.0 - 1e-12)
        assert gain[55] == pytest.approx(1.0, abs=0.01 * ratio)
    # across, by hand: narrowing is held back, y = 2 / (4 + 3 r)
    assert gain[-1] == pytest.approx(2 * ((1 + (2 / 13) ** 2 + (11 / 13) ** 2) / 3 + 1.5 * (2 / 13) ** 2))


@dataclass(frozen=True)
class Spec:
    """Stands in for a model's, on a mesh of its own."""

    hash: str = "toy"

    @property
    def coarsest(self) -> Spec:
        return self


def toy_simulate_with(mechanisms: Sequence[str], spec: Any, motion: Any, theta: Mapping[str, float]) -> Any:
    """The toy with two mechanisms by their own names, and what both do beyond each."""
    found = toy_simulate(theta)
    force, late = found.force_n, np.clip(2.0 * found.time_s / found.time_s[-1] - 1.0, 0.0, 1.0)
    a, b = 5.0 * theta.get("opening", 0.0), 0.1 * (theta.get("langer_ratio", 1.0) - 1.0)
    force = force * (1.0 + a) - 0.3 * b * np.abs(force).max() * late * (1.0 + 8.0 * a)
    assert len(mechanisms) == ("opening" in theta) + ("langer_ratio" in theta)
    MADE.append((len(mechanisms), tuple(theta.values())))
    return replace(found, theta=theta, force_n=force)


MADE: list[tuple[int, tuple[float, ...]]] = []


def serial(task: Any, points: Sequence[Any]) -> Any:
    yield from ((i, task(point)) for i, point in enumerate(points))


@pytest.mark.slow
def test_the_stage_learns_parts_then_pairs_and_refines_where_they_are_plausible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(effects_stage, "simulate_with", toy_simulate_with)
    monkeypatch.setattr(effects_stage, "crew", lambda run: nullcontext(serial))
    monkeypatch.setattr(effects_stage, "model_spec", lambda run: Spec())
    for stage in ("recording", "design", "train", "effects"):
        (tmp_path / stage).mkdir()
    base_task = partial(toy_simulate_with, [], None, None)
    base_file = tmp_path / "design" / "base.h5"
    base = run_design(base_file, first_wave(SPACE, 96, 24, 1), EDGES_S, base_task, "toy", serial)
    MADE.clear()
    surrogate, validation = train(base, "gp")
    middle = toy_bin_means(SPACE.from_unit(np.full((1, 5), 0.5)))[0]
    bins = len(middle)
    recorded = BinnedForce(
        EDGES_S, middle, np.full(bins, (0.01 * np.abs(middle).max()) ** 2), np.zeros(bins - 1),
        np.zeros(bins, int), (Phase("hold", 1, 0.0, float(EDGES_S[-1])),),
    )  # fmt: skip
    storage.save(tmp_path / "recording" / "binned.h5", recorded)
    storage.save(tmp_path / "recording" / "motion.h5", PULL)
    storage.save(tmp_path / "design" / "design.h5", base)
    save_surrogate(tmp_path / "train" / "surrogate.h5", surrogate, manifest_of(surrogate, validation))

    def learnt(plausible: int, *pairs: tuple[str, str]) -> tuple[Any, dict[str, Any]]:
        settings = SimpleNamespace(
            mechanisms=["pre-stretch"], pairs=pairs, coarse=128, points=32, held_out=8, plausible=plausible
        )
        config = SimpleNamespace(
            effects=settings, seed=1, surrogate=SimpleNamespace(kind="gp", file=None),
            fit=SimpleNamespace(windows_s=None),
        )  # fmt: skip
        reporter = SimpleNamespace(log=lambda text: None, progress=lambda *what: None)
        run = SimpleNamespace(
            config=config, folder=tmp_path, config_path="x.toml", reporter=reporter,
            at=lambda *parts: tmp_path.joinpath(*parts),
        )  # fmt: skip
        return run, dict(effects_stage._work(run))

    names = ["pre-stretch", "fibre-anisotropy", "fibre-anisotropy-with-pre-stretch"]
    _, first = learnt(6)
    run, found = learnt(6, ("pre-stretch", "fibre-anisotropy"))
    assert first == {"pre-stretch": found["pre-stretch"]}  # whatever its file has of the pair's
    assert list(found) == names
    assert len(set(MADE)) == len(MADE)  # none twice
    for said in found.values():
        assert said["plausible"]["rows"] == 2
        assert said["prior"]["median_error_mn"] < 0.1 * said["prior"]["median_effect_mn"]
    count = len(MADE)
    assert learnt(6, ("pre-stretch", "fibre-anisotropy"))[1] == found
    assert len(MADE) == count
    loaded = effects_stage.effects_of(run)
    assert sorted(len(effect.mechanisms) for effect in loaded) == [1, 1, 2]
    both = with_own([parts_of(catalogue()[n])[0] for n in names[:2]], coarse_wave(SPACE, 64, 9))
    test_file = tmp_path / "test.h5"
    task = partial(toy_simulate_with, names[:2], None, None)
    test = run_design(test_file, both, EDGES_S, task, "toy", serial)
    whole = WithEffects(surrogate, tuple(loaded))
    columns = [test.space.names.index(name) for name in whole.space.names]
    apart = WithEffects(surrogate, tuple(effect for effect in loaded if len(effect.mechanisms) == 1))
    missed = [error(one.predict_mean(test.theta[:, columns]), test.force_n) for one in (whole, apart)]
    assert missed[0] < 0.5 * missed[1]
