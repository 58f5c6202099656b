"""A study of many skins: all its recordings are inferred, then the population from which they come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import bayeskin
from bayeskin import report, storage
from bayeskin.config import StudyFile, load_study
from bayeskin.errors import InputError
from bayeskin.hashing import sha256_of, sha256_of_file
from bayeskin.json_files import plain, write_json
from bayeskin.report.page import StudyFacts, render_study
from bayeskin.report.words import markers_unused_in_words
from bayeskin.study import (
    Entry,
    Individual,
    Priors,
    SamplerSettings,
    infer_population,
    read_table,
    refuse_few_subjects,
)
from bayeskin.workflow import folder
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.importing import markers_beside
from bayeskin.workflow.study_answer import population_in_json
from bayeskin.workflow.study_protocols import protocol, with_shared_surrogates
from bayeskin.workflow.study_recordings import (
    LAST,
    LeftOut,
    Member,
    each,
    individual_of,
    infer,
    make_folder,
    members_of,
)

POPULATION, ANSWER = "population", "study.json"
Posterior = tuple[Member, Individual]


def study(path: Path, reporter: Reporter, scheduler: str | None = None) -> dict[str, Any]:
    """Infers all recordings of a study and their population, and returns the answer of `bayeskin study`.

    A recording that fails, or whose posterior is not trusted, is left out, and the answer says so. What an
    earlier call has finished is not repeated.

    scheduler : address of a Dask scheduler that replaces `design.scheduler` of the study's file
    Raises InputError for a file, a table or a device that is wrong, with nothing written.
    """
    file = load_study(path)
    if scheduler is not None:
        design = file.config.design.model_copy(update={"scheduler": scheduler})
        file = replace(file, config=file.config.model_copy(update={"design": design}))
    entries = read_table(file.table)
    members = members_of(file, entries)
    unused = [entry.name for entry in entries if markers_beside(entry.recording).exists()]
    if unused:
        reporter.log(markers_unused_in_words("a study", unused))
    with folder.locked(file.folder):
        posteriors, left_out = _posteriors(file, members, reporter)
        answer = {**_facts(file), **_population(file, posteriors, reporter)}
        answer["recordings"] = _rows(file, members, left_out, answer.get("recordings", []))
        answer["markers_unused"] = unused
        answer["left_out"] = {member.member.entry.name: member.reason for member in left_out}
        write_json(file.folder / ANSWER, answer)
        page = _write_page(file, plain(answer))
    return plain({**answer, "folder": file.folder, "page": page, "text": _text(answer, len(members), page)})


def _posteriors(
    file: StudyFile, members: Sequence[Member], reporter: Reporter
) -> tuple[list[Posterior], list[LeftOut]]:
    """Returns the posteriors of the recordings, and the recordings without one, in the table's order."""
    make_folder(file, members)
    known, left_out = each(file, protocol, members, reporter, "protocols")
    ready, without = with_shared_surrogates(file, known, reporter)
    order = {member.entry.name: at for at, member in enumerate(members)}
    ready.sort(key=lambda member: order[member.entry.name])
    make_folder(file, ready)
    done, failed = each(file, infer, ready, reporter, "recordings") if ready else ([], [])
    left_out = [*left_out, *without, *failed]
    posteriors = list[Posterior]()
    for member, _ in done:
        try:
            posteriors.append((member, individual_of(member)))
        except InputError as error:
            left_out.append(LeftOut(member, str(error)))
    return posteriors, sorted(left_out, key=lambda member: order[member.member.entry.name])


def _facts(file: StudyFile) -> dict[str, Any]:
    """Returns the origin of an answer."""
    return {
        "name": file.config.name,
        "version": bayeskin.__version__,
        "seed": file.config.seed,
        "config_sha256": file.config.sha256,
        "table_sha256": sha256_of_file(file.table),
    }


def _population(file: StudyFile, posteriors: Sequence[Posterior], reporter: Reporter) -> Mapping[str, Any]:
    """Returns what the posteriors say about the population, from the last call where they are the same."""
    entries = [member.entry for member, _ in posteriors]
    try:
        refuse_few_subjects(f"{file.table}, without the recordings that are left out", entries)
    except InputError as error:
        return {"ok": False, "verdict": "no population", "because": [str(error)]}
    where, priors, settings = file.folder / POPULATION, Priors(), SamplerSettings()
    inputs = sha256_of({
        "version": bayeskin.__version__, "seed": file.config.seed,
        "entries": [_of_entry(entry) for entry in entries],
        "posteriors": [sha256_of_file(member.run.at(LAST, "posterior.nc")) for member, _ in posteriors],
        "priors": asdict(priors), "settings": asdict(settings),
    })  # fmt: skip
    if (record := folder.current_record(where, inputs)) is not None:
        reporter.log("population: done before, unchanged")
        return record.summary
    reporter.log(f"population: of {len(entries)} recordings")
    folder.begin(where, inputs)
    rng = np.random.default_rng([file.config.seed, 5])
    tell = partial(reporter.progress, "population")
    population = infer_population(
        entries, [posterior for _, posterior in posteriors], rng, priors, settings, tell
    )
    stamp = f"bayeskin {bayeskin.__version__}, {file.config.name}, inputs {inputs[:12]}"
    for name, figure in (
        ("population", report.figure_population(population)),
        ("recordings", report.figure_recordings(population)),
    ):
        report.save_figure(figure, where / name, stamp)
    summary = plain(population_in_json(population))
    folder.write_record(where, folder.Record(inputs, True, 0.0, folder.output_hashes(where), summary))
    return summary


def _rows(
    file: StudyFile,
    members: Sequence[Member],
    left_out: Sequence[LeftOut],
    estimates: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Returns each row of the table, with the origin of its posterior, its report and its estimates."""
    reasons = {member.member.entry.name: member.reason for member in left_out}
    known = {member["name"]: member for member in estimates}
    rows = []
    for member in members:
        name, run = member.entry.name, member.run
        page = run.folder / "report.html"
        rows.append({
            **_of_entry(member.entry),
            "sha256": run.summary("recording").get("sha256"),
            "config_sha256": run.config.sha256,
            "model_hash": run.summary("design").get("model_hash"),
            "report": str(page.relative_to(file.folder)) if page.is_file() else None,
            "left_out": reasons.get(name),
            **{key: known[name][key] for key in ("alone", "given_the_study") if name in known},
        })  # fmt: skip
    return rows


def _write_page(file: StudyFile, answer: Mapping[str, Any]) -> Path:
    """Writes the page of the study, completely or not at all, and returns its path."""
    drawn = sorted((file.folder / POPULATION).glob("*.svg")) if "parameters" in answer else []
    facts = StudyFacts(
        str(file.path), file.path.read_text(encoding="utf-8-sig"), file.table.name,
        file.table.read_text(encoding="utf-8-sig"), answer,
        {figure.stem: figure.read_text(encoding="utf-8") for figure in drawn},
    )  # fmt: skip
    path = file.folder / "report.html"
    storage.write_bytes(path, render_study(facts).encode())
    return path


def _of_entry(entry: Entry) -> dict[str, Any]:
    """Returns what the table says about a recording."""
    texts = {name: getattr(entry, name) for name in ("name", "subject", "site", "group", "session")}
    return {**texts, "recording": entry.recording.name}


def _text(answer: Mapping[str, Any], count: int, page: Path) -> str:
    """Returns the answer as text."""
    left_out = answer["left_out"]
    return "\n".join([
        f"{answer['name']}: {answer['verdict']}: {'; '.join(answer['because'])}",
        *answer.get("sentences", ()),
        f"{count - len(left_out)} of {count} recordings enter.",
        *(f"left out: {name}: {reason}" for name, reason in left_out.items()),
        *([markers_unused_in_words("a study", answer["markers_unused"])] if answer["markers_unused"] else []),
        f"report: {page}",
    ])  # fmt: skip
