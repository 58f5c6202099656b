"""A stage by itself: what each tissue mechanism does to the force, beside the base's surrogate.

Each part of a mechanism is run with and without at the same base parameters, the other parts neutral: at
many points on the coarsest bricks, and at some of the base's design in the full model itself, which correct
what the coarse runs have taught.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.design import Wave, fine_wave, sobol_points
from bayeskin.errors import InputError
from bayeskin.mechanisms import Mechanism, catalogue, laws
from bayeskin.mechanisms.binned import estimate_of
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.pipeline.crew import crew
from bayeskin.pipeline.design import tell
from bayeskin.pipeline.engine import Run, Stage
from bayeskin.pipeline.folder import sha256_of
from bayeskin.pipeline.model import model_spec
from bayeskin.pipeline.shipping import shipped_files
from bayeskin.pipeline.training import base_surrogate
from bayeskin.runner import Simulate, run_design
from bayeskin.surrogates import (
    Effect,
    Pair,
    Similarity,
    Validation,
    load_manifest,
    load_surrogate,
    manifest_of,
    save_surrogate,
    train_effect,
)
from bayeskin.types import Array, Design, PadMotion, Parameter, ParameterSpace, Simulation
from bayeskin.workers import Map

WEAKEST = 0.1  # of a strength's prior: effects below are straight lines to nothing, and lost in noise


@dataclass(frozen=True)
class Part:
    """Parameters of a mechanism that act by themselves, the strength first; `name` is one word."""

    name: str
    mechanism: Mechanism
    own: tuple[Parameter, ...]

    @property
    def neutral(self) -> float:
        """Of the strength."""
        return self.mechanism.neutral[self.own[0].name]

    @property
    def own_names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.own)


def parts_of(mechanism: Mechanism) -> list[Part]:
    """The parts of a mechanism, named after it and, where there are several, after their strengths."""
    by_name = {p.name: p for p in mechanism.parameters}
    parts = mechanism.whole_or_parts
    return [
        Part(
            mechanism.name if len(parts) == 1 else f"{mechanism.name}-{names[0]}",
            mechanism,
            tuple(by_name[name] for name in names),
        )
        for names in parts
    ]


def simulate_with(
    mechanism: str,
    neutral: Mapping[str, float],
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
) -> Simulation:
    """A full run with one mechanism; its parameters that are not in theta are neutral."""
    return simulate(spec, motion, {**neutral, **theta}, laws=laws([catalogue()[mechanism]]))


def effect_wave(part: Part, design: Design, points: int, held_out: int, seed: int) -> Wave:
    """Points of the base's design, each with values of the part's parameters from its prior."""
    inputs = Similarity(design.space).inputs(design.theta)
    return with_own(part, fine_wave(design, inputs, points, held_out, seed))


def coarse_wave(space: ParameterSpace, points: int, seed: int) -> Wave:
    """Points of the base's whole prior box for the coarse model, the same for all parts."""
    theta = sobol_points(space, points, [seed, int(sha256_of("coarse")[:8], 16)])
    return Wave(space, theta, np.zeros(points, bool), 0, seed, {"rule": "Sobol' points over the prior box"})


def nested(wave: Wave, few: Wave) -> Wave:
    """A coarse wave with the training points of a fine one (in as many parameters), where the difference of
    the models is then known."""
    more = few.theta[~few.held_out, : wave.space.dim]
    theta = np.concatenate([wave.theta, more])
    rule = f"{wave.record['rule']}, and points of the fine model's"
    return replace(wave, theta=theta, held_out=np.zeros(len(theta), bool), record={"rule": rule})


def with_own(part: Part, base: Wave) -> Wave:
    """A wave of base parameters with values of the part's own beside them.

    These are drawn anew for each point, from its own seed: a sequence that fills their box by itself goes in
    step with the base's, and leaves most of a plane of one parameter of each empty.
    """
    own, number = ParameterSpace(part.own), int(sha256_of(part.name)[:8], 16)
    points = [[base.seed, number, int(sha256(row.tobytes()).hexdigest()[:16], 16)] for row in base.theta]
    unit = np.array([np.random.default_rng(point).uniform(size=own.dim) for point in points])
    if own.parameters[0].lower == part.neutral:
        unit[:, 0] = WEAKEST + (1.0 - WEAKEST) * unit[:, 0]
    theta = np.concatenate([base.theta, own.from_unit(unit)], axis=1)
    space = ParameterSpace((*base.space.parameters, *part.own))
    rule = f"{base.record['rule']}, with draws of {', '.join(own.names)}"
    return Wave(space, np.clip(theta, space.lower, space.upper), base.held_out, 0, base.seed, {"rule": rule})


def _work(run: Run) -> Mapping[str, Any]:
    return {part.name: _learn(run, part) for mechanism in _chosen(run) for part in parts_of(mechanism)}


def _chosen(run: Run) -> list[Mechanism]:
    tissue = {name: m for name, m in catalogue().items() if isinstance(m.act, Tissue)}
    names = run.config.effects.mechanisms or list(tissue)
    for name in names:
        if name not in tissue:
            where = f"{run.config_path}: effects.mechanisms"
            raise InputError(where, name, f"some of {', '.join(tissue)}")
    return [tissue[name] for name in names]


def _learn(run: Run, part: Part) -> dict[str, Any]:
    config, spec = run.config, model_spec(run)
    base = storage.load(run.at("design", "design.h5"), Design)
    coarse_spec = replace(spec, mesh="bricks", refinement=0)
    wave = coarse_wave(base.space, config.effects.coarse, config.seed)
    few = effect_wave(part, base, config.effects.points, config.effects.held_out, config.seed)
    many = nested(with_own(part, wave), few)
    with crew(run) as run_all:
        make = partial(_runs, run, run_all, base.edges_s)
        without = make("coarse", coarse_spec, nested(wave, few), None)
        coarse = make(f"{part.name}, coarse", coarse_spec, many, part)
        fine = make(part.name, spec, few, part)
    storage.save(run.at("effects", f"{part.name}-design.h5"), fine)
    return _train(run, part, Pair(coarse, base_force(without, coarse)), Pair(fine, base_force(base, fine)))


def _runs(
    run: Run, run_all: Map, edges_s: Array, label: str, spec: ModelSpec, wave: Wave, part: Part | None
) -> Design:
    """The runs of a wave with a part of a mechanism, or (None) without; none is made twice."""
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    known = [vars(p) for p in wave.space.parameters]
    name = "base" if part is None else part.name
    identity = sha256_of([spec.hash, vars(motion), edges_s, name, known])
    task: Simulate = (
        partial(simulate, spec, motion)
        if part is None
        else partial(simulate_with, part.mechanism.name, dict(part.mechanism.neutral), spec, motion)
    )
    run.reporter.log(f"{label}: {len(wave.theta)} full runs")
    file = run.folder / "runs" / f"{name}-{identity[:12]}.h5"
    return run_design(file, wave, edges_s, task, spec.hash, run_all, partial(tell, run, label))


def effect_files(run: Run) -> list[Path]:
    """Of the effects that this run has learnt, else of those shipped with its surrogate; [] without any."""
    file = run.config.surrogate.file
    folder = run.folder / "effects"
    if not list(folder.glob("*.json")) and file is not None:
        folder = shipped_files(run).surrogate.with_name(f"{Path(file).stem}-effects")
    return sorted(path for path in folder.glob("*.h5") if not path.stem.endswith("-design"))


def effects_of(run: Run) -> list[Effect]:
    """The effects in `effect_files`. Raises InputError for files of another model."""
    found = []
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    for path in effect_files(run):
        said, surrogate = load_manifest(path), load_surrogate(path)
        if said["model_hash"] != model_spec(run).hash:
            raise InputError(path, "an effect of another model", "one of this configuration's model")
        about = said["effect"]
        own, mechanism = tuple(about["own"]), catalogue()[about["mechanism"]]
        estimate = estimate_of(mechanism, own, motion, surrogate.edges_s)
        found.append(Effect(about["part"], mechanism.name, about["neutral"], own, surrogate, estimate))
    return found


def _train(run: Run, part: Part, coarse: Pair, fine: Pair) -> dict[str, Any]:
    """The effect's surrogate, into the stage's folder, and what is known of its error."""
    own = list(part.own_names)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    try:
        effect, validation = train_effect(
            part.name, part.mechanism.name, part.neutral, own, coarse, fine, run.config.surrogate.kind,
            run.config.seed, estimate_of(part.mechanism, own, motion, fine.design.edges_s),
        )  # fmt: skip
    except InputError as few:
        run.reporter.log(f"{part.name}: no surrogate: {few}")
        return {"learnt": False, "message": str(few)}
    said = {"learnt": True, **_errors(run, effect, validation, fine.without_n, fine.design)}
    manifest = {**manifest_of(effect.surrogate, validation), "effect": {
        "part": effect.part, "mechanism": effect.mechanism, "neutral": effect.neutral, "own": own,
    }, **said}  # fmt: skip
    save_surrogate(run.at("effects", f"{part.name}.h5"), effect.surrogate, manifest)
    run.reporter.log(in_words(part.name, said))
    return said


def in_words(name: str, said: Mapping[str, Any]) -> str:
    """One line on a part's surrogate."""
    if not said["learnt"]:
        return f"{name}: no surrogate: {said['message']}"
    return (
        f"{name}: held-out error {said['median_error_mn']:.2g} mN where the effect is "
        f"{said['median_effect_mn']:.3g} mN and the peak 1 N (medians)"
    )


def base_force(base: Design, design: Design) -> Array:
    """The base design's force (n, m) at the base parameters of each row of an effect's design."""
    row_of = {theta.tobytes(): row for row, theta in enumerate(base.theta)}
    theta = np.ascontiguousarray(design.theta[:, : base.space.dim])
    return base.force_n[[row_of[one.tobytes()] for one in theta]]


def _errors(
    run: Run, effect: Effect, validation: Validation, without: Array, design: Design
) -> dict[str, Any]:
    """Of the force with the effect, on held-out rows at forces of a skin test [mN]: of the effect's surrogate
    beside the base's own runs, and of both surrogates together."""
    rows = design.testing
    theta, truth = design.theta[rows], design.force_n[rows]
    alone = without[rows] + effect.predict(theta, without[rows]).mean
    base = base_surrogate(run).predict(theta[:, : -len(effect.own)]).mean
    both = base + effect.predict(theta, base).mean
    peak = np.abs(truth).max(axis=1)
    to_skin = 1e3 / np.maximum(peak, 1e-12)  # mN of a force whose peak is 1 N

    def rms(values: Array) -> Array:
        return np.asarray(np.sqrt(np.mean(values**2, axis=1)) * to_skin)

    return {
        "median_effect_mn": float(np.median(rms(truth - without[rows]))),
        "median_error_mn": float(np.median(rms(truth - alone))),
        "p90_error_mn": float(np.quantile(rms(truth - alone), 0.9)),
        "median_error_of_both_mn": float(np.median(rms(truth - both))),
        "coverage_90": validation.coverage_90,
        "rows": int(rows.sum()),
        "failed": int((~design.ok).sum()),
        "seconds_of_runs": float(np.nansum(design.seconds)),
    }


STAGE = Stage(
    "effects",
    "learns what each tissue mechanism does to the force",
    ("recording", "design", "train"),
    ("seed", "model", "parameters", "design", "surrogate", "fit", "effects"),
    _work,
)
