"""The stage of a diagnosis, for any protocol and device: locates mismatches, names mechanisms, shows fits."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bayeskin.config import Config, config_of, parameter_space
from bayeskin.config.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.forward.joint import JointForward
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.json_files import write_json
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.assess import assess
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.explain import explain
from bayeskin.recordings import fitting_width_s, read_recording
from bayeskin.reduced.region import protocol_outside
from bayeskin.report.words import markers_unused_in_words
from bayeskin.surrogates import train
from bayeskin.types import Design, Surrogate
from bayeskin.workflow import design, recording, training
from bayeskin.workflow.diagnosis_answer import answer_of
from bayeskin.workflow.diagnosis_figures import draw
from bayeskin.workflow.diagnosis_forces import FORCES, forces_of
from bayeskin.workflow.diagnosis_progress import tell_end, tell_tasks
from bayeskin.workflow.diagnosis_tasks import ContextSource, asked, depends_on, open_context
from bayeskin.workflow.engine import CannotGoOn, Reporter, Run, Stage, open_run
from bayeskin.workflow.importing import markers_beside
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.reducing import reduced_file

KNOWN = "the pads must only open, no further and no faster than in the training of the reduced model"
NAME = "diagnose"


def opened(sources: Sequence[Path], reporter: Reporter, device: Path | None = None) -> Run:
    """Returns the run of a configuration, or of recordings of one skin that were made with one device.

    Raises InputError for bad input, for a device file together with a configuration, which states its own
    device, and for a configuration together with other sources.
    """
    source = sources[0]
    configuration = next((file for file in sources if file.suffix == ".toml"), None)
    if configuration is not None and len(sources) > 1:
        raise InputError(
            configuration,
            "a configuration cannot be given with other files",
            "name the recordings in it, as [[recordings]]",
        )
    if configuration is not None:
        if device is not None:
            raise InputError(
                "--device",
                f"{device} cannot be given with a configuration",
                "use the configuration's sections [device] and [tissue]",
            )
        return open_run(source, reporter)
    width_s = max(fitting_width_s(read_recording(file)) for file in sources)
    stems, folder = "-".join(file.stem for file in sources), source.resolve().parent
    files = [{"file": os.path.relpath(file.resolve(), folder)} for file in sources]
    if len(sources) == 1 and markers_beside(source).exists():
        files[0]["markers"] = os.path.relpath(markers_beside(source.resolve()), folder)
    unused = [file.stem for file in sources if markers_beside(file).exists()] if len(sources) > 1 else []
    if unused:
        reporter.log(markers_unused_in_words("a joint diagnosis", unused))
    given: dict[str, Any] = {"recording": files[0]} if len(files) == 1 else {"recordings": files}
    given["fit"] = {"bin_width_s": width_s}
    if device is not None:
        given |= {key: section.model_dump() for key, section in load_device_file(device)}
    config = config_of({"name": re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{stems}"), **given}, source)
    return Run(config, source, folder / f"{stems}-diagnosis", reporter, from_file=False)


def stages_of(config: Config) -> dict[str, Stage]:
    """Returns the stages of a diagnosis by name, in their order."""
    earlier = {stage.name: stage for stage in (recording.STAGE, design.STAGE, training.STAGE)}
    own_stage = stage_of(config)
    return {name: earlier[name] for name in own_stage.needs} | {NAME: own_stage}


def source_of(run: Run) -> ContextSource:
    """Returns the files and settings from which the context of a run's diagnosis is opened.

    The files exist once the earlier stages are done. Raises InputError for a device without a reduced model.
    """
    spec, reduced = model_spec(run), _files(run)
    model = reduced[0] if reduced else run.at("train", "surrogate.h5")
    stated = tuple((name, bounds) for name, bounds in run.config.noise if bounds is not None)
    base = parameter_space(run.config, run.config_path)
    shared = _shared(run)
    return ContextSource(run.folder / "recording", model, spec, run.config.seed, base, stated, shared)


def _shared(run: Run) -> tuple[str, ...]:
    """Returns what several recordings share. Raises InputError for names that are not known."""
    own = [name for name, m in catalogue().items() if isinstance(m.act, Instrument) and not m.act.of_skin]
    unknown = set(run.config.fit.shared) - {"p_init", "noise", *own}
    if unknown:
        raise InputError(
            f"{run.config_path}: fit.shared",
            f"{', '.join(sorted(unknown))} cannot be shared",
            f"use some of p_init, noise, {', '.join(own)}",
        )
    return run.config.fit.shared


def context_of(run: Run, source: ContextSource) -> DiagnosisContext:
    """Returns the context of a run's diagnosis.

    Raises InputError for a protocol outside the training range of the reduced model.
    """
    context = open_context(source)
    forwards = context.forward.parts if isinstance(context.forward, JointForward) else (context.forward,)
    for section, forward in zip(run.config.each_recording, forwards, strict=True):
        if isinstance(forward, ReducedForward):
            outside = protocol_outside(forward.model.trained.protocols, forward.motion)
            if outside:
                where = run.config_path if len(forwards) == 1 else run.beside(section.file)
                problem = f"{source.model.name} was not trained for this protocol ({outside[0]})"
                raise InputError(where, problem, KNOWN)
    return context


def _work(run: Run) -> Mapping[str, Any]:
    """Diagnoses a run: writes the answer and the figures, and returns the answer.

    Raises CannotGoOn where no set of mechanisms has an evidence.
    """
    started, source = time.monotonic(), source_of(run)
    context = context_of(run, source)
    learn = partial(_trained_emulator, seed=run.config.seed)
    store = run.store("answers", depends_on(context))
    tell = partial(tell_tasks, run.reporter)
    with asked(source, context, store, run.config.design.workers, tell) as ask:
        explanation = explain(context, ask, learn, run.reporter.log)
    if explanation is None:
        raise CannotGoOn("no set of mechanisms could be assessed")
    diagnosis = assess(context, explanation)
    answer = {**answer_of(diagnosis, context.known), "seconds": time.monotonic() - started}
    write_json(run.at(NAME, "diagnosis.json"), answer)
    write_json(run.at(NAME, FORCES), forces_of(context, diagnosis))
    figures = draw(run.folder / NAME, caption(run), context, diagnosis, answer["candidates"])
    tell_end(run.reporter)
    return {**answer, "figures": [figure.name for figure in figures]}


def _trained_emulator(design: Design, seed: int) -> Surrogate:
    """Returns a Gaussian process that is trained on a design."""
    return train(design, "gp", seed)[0]


def _files(run: Run) -> list[Path]:
    """Returns the file of the device's reduced model, if a reduced model can replace the full model.

    Raises InputError for a device without a reduced model.
    """
    spec = model_spec(run)
    return [reduced_file(spec.geometry, [run.config_path])] if stands_for(spec) else []


STAGE = Stage(
    NAME,
    "finds what the model leaves out",
    ("recording",),
    ("seed", "model", "parameters", "noise"),
    _work,
    _files,
    format=3,
)


def stage_of(config: Config) -> Stage:
    """Returns the stage of a diagnosis.

    If no reduced model can replace the full model, a surrogate must be trained before.
    """
    if stands_for(config.model.spec()):
        return STAGE
    return replace(STAGE, needs=("recording", "design", "train"))
