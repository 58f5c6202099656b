"""Diagnoses a recording of any protocol and device: locates mismatches, names mechanisms, and shows fits."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bayeskin.config import Config, RecordingConfig, parameter_space
from bayeskin.config.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.json_files import plain, write_json
from bayeskin.mismatch.assess import assess
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.explain import explain
from bayeskin.recordings import read_recording
from bayeskin.reduced.region import protocol_outside
from bayeskin.surrogates import train
from bayeskin.types import Design, Surrogate
from bayeskin.workflow import design, recording, training
from bayeskin.workflow.diagnosis_answer import answer_of
from bayeskin.workflow.diagnosis_figures import draw
from bayeskin.workflow.diagnosis_tasks import ContextSource, asked, open_context, searches_file
from bayeskin.workflow.diagnosis_text import in_words
from bayeskin.workflow.engine import CannotGoOn, Reporter, Run, Stage, open_run, run_stages
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.reducing import reduced_file

KNOWN = "pads that only open, no further and no faster than in the training of the reduced model"
NAME = "diagnose"


def diagnose(source: Path, reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """Returns the answer of `bayeskin diagnose` for a configuration's run, or for a single recording.

    Outputs go to the run's folder, or for a single recording to STEM-diagnosis in the recording's folder.

    source : configuration or recording; device : file of the device with which a single recording was made
    Raises InputError for bad input, and for a device without a reduced model.
    """
    run = opened(source, reporter, device)
    _files(run)  # a device without a reduced model is refused before anything is written
    outcome = run_stages(run, stages_of(run.config))[-1]
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / NAME}
    text = in_words(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def opened(source: Path, reporter: Reporter, device: Path | None = None) -> Run:
    """Returns the run of a configuration, or of a single recording that was made with the device of a file.

    Raises InputError for bad input, and for a device file together with a configuration, which states its
    own device.
    """
    if source.suffix == ".toml":
        if device is not None:
            raise InputError(
                "--device", f"{device} together with a configuration", "its sections [device] and [tissue]"
            )
        return open_run(source, reporter)
    read_recording(source)
    sections: dict[str, Any] = {} if device is None else dict(load_device_file(device))
    name = re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{source.stem}")
    config = Config(name=name, recording=RecordingConfig(file=source.name), **sections)
    return Run(config, source, source.resolve().with_name(f"{source.stem}-diagnosis"), reporter)


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
    return ContextSource(run.folder / "recording", model, spec, run.config.seed, base, stated)


def context_of(run: Run, source: ContextSource) -> DiagnosisContext:
    """Returns the context of a run's diagnosis.

    Raises InputError for a protocol outside the training range of the reduced model.
    """
    context = open_context(source)
    if isinstance(context.forward, ReducedForward):
        outside = protocol_outside(context.forward.model.trained.protocols, context.motion)
        if outside:
            problem = f"a protocol that {source.model.name} was not trained for: {outside[0]}"
            raise InputError(run.config_path, problem, KNOWN)
    return context


def _work(run: Run) -> Mapping[str, Any]:
    """Diagnoses a run: writes the answer and the figures, and returns the answer.

    Raises CannotGoOn where no set of mechanisms has an evidence.
    """
    started, source = time.monotonic(), source_of(run)
    context = context_of(run, source)
    learn = partial(_trained_emulator, seed=run.config.seed)
    with asked(source, context, searches_file(run.folder, context), run.config.design.workers) as ask:
        explanation = explain(context, ask, learn, run.reporter.log)
    if explanation is None:
        raise CannotGoOn("no set of mechanisms could be assessed")
    diagnosis = assess(context, explanation)
    answer = {**answer_of(diagnosis, context.known), "seconds": time.monotonic() - started}
    write_json(run.at(NAME, "diagnosis.json"), answer)
    figures = draw(run.folder / NAME, caption(run), context, diagnosis, answer["candidates"])
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
)


def stage_of(config: Config) -> Stage:
    """Returns the stage of a diagnosis.

    If no reduced model can replace the full model, a surrogate must be trained before.
    """
    if stands_for(config.model.spec()):
        return STAGE
    return replace(STAGE, needs=("recording", "design", "train"))
