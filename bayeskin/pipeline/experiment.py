"""Which further test would tell the explanations of a mismatch apart, after it has been diagnosed.

Runs are those of the coarsest bricks, which are quick (a mesh of one's own stays): what matters is by how
much explanations differ, and a mesh changes them nearly alike.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import bayeskin
from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.mismatch.experiments import DRAWS, Experiment, compete, ranked, weigh
from bayeskin.mismatch.fit import restored, stored
from bayeskin.mismatch.protocols import protocols
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.pipeline import diagnosis
from bayeskin.pipeline.engine import Reporter, Run, Silent
from bayeskin.pipeline.folder import (
    Record,
    current_record,
    locked,
    output_hashes,
    plain,
    read_lines,
    read_record,
    sha256_of,
    write_json,
    write_record,
)
from bayeskin.pipeline.provenance import caption
from bayeskin.pipeline.workbench import Workbench, opened, workbench
from bayeskin.types import PadMotion, Simulation
from bayeskin.workers import Lost, run_parallel

FOLDER = "experiment"


def choose(source: Path, reporter: Reporter) -> dict[str, Any]:
    """The answer of `bayeskin experiment` on a configuration's run, or on a recording by itself.

    Diagnoses first, where that is not done, and answers as `diagnose` where that fails. Outputs go to the
    run's folder `experiment`. Raises InputError for bad input, among it the article's observation, which no
    other protocol has.
    """
    run = opened(source, reporter)
    observation = run.config.model.observation
    if observation != "reaction":
        raise InputError(source, f"model.observation {observation!r}", "'reaction'")
    if diagnosis.by_reduced_model(run.config):
        why = "a diagnosis by the reduced model, which proposes no experiment yet"
        expected = "a protocol that a shipped surrogate knows, or a design by the full model"
        raise InputError(source, why, expected)
    diagnosed = diagnosis.diagnose(source, reporter)
    if "best_set" not in diagnosed:
        return diagnosed
    where = run.folder / FOLDER
    with locked(run.folder):
        started, of = time.monotonic(), _diagnosis(run)
        where.mkdir(parents=True, exist_ok=True)
        bench = workbench(run)
        fits = compete(diagnosis.fits_of(bench), diagnosed["best_set"], bench.known)
        answer: dict[str, Any] = {"sets": [list(one.names) for one in fits], "experiments": [], "ok": True}
        if len(fits) > 1:
            found = ranked(_weighed(source, [stored(one) for one in fits], bench, where, reporter))
            answer["ok"] = any(np.isfinite(one.gain_nats) for one in found)
            answer["experiments"] = [_row(one) for one in found]
            figure = report.figure_experiments(found)
            made = report.save_figure(figure, where / "experiments", caption(run))
            answer["figures"] = [path.name for path in made]
        write_json(where / "experiment.json", answer)
        seconds = time.monotonic() - started
        write_record(where, Record(of, True, seconds, output_hashes(where), plain(answer)))
    return plain({**answer, "folder": where, "text": _in_words(answer)})


def answered(run: Run) -> Record | None:
    """What was answered about the diagnosis that stands in the run's folder, if anything was asked of it."""
    return current_record(run.folder / FOLDER, _diagnosis(run))


def _diagnosis(run: Run) -> str:
    record = read_record(run.folder / diagnosis.STAGE.name)
    return "" if record is None else record.sha256


def _weighed(
    source: Path, fits: Sequence[Mapping[str, Any]], bench: Workbench, folder: Path, reporter: Reporter
) -> list[Experiment]:
    """Each protocol judged in one of two processes; those judged before an interruption are not again.

    One whose process was lost has no gain, and is judged anew the next time.
    """
    listed = {one.name: one for one in protocols(bench.motion)}
    of = [bayeskin.__version__, bench.run.config.seed, list(map(dict, fits))]
    file = folder / f"weighed-{sha256_of(of)[:12]}.jsonl"
    done = {
        row["protocol"]: Experiment(**row, motion=listed[row["protocol"]].motion) for row in read_lines(file)
    }
    todo = [name for name in listed if name not in done]
    for place, one in run_parallel(partial(_weigh_apart, source, fits), todo, 2):
        if isinstance(one, Lost):
            lost = listed[todo[place]]
            reporter.log(f"{lost.name}: {one.reason}")
            done[lost.name] = Experiment(
                lost.name, lost.sentence, lost.motion, *3 * (np.nan,), np.log(len(fits)), DRAWS * len(fits)
            )
            continue
        done[one.protocol] = one
        with open(file, "a", encoding="utf-8") as handle:
            handle.write(json.dumps(_row(one)) + "\n")
        told = f"{one.protocol}: {one.gain_nats:.2f} of {one.possible_nats:.2f} nats"
        reporter.progress("experiments", len(done) / len(listed), told)
    return list(done.values())


def _row(one: Experiment) -> dict[str, Any]:
    return {name: value for name, value in asdict(one).items() if name != "motion"}


def _weigh_apart(source: Path, fits: Sequence[Mapping[str, Any]], name: str) -> Experiment:
    """In a process of its own: mechanisms have no copies."""
    bench = workbench(opened(source, Silent()))
    found = [restored(one, bench.posterior(None, one["names"])) for one in fits]
    protocol = next(one for one in protocols(bench.motion) if one.name == name)
    return weigh(protocol, found, bench.known, partial(_coarse, bench.spec), bench.run.config.seed)


def _coarse(
    spec: ModelSpec, motion: PadMotion, theta: Mapping[str, float], laws: Sequence[Any]
) -> Simulation:
    return simulate(spec.coarsest, motion, theta, laws=laws)


def _in_words(answer: Mapping[str, Any]) -> str:
    if len(answer["sets"]) < 2:
        return "nothing competes: no look-alike was tried in the place of what explains the recording best"
    lines = ["taken as equally probable: " + "; or ".join(", ".join(one) for one in answer["sets"])]
    for one in answer["experiments"]:
        share = one["gain_nats"] / one["possible_nats"]
        told = f"{100 * share:.0f} % of what is to be known" if np.isfinite(share) else "could not be judged"
        lines.append(f"  {one['protocol']}: {told}. {one['sentence']}")
    return "\n".join(lines)
