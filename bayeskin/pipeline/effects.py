"""A stage by itself: what the mechanisms that the full model solves do to the force, beside its surrogate.

Each part of a mechanism is run with and without at the same base parameters, the other parts neutral: at
many points on the coarsest bricks, and at some of the base's design in the full model itself, which correct
what the coarse runs have taught. Of the base's design those points are left out whose subcutis a diagnosis
takes for too stiff, or at which a coarse run's force is far from any that the recording may have. Of a pair,
run together and each alone, what both do beyond what their surrogates make of them is learnt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin import storage
from bayeskin.design import Wave, fine_wave, next_wave, sobol_points
from bayeskin.errors import InputError
from bayeskin.mechanisms import Mechanism, catalogue, laws
from bayeskin.mechanisms.binned import estimate_of, estimates_by_name
from bayeskin.mechanisms.mechanism import Tissue, solved
from bayeskin.mismatch.fit import soft_on_stiff
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.pipeline.crew import crew
from bayeskin.pipeline.design import fitted_bins, noise_floor_n, rows_of, tell
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
    composed,
    effects_beside,
    effects_in,
    load_effect,
    manifest_of,
    save_surrogate,
    train_effect,
    with_effects,
)
from bayeskin.surrogates.effects import Estimate
from bayeskin.types import (
    Array,
    BinnedForce,
    Design,
    PadMotion,
    Parameter,
    ParameterSpace,
    Simulation,
    Surrogate,
)
from bayeskin.workers import Map

LARGEST = 3.0  # force of a coarse run, of the recording's; beyond, runs with fibres can take minutes
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
    mechanisms: Sequence[str],
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
) -> Simulation:
    """A full run with mechanisms; their parameters that are not in theta are neutral."""
    known = [catalogue()[name] for name in mechanisms]
    neutral = {name: value for one in known for name, value in one.neutral.items()}
    return simulate(spec, motion, {**neutral, **theta}, laws=laws(known))


def effect_wave(parts: Sequence[Part], design: Design, points: int, held_out: int, seed: int) -> Wave:
    """Points of the base's design, each with values of the parts' parameters from their priors."""
    inputs = Similarity(design.space).inputs(design.theta)
    return with_own(parts, fine_wave(design, inputs, points, held_out, seed))


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


def with_own(parts: Sequence[Part], base: Wave) -> Wave:
    """A wave of base parameters with values of the parts' own beside them.

    These are drawn anew for each point, from its own seed: a sequence that fills their box by itself goes in
    step with the base's, and leaves most of a plane of one parameter of each empty.
    """
    theta, space = base.theta, base.space
    for part in parts:
        own = ParameterSpace(part.own)
        unit = np.array([_draw(part, base.seed, row) for row in base.theta])
        if own.parameters[0].lower == part.neutral:
            unit[:, 0] = WEAKEST + (1.0 - WEAKEST) * unit[:, 0]
        theta = np.concatenate([theta, np.clip(own.from_unit(unit), own.lower, own.upper)], axis=1)
        space = ParameterSpace((*space.parameters, *part.own))
    rule = base.record["rule"]
    if parts:
        rule = f"{rule}, with draws of {', '.join(space.names[base.space.dim :])}"
    return Wave(space, theta, base.held_out, 0, base.seed, {"rule": rule})


def _draw(part: Part, seed: int, row: Array) -> Array:
    """Uniform (k,), of a part at a point."""
    number, place = int(sha256_of(part.name)[:8], 16), int(sha256(row.tobytes()).hexdigest()[:16], 16)
    return np.random.default_rng([seed, number, place]).uniform(size=len(part.own))


def _work(run: Run) -> Mapping[str, Any]:
    pairs = _pairs(run)
    alone = [part for mechanism in _chosen(run) for part in parts_of(mechanism)]
    each = {part.name: part for part in [*alone, *(part for pair in pairs for part in pair)]}
    said = {name: _learn(run, [part]) for name, part in each.items()}
    for pair in pairs:
        missing = [part.name for part in pair if not said[part.name]["learnt"]]
        said[name_of(pair)] = (
            _not_learnt(run, name_of(pair), f"none of {missing[0]}") if missing else _learn(run, pair)
        )
    return said


def _not_learnt(run: Run, name: str, message: str) -> dict[str, Any]:
    run.reporter.log(f"{name}: no surrogate: {message}")
    return {"learnt": False, "message": message}


def name_of(parts: Sequence[Part]) -> str:
    """One word for what parts do together."""
    return "-with-".join(part.name for part in parts)


def _chosen(run: Run) -> list[Mechanism]:
    known = {mechanism.name: mechanism for mechanism in solved(catalogue().values())}
    names = run.config.effects.mechanisms or list(known)
    for name in names:
        if name not in known:
            where = f"{run.config_path}: effects.mechanisms"
            raise InputError(where, name, f"some of {', '.join(known)}")
    return [known[name] for name in names]


def _pairs(run: Run) -> list[tuple[Part, ...]]:
    known = {part.name: part for mechanism in solved(catalogue().values()) for part in parts_of(mechanism)}
    for names in run.config.effects.pairs:
        where, found = f"{run.config_path}: effects.pairs", " and ".join(names)
        if not set(names) <= set(known):
            raise InputError(where, found, f"two of {', '.join(known)}")
        if len({known[name].mechanism.name for name in names}) < 2:
            raise InputError(where, found, "parts of two mechanisms")
    pairs = ([known[name] for name in names] for names in run.config.effects.pairs)
    return [tuple(sorted(pair, key=lambda part: _from_within([part.mechanism]))) for pair in pairs]


def _from_within(mechanisms: Sequence[Mechanism]) -> tuple[bool, list[str]]:
    """Orders mechanisms as they act: those of the tissue, then what lies between it and the pads."""
    return not all(isinstance(one.act, Tissue) for one in mechanisms), [one.name for one in mechanisms]


def _learn(run: Run, parts: Sequence[Part]) -> dict[str, Any]:
    config, spec, name = run.config, model_spec(run), name_of(parts)
    base = storage.load(run.at("design", "design.h5"), Design)
    coarse_spec = spec.coarsest
    wave = coarse_wave(base.space, config.effects.coarse, config.seed)
    some = [[], *([part] for part in parts)] if len(parts) > 1 else [[]]
    likely = replace(base, ok=base.ok & ~soft_on_stiff(base.space, base.theta))
    few = {
        name_of(these): effect_wave(
            these, likely, config.effects.points, config.effects.held_out, config.seed
        ) for these in [*some, parts]
    }  # fmt: skip
    with crew(run) as run_all:
        make = partial(_runs, run, run_all, base.edges_s)
        tried = make("coarse, at the full model's", coarse_spec, [few[name]], parts)
        kept = _as_recorded(run, tried)
        run.reporter.log(f"{name}: {kept.sum()} of these points have a force like the recording's")
        if not kept.any():
            return _not_learnt(run, name, "no coarse run has a force like the recording's")
        few = {one: _rows(its, kept) for one, its in few.items()}
        *many, coarse = [
            make("coarse", coarse_spec, [nested(with_own(these, wave), few[name_of(these)])], these)
            for these in [*some, parts]
        ]
        *others, fine = [make("fine", spec, [few[name_of(these)]], these) for these in [*some[1:], parts]]
        known, teaching = (
            [[base], *([one] for one in others)],
            _without(run, parts, [[one] for one in many], coarse),
        )
        try:
            effect, validation = _train(run, parts, teaching, _without(run, parts, known, fine))
        except InputError as too_few:
            return _not_learnt(run, name, str(too_few))
        if config.effects.plausible:
            near = plausible_wave(run, effect)
            known[0].append(make("plausible", spec, [in_some(near, [])], []))
            *others, fine = [make("plausible", spec, [few[name_of(these)], in_some(near, these)], these)
                             for these in [*some[1:], parts]]  # fmt: skip
            known[1:] = [[one] for one in others]
            effect, validation = _train(run, parts, teaching, _without(run, parts, known, fine))
    storage.save(run.at("effects", f"{name}-design.h5"), fine)
    without_n = _without(run, parts, known, fine).without_n
    said = {"learnt": True, **_errors(run, effect, validation, without_n, fine)}
    manifest = {**manifest_of(effect.surrogate, validation), "effect": effect.about, **said}
    save_surrogate(run.at("effects", f"{name}.h5"), effect.surrogate, manifest)
    run.reporter.log(in_words(name, said))
    return said


def _as_recorded(run: Run, design: Design) -> NDArray[np.bool_]:
    """Which runs (n,) have a force that the recording may have, up to `LARGEST` times its own."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    largest_n = LARGEST * float(np.nanmax(np.abs(binned.force_n)))
    return design.ok & (np.abs(np.nan_to_num(design.force_n)).max(axis=1) <= largest_n)


def _rows(wave: Wave, kept: NDArray[np.bool_]) -> Wave:
    return replace(wave, theta=wave.theta[kept], held_out=wave.held_out[kept])


def plausible_wave(run: Run, effect: Effect) -> Wave:
    """Points of the part of the prior that the recording leaves plausible with an effect, and a third as many
    held out."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    fitted, count = fitted_bins(run, binned), run.config.effects.plausible
    whole, space = _beside(run, effect), effect.space
    columns = [space.names.index(name) for name in whole.space.names]
    return next_wave(
        space, lambda theta: whole.predict(theta[:, columns]), binned.force_n, fitted,
        noise_floor_n(binned, fitted), count, -(-count // 3), 1, run.config.seed,
    )  # fmt: skip


def in_some(wave: Wave, parts: Sequence[Part]) -> Wave:
    """A wave in the base's parameters and those of some parts."""
    own = {name for part in parts for name in part.own_names}
    known = {p.name for mechanism in catalogue().values() for p in mechanism.parameters}
    columns = [i for i, name in enumerate(wave.space.names) if name not in known or name in own]
    space = ParameterSpace(tuple(wave.space.parameters[i] for i in columns))
    return replace(wave, space=space, theta=wave.theta[:, columns])


def _beside(run: Run, effect: Effect) -> Surrogate:
    """The surrogate of the force with an effect, and of a pair with that of each part."""
    learnt = effects_of(run) if len(effect.mechanisms) > 1 else []
    others = [one for one in learnt if set(one.own) < set(effect.own)]
    return with_effects(base_surrogate(run), [*others, effect])


def _estimate(run: Run, parts: Sequence[Part], edges_s: Array) -> Estimate | None:
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    own = [name for part in parts for name in part.own_names]
    return estimate_of([part.mechanism for part in parts], own, motion, edges_s)


def _without(run: Run, parts: Sequence[Part], known: Sequence[Sequence[Design]], design: Design) -> Pair:
    """A design beside the force without what it is to teach, from designs without any part, and with each
    alone where there are two."""
    neither, *alone = [force_at(some, design) for some in known]
    if not alone:
        return Pair(design, neither)
    own = [design.theta[:, [design.space.names.index(p.name) for p in part.own]] for part in parts]
    estimates = [_estimate(run, [part], design.edges_s) for part in parts]
    return Pair(design, composed(neither, alone, own, estimates))


def _runs(
    run: Run, run_all: Map, edges_s: Array, label: str, spec: ModelSpec, waves: Sequence[Wave],
    parts: Sequence[Part],
) -> Design:  # fmt: skip
    """The runs of waves with parts of mechanisms, or without any, those of the last made now; none twice."""
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    wave = waves[-1]
    known = [vars(p) for p in wave.space.parameters]
    name = name_of(parts) or "base"
    identity = sha256_of([spec.hash, vars(motion), edges_s, name, known])
    task: Simulate = partial(simulate_with, [part.mechanism.name for part in parts], spec, motion)
    label = f"{name}, {label}"
    run.reporter.log(f"{label}: {len(wave.theta)} full runs")
    file = run.folder / "runs" / f"{name}-{identity[:12]}.h5"
    made = run_design(file, wave, edges_s, task, spec.hash, run_all, partial(tell, run, label))
    return rows_of(made, waves)


def effect_files(run: Run) -> list[Path]:
    """Of the effects that this run has learnt, and of other parts those shipped with its surrogate."""
    shipped = run.config.surrogate.file is not None
    known = effects_in(effects_beside(shipped_files(run).surrogate)) if shipped else []
    learnt = {path.name: path for path in effects_in(run.folder / "effects")}
    return sorted(({path.name: path for path in known} | learnt).values(), key=lambda path: path.name)


def effects_of(run: Run) -> list[Effect]:
    """The effects in `effect_files`, as they act. Raises InputError for files of another model."""
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    known = catalogue()
    estimates = estimates_by_name(known, motion)
    found = [load_effect(path, estimates, model_spec(run).hash) for path in effect_files(run)]
    return sorted(found, key=lambda effect: _from_within([known[name] for name in effect.mechanisms]))


def _train(run: Run, parts: Sequence[Part], coarse: Pair, fine: Pair) -> tuple[Effect, Validation]:
    return train_effect(
        name_of(parts), [part.mechanism.name for part in parts],
        {part.own[0].name: part.neutral for part in parts},
        [name for part in parts for name in part.own_names],
        coarse, fine, run.config.surrogate.kind, run.config.seed, _estimate(run, parts, fine.design.edges_s),
    )  # fmt: skip


def in_words(name: str, said: Mapping[str, Any]) -> str:
    """One line on a part's surrogate."""
    if not said["learnt"]:
        return f"{name}: no surrogate: {said['message']}"
    places = (("prior", ""), ("plausible", " where the recording leaves it plausible"))
    errors = [
        f"{found['median_error_mn']:.2g} mN where the effect is {found['median_effect_mn']:.3g} mN{where}"
        for key, where in places if (found := said[key])
    ]  # fmt: skip
    return f"{name}: held-out error {', '.join(errors) or 'not known'} (medians, of a peak of 1 N)"


def force_at(known: Sequence[Design], design: Design) -> Array:
    """The force (n, m) of designs in some of the parameters of another, at each of the other's points."""
    force_of = {theta.tobytes(): force for one in known for theta, force in zip(one.theta, one.force_n,
                strict=True)}  # fmt: skip
    theta = design.theta[:, [design.space.names.index(name) for name in known[0].space.names]]
    return np.array([force_of[one.tobytes()] for one in np.ascontiguousarray(theta)])


def _errors(
    run: Run, effect: Effect, validation: Validation, without: Array, design: Design
) -> dict[str, Any]:
    """Of the force with the effect, on held-out rows at forces of a skin test [mN]: of the effect's surrogate
    beside runs without it, and of all surrogates together; over the prior, and over what is plausible."""
    whole = _beside(run, effect)
    columns = [design.space.names.index(name) for name in whole.space.names]

    def measured(wave: int) -> dict[str, Any] | None:
        rows = design.testing & np.isfinite(without).all(axis=1) & (design.wave == wave)
        if not rows.any():
            return None
        theta, truth, base = design.theta[rows], design.force_n[rows], without[rows]
        alone = base + effect.predict_mean(theta, base)
        both = whole.predict_mean(theta[:, columns])
        to_skin = 1e3 / np.maximum(np.abs(truth).max(axis=1), 1e-12)  # mN of a force whose peak is 1 N
        change, error, of_both = (
            np.sqrt(np.mean(values**2, axis=1)) * to_skin
            for values in (truth - base, truth - alone, truth - both)
        )
        return {
            "median_effect_mn": float(np.median(change)),
            "median_error_mn": float(np.median(error)),
            "p90_error_mn": float(np.quantile(error, 0.9)),
            "median_error_of_both_mn": float(np.median(of_both)),
            "rows": int(rows.sum()),
        }

    return {
        "prior": measured(0),
        "plausible": measured(1),
        "coverage_90": validation.coverage_90,
        "failed": int((~design.ok).sum()),
        "seconds_of_runs": float(np.nansum(design.seconds)),
    }


STAGE = Stage(
    "effects",
    "learns what each mechanism that the full model solves does to the force",
    ("recording", "design", "train"),
    ("seed", "model", "parameters", "design", "surrogate", "fit", "effects"),
    _work,
)
