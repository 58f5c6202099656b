"""Chooses, after a diagnosis, the further test that best distinguishes the explanations of a mismatch.

The reduced model of the device simulates the tests. The range of protocols for which it was trained is taken
as the range that the device can perform.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.experiments.choice import Experiment, compete, search, weigh
from bayeskin.experiments.protocols import Limits, Protocol, variations
from bayeskin.forward.joint import JointForward
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.json_files import plain, write_json
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.explain import searched
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.tasks import AnswerTasks
from bayeskin.workflow.diagnosing import diagnose, stages_of_page
from bayeskin.workflow.diagnosis import context_of, opened, source_of
from bayeskin.workflow.diagnosis_tasks import asked, depends_on
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.executor import WORKERS
from bayeskin.workflow.folder import Record, locked, output_hashes, write_record
from bayeskin.workflow.further_tests import FOLDER, diagnosis_hash
from bayeskin.workflow.page import write_page
from bayeskin.workflow.provenance import caption

LONGEST_S = 1800.0  # longest test: a person can hardly keep an arm still for longer


def choose(sources: Sequence[Path], reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """Returns the answer of `bayeskin experiment` for a configuration's run, or for recordings by themselves.

    The recordings are diagnosed first, unless this has been done. If the diagnosis fails, its answer is
    returned. Outputs go to the run's folder `experiment`.

    sources : a configuration, or one or several recordings of one skin
    device : file of the device with which the recordings were made
    Raises InputError for bad input, for a device without a reduced model, and for a model that no reduced
    model can replace.
    """
    run = opened(sources, reporter, device)
    model = run.config.model
    if not stands_for(model.spec()):
        raise InputError(
            sources[0],
            f"model.observation is {model.observation!r} on {model.mesh!r}",
            "an experiment needs 'reaction' on 'bricks'",
        )
    diagnosed = diagnose(sources, reporter, device)
    if "best_set" not in diagnosed:
        return diagnosed
    folder = run.folder / FOLDER
    with locked(run.folder):
        started, judged = time.monotonic(), diagnosis_hash(run)
        folder.mkdir(parents=True, exist_ok=True)
        context_source = source_of(run)
        context = context_of(run, context_source)
        store = run.store("answers", depends_on(context))
        with asked(context_source, context, store, WORKERS, lambda _: None) as ask:
            all_fits = [set_fit.fit for set_fit in searched(context, ask, reporter.log).fits.values()]
            fits = compete(all_fits, diagnosed["best_set"], context.known)
            experiments = _judged_protocols(fits, context, ask, reporter) if len(fits) > 1 else []
        answer: dict[str, Any] = {
            "sets": [list(fit.names) for fit in fits],
            "experiments": [_row(experiment) for experiment in experiments],
            "ok": not experiments or any(np.isfinite(experiment.gain_bits) for experiment in experiments),
        }  # fmt: skip
        if experiments:
            figures = report.save_figure(
                report.figure_experiments(experiments), folder / "experiments", caption(run)
            )
            answer["figures"] = [path.name for path in figures]
            _write_corners(experiments[0].protocol, folder / "next.csv")
        write_json(folder / "experiment.json", answer)
        seconds = time.monotonic() - started
        write_record(folder, Record(judged, True, seconds, output_hashes(folder), plain(answer)))
    page = write_page(run, stages_of_page(run))
    text = f"{_in_words(answer)}\nreport: {page}"
    return plain({**answer, "folder": folder, "page": page, "text": text})


def _judged_protocols(
    fits: Sequence[Fit], context: DiagnosisContext, ask: AnswerTasks, reporter: Reporter
) -> list[Experiment]:
    """Returns the judged protocols, the most informative first.

    fits : fits of the competing sets, the most probable first
    """
    forward = context.forward.parts[0] if isinstance(context.forward, JointForward) else context.forward
    assert isinstance(forward, ReducedForward)
    trained = forward.model.trained.protocols
    limits = Limits(trained.largest_m, trained.speeds_m_s, LONGEST_S)
    first = variations(context.motion.parts[-1], limits)

    def judge(protocol: Protocol) -> Experiment:
        experiment = weigh(protocol, fits, context.known, ask, context.seed)
        reporter.log(f"{protocol.name}: {experiment.gain_bits:.2f} of {experiment.possible_bits:.2f} bits")
        return experiment

    return search(judge, first, limits, context.seed)


def _write_corners(protocol: Protocol, path: Path) -> None:
    """Writes the corners of a test as a table that can be given to a testing machine."""
    with open(path, "w", encoding="utf-8", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["time_s", "displacement_mm"])
        for time_s, at_m in zip(protocol.motion.time_s, protocol.motion.displacement_m, strict=True):
            writer.writerow([f"{time_s:.3f}", f"{1e3 * at_m:.4f}"])


def _row(experiment: Experiment) -> dict[str, Any]:
    """Returns the entry of an experiment in the JSON."""
    return {
        "protocol": experiment.protocol.name, "sentence": experiment.protocol.sentence,
        "seconds": float(experiment.protocol.motion.time_s[-1]),
        "cycles": [asdict(cycle) for cycle in experiment.protocol.cycles], "gain_bits": experiment.gain_bits,
        "standard_error": experiment.standard_error, "named": experiment.named,
        "possible_bits": experiment.possible_bits, "failed": experiment.failed,
    }  # fmt: skip


def _in_words(answer: Mapping[str, Any]) -> str:
    """Returns the answer as text."""
    if len(answer["sets"]) < 2:
        return (
            "nothing competes: no look-alike was tried in place of the mechanisms that fit the recording best"
        )
    lines = ["sets taken as equally probable: " + "; or ".join(", ".join(names) for names in answer["sets"])]
    for entry in answer["experiments"]:
        result = "could not be assessed"
        if np.isfinite(entry["gain_bits"]):
            result = f"{entry['gain_bits']:.2f} of {entry['possible_bits']:.2f} bits"
        lines.append(f"  {entry['protocol']}, {entry['seconds']:.0f} s: {result}. {entry['sentence']}")
    best = answer["experiments"][0]
    if best["gain_bits"] > 0.0:
        lines.append(f"Run next: {best['protocol']}. Its corners are in {FOLDER}/next.csv.")
    else:
        lines.append("None of these tests has been shown to tell the sets apart.")
    return "\n".join(lines)
