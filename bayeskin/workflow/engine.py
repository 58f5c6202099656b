"""Runs stages in order: skips those that are done and unchanged, and continues interrupted stages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import bayeskin
from bayeskin.config import WHO_RUNS, Config, load_config
from bayeskin.config.device import DeviceConfig, TissueConfig
from bayeskin.errors import InputError
from bayeskin.hashing import sha256_of, sha256_of_input
from bayeskin.json_files import plain
from bayeskin.store import Store
from bayeskin.workflow import folder
from bayeskin.workflow.folder import Record

STANDINGS = ("done", "not run", "not finished", "failed", "out of date")


class Reporter(Protocol):
    """Receives messages and the progress of a run."""

    def log(self, message: str) -> None:
        """Receives a message."""
        ...

    def progress(self, label: str, share: float, note: str = "") -> None:
        """Receives the share, from 0 to 1, of the task `label` that is done."""
        ...


class Silent:
    """A Reporter that ignores everything."""

    def log(self, message: str) -> None: ...

    def progress(self, label: str, share: float, note: str = "") -> None: ...


class CannotGoOn(Exception):
    """A stage's computation failed; the text says why and what to do. The engine turns it into an Outcome."""


@dataclass(frozen=True)
class Run:
    """A configuration and the folder of its outputs.

    from_file : whether the configuration is a file; otherwise `config_path` is the first recording
    """

    config: Config
    config_path: Path
    folder: Path
    reporter: Reporter
    from_file: bool = True

    def at(self, stage: str, file: str) -> Path:
        """Returns the path of an output of a stage."""
        return self.folder / stage / file

    def store(self, kind: str, computed_from: Any) -> Store:
        """Returns the store of finished results of a kind that were computed from these values."""
        file = f"{kind}-{sha256_of(computed_from)[:16]}.store"
        return Store(self.folder / "finished" / file, computed_from, self.reporter.log)

    def inputs_sha256(self, stage: str) -> str:
        """Returns the hash of all that a stage depends on, which is recorded when the stage begins."""
        record = folder.read_record(self.folder / stage)
        return record.inputs_sha256 if record is not None else ""

    def beside(self, file: str) -> Path:
        """Returns the path of a file that the configuration names; raises InputError where there is none."""
        path = self.config_path.resolve().parent / file
        if not path.is_file():
            raise InputError(
                self.config_path,
                f"there is no file {path}",
                "the files that the configuration names must exist",
            )
        return path

    def summary(self, stage: str) -> Mapping[str, Any]:
        """Returns the summary that a stage left, and {} where there is none."""
        record = folder.read_record(self.folder / stage)
        return record.summary if record is not None else {}


@dataclass(frozen=True)
class Stage:
    """One stage, with the sections of the configuration, the files and the earlier stages that it reads.

    `work` writes the outputs into the stage's folder and returns the summary. `format` is increased when the
    contents of the summary change, so that summaries in an earlier format count as out of date.
    """

    name: str
    does: str
    needs: tuple[str, ...]
    sections: tuple[str, ...]
    work: Callable[[Run], Mapping[str, Any]]
    files: Callable[[Run], Iterable[Path]] = field(default=lambda run: ())
    format: int = 1


@dataclass(frozen=True)
class Outcome:
    """The end of a stage: its record, and whether the stage was skipped because it had been done before.

    ``record.done`` is False where the computation failed; ``record.summary["message"]`` then says why.
    """

    stage: str
    skipped: bool
    record: Record

    @property
    def ok(self) -> bool:
        """Returns whether the stage was done and its summary says that its answer is reliable."""
        return self.record.done and bool(self.record.summary.get("ok", True))


def open_run(config_path: Path, reporter: Reporter, folder: Path | None = None) -> Run:
    """Returns the run of a configuration; its folder lies beside the configuration unless it is given.

    Raises InputError for a configuration that is wrong.
    """
    config = load_config(config_path)
    return Run(config, config_path, folder or config_path.resolve().parent / config.name, reporter)


def run_stages(run: Run, stages: Mapping[str, Stage], last: str | None = None) -> list[Outcome]:
    """Runs the stage `last` after the stages that it needs, in order; all stages where `last` is None.

    The call ends with the first stage that fails. After an interruption, the same call continues with the
    stages where they stopped. Raises InputError for wrong input, or when another process works in the run's
    folder.
    """
    needed = _needed(stages, last)
    outcomes: list[Outcome] = []
    with folder.locked(run.folder):
        for name, stage in stages.items():
            if name in needed:
                outcomes.append(_run_stage(run, stage))
                if not outcomes[-1].record.done:
                    break
    return outcomes


def standing(run: Run, stages: Mapping[str, Stage]) -> dict[str, tuple[str, Record | None]]:
    """Returns the state of each stage, as one of `STANDINGS`, and its record; it runs no stage.

    A stage counts as done if this version made it from this configuration, its files and earlier stages that
    are done, and if its outputs have not changed since.
    """
    states: dict[str, tuple[str, Record | None]] = {}
    for name, stage in stages.items():
        record, inputs = folder.read_record(run.folder / name), _inputs_sha256(run, stage)
        current = all(states[need][0] == "done" for need in stage.needs)
        if record is None:
            states[name] = "not run", None
        elif record.inputs_sha256 != inputs or not current:
            states[name] = "out of date", record
        elif folder.current_record(run.folder / name, inputs) is not None:
            states[name] = "done", record
        elif record.done:
            states[name] = "out of date", record
        else:
            states[name] = "failed" if "message" in record.summary else "not finished", record
    return states


def _needed(stages: Mapping[str, Stage], last: str | None) -> set[str]:
    """Returns the stage `last` and all stages that it needs, directly or through others."""
    if last is None:
        return set(stages)
    return {last}.union(*(_needed(stages, name) for name in stages[last].needs))


def _inputs_sha256(run: Run, stage: Stage) -> str:
    """Returns the hash of all that a stage depends on."""
    records = {name: folder.read_record(run.folder / name) for name in stage.needs}
    config = run.config.model_dump(mode="json", exclude=WHO_RUNS)
    sections = stage.sections
    if "parameters" in sections:  # these depend on device and tissue too; defaults keep the old hashes
        defaults = {"device": DeviceConfig(), "tissue": TissueConfig()}
        sections += tuple(name for name, value in defaults.items() if getattr(run.config, name) != value)
    if "recording" in sections and run.config.recordings:
        sections += ("recordings",)
    if not run.config.fit.shared:  # keeps the hashes from before there were several recordings
        del config["fit"]["shared"]
    return sha256_of(
        {
            "version": bayeskin.__version__,
            "config": {section: config[section] for section in sections},
            "files": [sha256_of_input(path) for path in stage.files(run)],
            "stages": {name: record.sha256 for name, record in records.items() if record is not None},
            **({"format": stage.format} if stage.format > 1 else {}),  # the first format keeps the old hashes
        }
    )


def _run_stage(run: Run, stage: Stage) -> Outcome:
    """Runs a stage, unless it is done and unchanged, and writes its record in any case."""
    inputs, where = _inputs_sha256(run, stage), run.folder / stage.name
    record = folder.current_record(where, inputs)
    if record is not None:
        run.reporter.log(f"{stage.name}: done before, unchanged")
        return Outcome(stage.name, True, record)
    run.reporter.log(f"{stage.name}: {stage.does}")
    spent, started = folder.begin(where, inputs), time.perf_counter()
    summary: Mapping[str, Any] = {}
    done = False
    try:
        summary = stage.work(run)
        done = True
    except CannotGoOn as failure:
        summary = {"ok": False, "message": str(failure)}
        run.reporter.log(f"{stage.name}: failed: {failure}")
    finally:
        record = Record(
            inputs_sha256=inputs,
            done=done,
            seconds=spent + time.perf_counter() - started,
            outputs=folder.output_hashes(where) if done else {},
            summary=plain(summary),
            provenance=_provenance(run),
        )
        folder.write_record(where, record)
    run.reporter.log(f"{stage.name}: {record.seconds:.1f} s")
    return Outcome(stage.name, False, record)


def _provenance(run: Run) -> dict[str, Any]:
    """Returns version, configuration hash and seed for the stage's record."""
    config = run.config
    return {"version": bayeskin.__version__, "config_sha256": config.sha256, "seed": config.seed}
