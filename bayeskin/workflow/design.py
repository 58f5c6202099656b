"""The second stage: runs the model at the design's points, in waves.

Each wave is drawn where the surrogate of the earlier waves cannot rule out the recorded force. With
`design.coarse`, the waves run a quicker model, and the model itself then runs at some of their points.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin import report, storage
from bayeskin.config import parameter_space
from bayeskin.design import Wave, fine_wave, first_wave, next_wave, posterior_wave
from bayeskin.errors import InputError
from bayeskin.forward.design_model import ForceModel, ReducedOrFull
from bayeskin.hashing import sha256_of
from bayeskin.inference import LogPosterior, SampleSettings, sample
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.json_files import write_json
from bayeskin.runner import load_design, run_design
from bayeskin.surrogates import Similarity, load_manifest, train
from bayeskin.types import Array, BinnedForce, Design, PadMotion, ParameterSpace
from bayeskin.workflow.calibration import log_posterior_of
from bayeskin.workflow.engine import CannotGoOn, Run, Stage
from bayeskin.workflow.executor import executor
from bayeskin.workflow.model import check_protocol, full_model, own_files, reduced_files, waves_model
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.shipping import check_fits, shipped_files

FEWEST_PER_INPUT = 4  # fewest training runs per input with which a surrogate can be trained
# From this wave on, the reduced model's waves are drawn from the posterior of the surrogate before them.
FIRST_OF_POSTERIOR = 2
SHORT_RUN, WALKERS_A_PARAMETER = 500, 4  # steps and walkers of the short sampling for these draws
# With a smaller weighted number of training runs per input, components and error estimates are unreliable.
FEWEST_COUNTING = 5


def fitted_bins(run: Run, binned: BinnedForce) -> NDArray[np.bool_]:
    """Returns which bins enter the fit, (m,) bool."""
    return bins_in_windows(binned, run.config.fit.windows_s) >= 0


def noise_floor_n(binned: BinnedForce, fitted: NDArray[np.bool_]) -> float:
    """Returns the RMS [N] of the noise in the means of the fitted bins."""
    return float(np.sqrt(np.mean(binned.variance_n2[fitted])))


def focus(design: Design, binned: BinnedForce, fitted: NDArray[np.bool_]) -> Array:
    """Returns weights (n,) with which a surrogate becomes most accurate where the posterior can be.

    The weight of a run is the inverse of its mean square distance to the recording; the noise keeps this
    distance above zero. Where too few runs would carry the weight, the weights are made more even.
    """
    square = np.mean((design.force_n[:, fitted] - binned.force_n[fitted]) ** 2, axis=1)
    inverse = 1.0 / (noise_floor_n(binned, fitted) ** 2 + square)
    inverse = np.where(design.ok, inverse, 0.0) / np.max(inverse[design.ok])
    needed = FEWEST_COUNTING * Similarity(design.space).dim
    for evenness in (1.0, 0.5, 0.25, 0.125):
        weight = inverse**evenness
        if weight[design.training].sum() ** 2 / np.sum(weight[design.training] ** 2) >= needed:
            return weight
    return design.ok.astype(float)


def _make_design(run: Run) -> Mapping[str, Any]:
    """Makes the design, or takes the design of a shipped surrogate, and returns the stage's summary."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    if run.config.surrogate.file is not None:
        files = shipped_files(run)
        design = load_design(files.design)
        check_fits(run, files, design, binned, motion)
        records = load_manifest(files.surrogate)["waves"]
        fine = load_design(files.fine) if files.fine is not None else None
    else:
        design, records = _run_waves(run, binned, motion)
        fine = _run_fine(run, design, motion) if run.config.design.coarse is not None else None
    storage.save(run.at("design", "design.h5"), design)
    if fine is not None:
        storage.save(run.at("design", "fine.h5"), fine)
    write_json(run.at("design", "waves.json"), records)
    _draw_figure(run, design, records)
    return {**_summary(design, records), **({} if fine is None else {"fine": _counts(fine)})}


def _run_waves(run: Run, binned: BinnedForce, motion: PadMotion) -> tuple[Design, list[Mapping[str, Any]]]:
    """Runs all waves of the configuration, and returns the design and the records of the waves.

    Runs are stored by what they depend on, so no run is made twice.
    """
    check_protocol(run, motion)
    model, config = waves_model(run), run.config.design
    space = parameter_space(run.config, run.config_path).box  # training covers the box evenly
    file = runs_file(run, model, motion, binned.edges_s, space)
    waves: list[Wave] = []
    if run.config.model.forward is not None and not file.is_file():
        _try_forward_model(run, model, motion, space)
    for number, count in enumerate(config.points):
        drawn = run.at("design", f"wave-{number}.json")
        if not drawn.is_file():
            wave = _choose_wave(run, number, count, space, (binned, motion), waves, file)
            write_json(drawn, {"theta": wave.theta, "held_out": wave.held_out, "record": wave.record})
        waves.append(_load_wave(drawn, space, number, run.config.seed))
        label = f"wave {number + 1} of {len(config.points)}"
        run_wave(run, label, file, waves[-1], binned.edges_s, _model_of_wave(model, number), motion)
    return rows_of(load_design(file), waves), [wave.record for wave in waves]


def _model_of_wave(model: ForceModel, number: int) -> ForceModel:
    """Returns the model that runs a wave.

    In the waves over the whole prior, points that the reduced model cannot run are left out, such as skins
    that fold. A full run of each would take minutes, and few of them can be near the recording's posterior.
    """
    if isinstance(model, ReducedOrFull) and number < FIRST_OF_POSTERIOR:
        return replace(model, replaces=False)
    return model


def _try_forward_model(run: Run, model: ForceModel, motion: PadMotion, space: ParameterSpace) -> None:
    """Runs a forward model of the user's own once, in the middle of the box.

    Raises InputError where the model cannot be used at all.
    """
    forward = run.config.model.forward
    run.reporter.log(f"trial run of {forward}")
    middle = dict(zip(space.names, space.from_unit([0.5] * space.dim).tolist(), strict=True))
    simulation = model(motion, middle)
    if simulation.status != "ok":
        raise InputError(forward, simulation.message, f"a force at {middle}")


def _run_fine(run: Run, design: Design, motion: PadMotion) -> Design:
    """Returns the runs of the configuration's model at some points of the coarser model's design.

    Where the last wave is drawn from the posterior, these points lie in the posterior too.
    """
    model, config = full_model(run), run.config.design
    inputs, candidates = Similarity(design.space).inputs(design.theta), design
    if config.coarse == "reduced" and len(config.points) > FIRST_OF_POSTERIOR:
        near = design.held_out | (design.wave == design.wave.max())
        candidates = replace(design, ok=design.ok & near)
    wave = fine_wave(candidates, inputs, config.fine_points, config.fine_held_out, run.config.seed)
    file = runs_file(run, model, motion, design.edges_s, design.space)
    run_wave(run, "fine model", file, wave, design.edges_s, model, motion)
    return rows_of(load_design(file), [wave])


def runs_file(run: Run, model: ForceModel, motion: PadMotion, edges_s: Array, space: ParameterSpace) -> Path:
    """Returns the path of the file with all runs of one model on one protocol."""
    identity = sha256_of(
        [model.hash, vars(motion), edges_s, [vars(p) for p in space.without_texts.parameters]]
    )
    return run.folder / "runs" / f"{identity[:16]}.h5"


def run_wave(
    run: Run, label: str, runs_file: Path, wave: Wave, edges_s: Array, model: ForceModel, motion: PadMotion
) -> None:
    """Runs the points of a wave that are not in the file yet, and stores them there."""
    run.reporter.log(f"{label}: {len(wave.theta)} runs")
    with executor(run) as run_all:
        run_design(
            runs_file, wave, edges_s, partial(model, motion), model.hash, run_all, partial(tell, run, label)
        )


def tell(run: Run, label: str, done: int, total: int, failed: int) -> None:
    """Reports the progress of a design in words."""
    run.reporter.progress(label, done / max(total, 1), f"{done} of {total} runs, {failed} failed")


def _choose_wave(
    run: Run,
    number: int,
    count: int,
    space: ParameterSpace,
    recorded: tuple[BinnedForce, PadMotion],
    before: Sequence[Wave],
    runs_file: Path,
) -> Wave:
    """Returns the points of the next wave.

    The first wave covers the whole box. A later wave lies in the plausible part that the surrogate of the
    earlier waves leaves. With the reduced model, waves from `FIRST_OF_POSTERIOR` on are draws of the
    posterior.
    """
    config, (binned, motion) = run.config, recorded
    if not before:
        return first_wave(space, count, config.design.held_out, config.seed)
    design, fitted = enough(rows_of(load_design(runs_file), before)), fitted_bins(run, binned)
    weights = focus(design, binned, fitted)
    surrogate, _ = train(design, config.surrogate.kind, config.seed, weights)
    if config.design.coarse == "reduced" and number >= FIRST_OF_POSTERIOR:
        run.reporter.log(f"wave {number + 1}: a short run of the sampler locates the posterior")
        nearest = design.theta[int(np.argmax(np.where(design.training, weights, 0.0)))]
        draws = _posterior_draws(run, log_posterior_of(run, surrogate, binned, motion), nearest)
        inputs = surrogate.inputs(draws)
        return posterior_wave(space, draws, inputs, count, config.design.held_out, number, config.seed)
    floor_n = noise_floor_n(binned, fitted)
    wave = next_wave(
        space, surrogate.predict, binned.force_n, fitted, floor_n, count, config.design.held_out,
        number, config.seed,
    )  # fmt: skip
    fraction = wave.record["kept_fraction"]
    run.reporter.log(f"wave {number + 1}: points from {fraction:.2g} of the prior's volume")
    return wave


def _posterior_draws(run: Run, log_posterior: LogPosterior, theta: Array) -> Array:
    """Returns draws (n, d) of the model's parameters from a short run of the sampler.

    The sampler starts near theta (d,).
    """
    middle = 0.5 * np.sum(log_posterior.bounds, axis=0)
    start = log_posterior.named(np.append(theta, log_posterior.from_sampling(middle)[len(theta) :]))
    settings = SampleSettings(2, WALKERS_A_PARAMETER * log_posterior.dim, SHORT_RUN)
    with tempfile.TemporaryDirectory() as folder:
        threads = run.config.design.workers
        posterior = sample(log_posterior, folder, run.config.seed, start, settings, threads=threads)
    return log_posterior.split(posterior.flat)[0]


def _load_wave(path: Path, space: ParameterSpace, number: int, seed: int) -> Wave:
    """Returns a wave from its file."""
    stored = json.loads(path.read_text())
    held_out = np.array(stored["held_out"], dtype=bool)
    return Wave(space, np.array(stored["theta"], dtype=float), held_out, number, seed, stored["record"])


def rows_of(runs: Design, waves: Sequence[Wave]) -> Design:
    """Returns the rows of `runs` at the waves' points, in the order of the waves and with their labels."""
    row_of = {theta.tobytes(): row for row, theta in enumerate(runs.theta)}
    points = np.concatenate([wave.theta for wave in waves])
    rows = np.array([row_of[theta.tobytes()] for theta in points])
    return replace(
        runs,
        theta=points,
        wave=np.concatenate([np.full(len(wave.theta), wave.number) for wave in waves]),
        held_out=np.concatenate([wave.held_out for wave in waves]),
        messages=tuple(runs.messages[row] for row in rows),
        **{name: getattr(runs, name)[rows] for name in ("force_n", "ok", "seconds")},
    )


def enough(design: Design) -> Design:
    """Returns the design if it is large enough to train a surrogate.

    Raises CannotGoOn, which names the most frequent failure, if it is not.
    """
    needed = FEWEST_PER_INPUT * Similarity(design.space).dim
    succeeded = int(design.training.sum())
    if succeeded >= needed and design.testing.any():
        return design
    failures = Counter(text for text, ok in zip(design.messages, design.ok, strict=True) if not ok)
    why = f" (most frequent failure: {failures.most_common(1)[0][0]})" if failures else ""
    raise CannotGoOn(
        f"{succeeded} training runs succeeded, at least {needed} are needed{why}; narrow the prior box"
    )


def _summary(design: Design, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the stage's summary: counts of the runs, and the records of the waves."""
    return {**_counts(design), "waves": list(records)}


def _counts(design: Design) -> dict[str, Any]:
    """Returns counts, failures and durations of a design's runs."""
    failures = Counter(text for text, ok in zip(design.messages, design.ok, strict=True) if not ok)
    return {
        "runs": len(design.theta),
        "training": int(design.training.sum()),
        "held_out": int(design.testing.sum()),
        "failed": int((~design.ok).sum()),
        "failures": dict(failures.most_common(5)),
        "seconds_of_runs": float(np.nansum(design.seconds)),
        "median_seconds_a_run": float(np.nanmedian(design.seconds)),
        "model_hash": design.model_hash,
    }


def _draw_figure(run: Run, design: Design, records: Sequence[Mapping[str, Any]]) -> None:
    """Draws the figure of the waves."""
    fractions = [record["kept_fraction"] for record in records]
    report.save_figure(report.figure_waves(design, fractions), run.at("design", "waves"), caption(run))


def _files(run: Run) -> Iterable[Path]:
    """Returns the files besides the recording that the stage reads."""
    files = [run.beside(run.config.model.mesh)] if run.config.model.mesh != "bricks" else []
    ready = shipped_files(run).present if run.config.surrogate.file is not None else ()
    return [*files, *own_files(run), *reduced_files(run), *ready]


STAGE = Stage(
    "design",
    "runs the model at the design's points",
    ("recording",),
    ("seed", "model", "parameters", "design", "surrogate", "fit", "noise"),
    _make_design,
    _files,
)
