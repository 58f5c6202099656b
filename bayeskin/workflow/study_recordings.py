"""Infers the recordings of a study by the stages of a run, each in a worker process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from bayeskin import inference, storage
from bayeskin.config import Config, StudyFile, parameter_space, to_toml
from bayeskin.errors import InputError
from bayeskin.execution.local import Lost
from bayeskin.study import Entry, Individual
from bayeskin.types import ParameterSpace
from bayeskin.workflow.engine import Reporter, Run, Silent, run_stages
from bayeskin.workflow.executor import executor
from bayeskin.workflow.model import waves_model
from bayeskin.workflow.page import write_page
from bayeskin.workflow.stages import doubts_of, stages_of

LAST = "sample"  # the stage with which the run of a recording ends
MOST_DRAWS = 4000  # largest number of draws of a recording's posterior that are read


@dataclass(frozen=True)
class Member:
    """A recording of a study: its row of the table, and its run."""

    entry: Entry
    run: Run


@dataclass(frozen=True)
class LeftOut:
    """A recording that does not enter the population, and the reason."""

    member: Member
    reason: str


@dataclass(frozen=True)
class Outcome:
    """The answer of a worker: whether it succeeded, and a text, which gives the reason if it failed."""

    ok: bool
    text: str = ""


Task = Callable[[Run], Outcome]


def members_of(file: StudyFile, entries: Sequence[Entry]) -> list[Member]:
    """Returns the recordings with their runs, which lie in the folder `recordings` of the study.

    Raises InputError for wrong settings or devices, for files that are absent, for a device without the
    reduced model that the settings ask for, and for a surrogate together with several devices.
    """
    folder = file.folder / "recordings"
    members, devices = [], dict[object, Config]()
    for entry in entries:
        config = file.config_of(entry.name, folder, entry.recording, entry.device)
        run = Run(config, folder / f"{entry.name}.toml", folder / entry.name, Silent())
        members.append(Member(entry, run))
        devices.setdefault((config.device, config.tissue), config)
    if len(devices) > 1 and file.config.surrogate.file is not None:
        raise InputError(
            f"{file.table}, column 'device'",
            f"the number of devices is {len(devices)}",
            "it must be one, because surrogate.file was trained for one",
        )
    for config in devices.values():
        device = {"device": config.device, "tissue": config.tissue}
        waves_model(Run(file.config.model_copy(update=device), file.path, file.folder, Silent()))
        skin_parameters(config, file.path)
    return members


def skin_parameters(config: Config, where: object) -> ParameterSpace:
    """Returns the parameters in which skins are compared, with their priors.

    These are the parameters that are always positive, because a population is described by logarithms,
    without uncertain lengths. Raises InputError where there is none, and for a correlation with a parameter
    that is not compared.
    """
    space, lengths = parameter_space(config, where), config.geometry(where).sd_m
    compared = tuple(p for p in space.parameters if p.lower > 0.0 and p.name not in lengths)
    names = [parameter.name for parameter in compared]
    if not compared:
        raise InputError(
            f"{where}: parameters", "none is always positive", "at least one needs a lower bound above zero"
        )
    for first, second, _ in space.correlations:
        if (first in names) != (second in names):
            problem = f"{first} and {second} have a correlation"
            remedy = f"only {', '.join(names)}, in which skins are compared, can have correlations among them"
            raise InputError(f"{where}: parameters", problem, remedy)
    return ParameterSpace(
        compared, tuple(correlation for correlation in space.correlations if correlation.first in names)
    )


def make_folder(file: StudyFile, members: Sequence[Member]) -> None:
    """Writes the configuration of each recording into the study's folder.

    Reduced models that lie beside the study's file are linked from there, because runs look for them beside
    their configurations.
    """
    folder = file.folder / "recordings"
    folder.mkdir(parents=True, exist_ok=True)
    for member in members:
        storage.write_bytes(member.run.config_path, to_toml(member.run.config).encode())
    for model in file.folder.parent.glob("*-reduced.h5"):
        link = folder / model.name
        if not link.is_symlink():
            link.symlink_to(Path("..", "..", model.name))


def each(
    file: StudyFile, task: Task, members: Sequence[Member], reporter: Reporter, label: str
) -> tuple[list[tuple[Member, str]], list[LeftOut]]:
    """Applies a task to the runs of recordings, in the workers that the study's file asks for.

    Returns the recordings for which it succeeded, with its texts, and the others.
    """
    outcomes, count = dict[int, Outcome](), len(members)
    runs = [member.run for member in members]
    with executor(with_workers(runs[0], file)) as run_all, closing(run_all(task, runs)) as results:
        for at, result in results:
            outcomes[at] = Outcome(False, result.reason) if isinstance(result, Lost) else result
            if not outcomes[at].ok:
                reporter.log(f"{members[at].entry.name}: left out: {outcomes[at].text}")
            reporter.progress(label, len(outcomes) / count, f"{len(outcomes)} of {count} recordings")
    ended = [(member, outcomes[at]) for at, member in enumerate(members)]
    return (
        [(member, outcome.text) for member, outcome in ended if outcome.ok],
        [LeftOut(member, outcome.text) for member, outcome in ended if not outcome.ok],
    )


def with_workers(run: Run, file: StudyFile) -> Run:
    """Returns a run whose parallel work goes to the workers that the study's file asks for."""
    stated = file.config.design
    design = run.config.design.model_copy(update={"workers": stated.workers, "scheduler": stated.scheduler})
    return replace(run, config=run.config.model_copy(update={"design": design, "slurm": file.config.slurm}))


def infer(run: Run) -> Outcome:
    """Infers a recording, and writes its page; a posterior that is not trusted counts as a failure.

    This function runs in a worker. It raises no error.
    """
    return told(_inferred, run)


def told(task: Callable[[Run], Outcome], run: Run) -> Outcome:
    """Returns the outcome of a task; an error of any kind is its outcome."""
    try:
        return task(run)
    except InputError as error:
        return Outcome(False, str(error))
    except Exception as error:  # an error of any kind concerns this recording only
        return Outcome(False, " ".join(f"{type(error).__name__}: {error}".split()))


def _inferred(run: Run) -> Outcome:
    stages = stages_of(run.config)
    last = run_stages(run, stages, LAST)[-1]
    write_page(run, stages)
    if not last.record.done:
        return Outcome(False, f"the stage {last.stage} failed: {last.record.summary['message']}")
    doubts = doubts_of(run)
    return Outcome(not doubts, f"its posterior is not trusted: {doubts[0]}" if doubts else "")


def individual_of(member: Member) -> Individual:
    """Returns the posterior of a recording that was inferred. Raises InputError where it cannot be used."""
    space = skin_parameters(member.run.config, member.run.config_path)
    stored, draws = inference.draws_of(inference.load_inference_data(member.run.at(LAST, "posterior.nc")))
    columns = [stored.names.index(name) for name in space.names]
    return Individual(member.entry.name, space, inference.evenly(draws[:, columns], MOST_DRAWS))
