"""The choice of the further test that tells the explanations of a mismatch apart, after a diagnosis.

The reduced model of the device runs them. It knows the protocols that it was trained for, which are taken as
what the device can do.
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
from bayeskin.forward.reduced import ReducedForward
from bayeskin.json_files import plain, write_json
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.tasks import AnswerTasks
from bayeskin.workflow import diagnosis
from bayeskin.workflow.diagnosis import context_of, opened, searched, source_of
from bayeskin.workflow.diagnosis_tasks import asked, searches_file
from bayeskin.workflow.engine import Reporter, Run
from bayeskin.workflow.folder import Record, current_record, locked, output_hashes, read_record, write_record
from bayeskin.workflow.provenance import caption

FOLDER = "experiment"
LONGEST_S = 1800.0  # of a test: an arm can hardly be still for longer
WORKERS = 2


def choose(source: Path, reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """The answer of `bayeskin experiment` on a configuration's run, or on a recording by itself.

    device : file of the device that a recording by itself was made with

    Diagnoses first, where that is not done, and answers as `diagnose` where that fails. Outputs go to the
    run's folder `experiment`. Raises InputError for bad input, among it the article's observation, which no
    other protocol has, and a device without a reduced model.
    """
    run = opened(source, reporter, device)
    observation = run.config.model.observation
    if observation != "reaction":
        raise InputError(source, f"model.observation {observation!r}", "'reaction'")
    diagnosed = diagnosis.diagnose(source, reporter, device)
    if "best_set" not in diagnosed:
        return diagnosed
    where = run.folder / FOLDER
    with locked(run.folder):
        started, of = time.monotonic(), _diagnosis(run)
        where.mkdir(parents=True, exist_ok=True)
        files = source_of(run)
        context = context_of(run, files)
        with asked(files, context, searches_file(run.folder, context), WORKERS) as ask:
            fitted = [one.fit for one in searched(run, context, ask).fits.values()]
            fits = compete(fitted, diagnosed["best_set"], context.known)
            found = _searched(fits, context, ask, reporter) if len(fits) > 1 else []
        answer: dict[str, Any] = {
            "sets": [list(one.names) for one in fits], "experiments": [_row(one) for one in found],
            "ok": not found or any(np.isfinite(one.gain_bits) for one in found),
        }  # fmt: skip
        if found:
            made = report.save_figure(report.figure_experiments(found), where / "experiments", caption(run))
            answer["figures"] = [path.name for path in made]
            _write_corners(found[0].protocol, where / "next.csv")
        write_json(where / "experiment.json", answer)
        seconds = time.monotonic() - started
        write_record(where, Record(of, True, seconds, output_hashes(where), plain(answer)))
    return plain({**answer, "folder": where, "text": _in_words(answer)})


def answered(run: Run) -> Record | None:
    """Returns what was answered about the diagnosis in the run's folder, if anything was asked of it."""
    return current_record(run.folder / FOLDER, _diagnosis(run))


def _diagnosis(run: Run) -> str:
    record = read_record(run.folder / diagnosis.NAME)
    return "" if record is None else record.sha256


def _searched(
    fits: Sequence[Fit], context: DiagnosisContext, ask: AnswerTasks, reporter: Reporter
) -> list[Experiment]:
    """Protocols judged, the most telling first."""
    assert isinstance(context.forward, ReducedForward)
    trained = context.forward.model.trained.protocols
    limits = Limits(trained.largest_m, trained.speeds_m_s, LONGEST_S)
    first = variations(context.motion, limits)

    def judge(protocol: Protocol) -> Experiment:
        one = weigh(protocol, fits, context.known, ask, context.seed)
        reporter.log(f"{protocol.name}: {one.gain_bits:.2f} of {one.possible_bits:.2f} bits")
        return one

    return search(judge, first, limits, context.seed)


def _write_corners(protocol: Protocol, path: Path) -> None:
    """Writes a test's corners as a table that a machine can be given."""
    with open(path, "w", encoding="utf-8", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["time_s", "displacement_mm"])
        for time_s, at_m in zip(protocol.motion.time_s, protocol.motion.displacement_m, strict=True):
            writer.writerow([f"{time_s:.3f}", f"{1e3 * at_m:.4f}"])


def _row(one: Experiment) -> dict[str, Any]:
    return {
        "protocol": one.protocol.name, "sentence": one.protocol.sentence,
        "seconds": float(one.protocol.motion.time_s[-1]),
        "cycles": [asdict(cycle) for cycle in one.protocol.cycles], "gain_bits": one.gain_bits,
        "standard_error": one.standard_error, "named": one.named, "possible_bits": one.possible_bits,
        "failed": one.failed,
    }  # fmt: skip


def _in_words(answer: Mapping[str, Any]) -> str:
    if len(answer["sets"]) < 2:
        return "nothing competes: no look-alike was tried in the place of what explains the recording best"
    lines = ["taken as equally probable: " + "; or ".join(", ".join(one) for one in answer["sets"])]
    for one in answer["experiments"]:
        told = "could not be judged"
        if np.isfinite(one["gain_bits"]):
            told = f"{one['gain_bits']:.2f} of {one['possible_bits']:.2f} bits"
        lines.append(f"  {one['protocol']}, {one['seconds']:.0f} s: {told}. {one['sentence']}")
    best = answer["experiments"][0]
    if best["gain_bits"] > 0.0:
        lines.append(f"Run next: {best['protocol']}. Its corners are in {FOLDER}/next.csv.")
    else:
        lines.append("None of these tests is shown to tell them apart.")
    return "\n".join(lines)
