"""Runs the waves of a design: each lies where the earlier waves cannot rule out the recorded force.

With `design.coarse`, the waves run a quicker model, and the model itself then runs at some of their points.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayeskin.config import parameter_space
from bayeskin.design import Wave, fine_wave, first_wave, posterior_wave
from bayeskin.errors import InputError
from bayeskin.forward.design_model import ForceModel, ReducedOrFull
from bayeskin.forward.joint import EachRecording
from bayeskin.history_matching import next_wave
from bayeskin.inference import LogPosterior, SampleSettings, sample
from bayeskin.surrogates import Similarity, train
from bayeskin.surrogates.focus import focus, noise_floor_n
from bayeskin.types import Array, BinnedForce, Design, PadMotion, ParameterSpace
from bayeskin.workflow.calibration import log_posterior_of
from bayeskin.workflow.design_runs import enough, joined, run_wave, runs_store
from bayeskin.workflow.engine import Run
from bayeskin.workflow.model import check_protocol, full_model, waves_model
from bayeskin.workflow.recording import fitted_bins

# From this wave on, the reduced model's waves are drawn from the posterior of the surrogate before them.
FIRST_OF_POSTERIOR = 2
SHORT_RUN, WALKERS_A_PARAMETER = 500, 4  # steps and walkers of the short sampling for these draws


def run_waves(run: Run, binned: BinnedForce, motion: PadMotion) -> tuple[Design, list[Mapping[str, Any]]]:
    """Runs all waves of the configuration, and returns the design and the records of the waves.

    Runs are stored by what they depend on, so no run is made twice.
    """
    check_protocol(run, motion)
    model, config = waves_model(run), run.config.design
    space = parameter_space(run.config, run.config_path).box  # training covers the box evenly
    if run.config.model.forward is not None and not runs_store(run, model, motion).path.is_file():
        _try_forward_model(run, model, motion, space)
    designs, records = list[Design](), list[Mapping[str, Any]]()
    for number, count in enumerate(config.points):
        wave = _drawn_wave(run, number, count, space, (binned, motion), designs)
        label = f"wave {number + 1} of {len(config.points)}"
        designs.append(run_wave(run, label, wave, binned.edges_s, _model_of_wave(model, number), motion))
        records.append(wave.record)
    return joined(designs), records


def run_fine(run: Run, design: Design, motion: PadMotion) -> Design:
    """Returns the runs of the configuration's model at some points of the coarser model's design.

    Where the last wave is drawn from the posterior, these points lie in the posterior too.
    """
    model, config = full_model(run), run.config.design
    inputs, candidates = Similarity(design.space).inputs(design.theta), design
    if config.coarse == "reduced" and len(config.points) > FIRST_OF_POSTERIOR:
        near = design.held_out | (design.wave == design.wave.max())
        candidates = replace(design, ok=design.ok & near)
    wave = fine_wave(candidates, inputs, config.fine_points, config.fine_held_out, run.config.seed)
    return run_wave(run, "fine model", wave, design.edges_s, model, motion)


def _model_of_wave(model: ForceModel, number: int) -> ForceModel:
    """Returns the model that runs a wave.

    In the waves over the whole prior, points that the reduced model cannot run are left out, such as skins
    that fold. A full run of each would take minutes, and few of them can be near the recording's posterior.
    """
    if number >= FIRST_OF_POSTERIOR:
        return model
    if isinstance(model, EachRecording):
        return EachRecording(_model_of_wave(model.model, number))
    return replace(model, replaces=False) if isinstance(model, ReducedOrFull) else model


def _try_forward_model(run: Run, model: ForceModel, motion: PadMotion, space: ParameterSpace) -> None:
    """Runs a forward model of the user's own once, in the middle of the box.

    Raises InputError where the model cannot be used at all.
    """
    forward = run.config.model.forward
    run.reporter.log(f"trial run of {forward}")
    middle = dict(zip(space.names, space.from_unit([0.5] * space.dim).tolist(), strict=True))
    simulation = model(motion, middle)
    if simulation.status != "ok":
        raise InputError(
            forward, f"its trial run failed ({simulation.message})", f"it must return a force at {middle}"
        )


def _drawn_wave(
    run: Run, number: int, count: int, space: ParameterSpace, recorded: tuple[BinnedForce, PadMotion],
    before: Sequence[Design],
) -> Wave:  # fmt: skip
    """Returns the points of the next wave, from the store where they were drawn before."""
    with run.store("waves", run.inputs_sha256("design")) as store:
        if number not in store:
            wave = _choose_wave(run, number, count, space, recorded, before)
            store.add(number, {"theta": wave.theta, "held_out": wave.held_out, "record": wave.record})
        drawn = store.read(number, dict)
    return Wave(space, drawn["theta"], drawn["held_out"], number, run.config.seed, drawn["record"])


def _choose_wave(
    run: Run, number: int, count: int, space: ParameterSpace, recorded: tuple[BinnedForce, PadMotion],
    before: Sequence[Design],
) -> Wave:  # fmt: skip
    """Returns the points of the next wave.

    The first wave covers the whole box. A later wave lies in the plausible part that the surrogate of the
    earlier waves leaves. With the reduced model, waves from `FIRST_OF_POSTERIOR` on are draws of the
    posterior.
    """
    config, (binned, motion) = run.config, recorded
    if not before:
        return first_wave(space, count, config.design.held_out, config.seed)
    design, fitted = enough(joined(before)), fitted_bins(run, binned)
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
