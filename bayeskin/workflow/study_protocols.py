"""Trains one surrogate for all recordings of a study that share protocol, bins and device.

It is trained on runs over the whole prior, because the posteriors of the recordings may lie anywhere in it.
The run of each recording then checks by the full model whether the surrogate is accurate enough at its own
posterior, and trains it further where it is not.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.config import StudyFile
from bayeskin.errors import InputError
from bayeskin.hashing import sha256_of
from bayeskin.recordings import read_recording
from bayeskin.surrogates import correct, manifest_of, save_surrogate, train
from bayeskin.types import Design, PadMotion
from bayeskin.workflow import design, recording, training
from bayeskin.workflow.design_runs import enough
from bayeskin.workflow.engine import Reporter, Run, run_stages
from bayeskin.workflow.recording import prepared
from bayeskin.workflow.shipping import motion_sha256, origin
from bayeskin.workflow.study_recordings import LeftOut, Member, Outcome, told, with_workers
from bayeskin.workflow.training import fine_design

FILE = "surrogate.h5"


def protocol(run: Run) -> Outcome:
    """Returns the name of what a recording must share with others that use the same surrogate.

    This function runs in a worker. It raises no error.
    """
    return told(_protocol, run)


def _protocol(run: Run) -> Outcome:
    section = run.config.only_recording()
    part = prepared(run, read_recording(run.beside(section.file)), section.protocol)
    geometry = run.config.geometry(run.config_path).geometry
    edges_s = np.round(part.binned.edges_s, 6)
    return Outcome(True, sha256_of([motion_sha256(part.motion), edges_s, geometry.hash])[:12])


def with_shared_surrogates(
    file: StudyFile, known: Sequence[tuple[Member, str]], reporter: Reporter
) -> tuple[list[Member], list[LeftOut]]:
    """Returns the recordings, in which those of one protocol use one surrogate, and those that have none.

    known : recordings with the names of their protocols
    """
    if file.config.surrogate.file is not None:
        return [member for member, _ in known], []
    members, left_out = list[Member](), list[LeftOut]()
    for name in dict.fromkeys(name for _, name in known):
        alike = [member for member, own in known if own == name]
        if len(alike) == 1:
            members += alike
            continue
        reporter.log(f"protocol {name}: {len(alike)} recordings share a surrogate")
        surrogate, reason = _trained(file, name, alike[0], reporter)
        if surrogate is None:
            left_out += [LeftOut(member, reason) for member in alike]
        else:
            members += [_using(file, member, surrogate) for member in alike]
    return members, left_out


def _using(file: StudyFile, member: Member, surrogate: Path) -> Member:
    """Returns a recording whose run uses a surrogate."""
    entry, run = member.entry, member.run
    folder = run.config_path.parent
    section = {"file": os.path.relpath(surrogate, folder)}
    config = file.config_of(entry.name, folder, entry.recording, entry.device, surrogate=section)
    return Member(entry, replace(run, config=config))


def _trained(file: StudyFile, name: str, first: Member, reporter: Reporter) -> tuple[Path | None, str]:
    """Returns the file of a protocol's surrogate, or None and the reason why there is none.

    first : a recording of the protocol, of which only the protocol and the bins matter
    """
    folder, entry = first.run.config_path.parent, first.entry
    design = {"points": [sum(file.config.design.points)]}
    config = file.config_of(name, folder, entry.recording, entry.device, design=design)
    own = replace(first.run, config=config, folder=file.folder / "protocols" / name, reporter=reporter)
    run = with_workers(own, file)
    try:
        last = run_stages(run, STAGES)[-1]
    except InputError as error:
        return None, str(error)
    if not last.record.done:
        return None, f"the stage {last.stage} of its protocol failed: {last.record.summary['message']}"
    return run.at("train", FILE), ""


def _train(run: Run) -> Mapping[str, Any]:
    """Trains the surrogate on all runs alike, writes it with its design, and returns the stage's summary."""
    design, fine = storage.load(run.at("design", "design.h5"), Design), fine_design(run, "design")
    surrogate, validation = train(enough(design), run.config.surrogate.kind, run.config.seed)
    if fine is not None:
        surrogate, validation = correct(surrogate, fine)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    records = json.loads(run.at("design", "waves.json").read_text())
    manifest = {**manifest_of(surrogate, validation), **origin(run, motion, records)}
    file = run.at("train", FILE)
    save_surrogate(file, surrogate, manifest)
    for ending, runs in (("design", design), ("fine", fine)):
        if runs is not None:  # `surrogate.file` names the surrogate, beside which its runs are looked for
            storage.save(file.with_name(f"{file.stem}-{ending}.h5"), runs)
    return {key: manifest[key] for key in ("kind", "relative_error", "error_source", "model_hash")}


STAGES = {
    stage.name: stage
    for stage in (
        recording.STAGE,
        design.STAGE,
        replace(training.STAGE, does="trains the surrogate of a protocol", work=_train),
    )
}
