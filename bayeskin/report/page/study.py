"""Makes the page of a study: its answer, groups, variation, recordings and provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bayeskin.number_format import number, percent, probability, with_interval
from bayeskin.report.page.parts import (
    Block,
    Cell,
    Facts,
    Folded,
    Picture,
    Section,
    Source,
    Table,
    Text,
    Verdict,
    row,
)
from bayeskin.report.page.svg import inline_svg
from bayeskin.report.words import markers_unused_in_words

FIGURES = {
    "population": (
        "Ratios of groups, and variation between and within subjects",
        "Ratios of the medians of groups and sites with the probability of a ratio above 1, and coefficients "
        "of variation between and within subjects, for each parameter.",
    ),
    "recordings": (
        "Each recording by itself, and given the whole study",
        "Medians and 90 % intervals of each parameter for each recording, by itself and given all "
        "recordings, sorted by group and subject.",
    ),
}
_SPREADS = {
    "between_subjects": "between subjects",
    "within_a_subject": "within a subject",
    "within_a_session": "between recordings of one session",
}


@dataclass(frozen=True)
class StudyFacts:
    """Holds the facts of a study: its file, its table and its answer, which `study.json` contains.

    config_path : as a person would type it; config_text, table_text : contents of the files
    figures : SVG text by name
    """

    config_path: str
    config_text: str
    table_name: str
    table_text: str
    answer: Mapping[str, Any]
    figures: Mapping[str, str]

    @property
    def name(self) -> str:
        """Returns the name of the study."""
        return str(self.answer["name"])

    @property
    def version(self) -> str:
        """Returns the version of bayeskin that made the answer."""
        return str(self.answer["version"])

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Returns the answer of each parameter; there is none where no population could be inferred."""
        parameters: Mapping[str, Any] = self.answer.get("parameters", {})
        return parameters


def study_verdict(facts: StudyFacts) -> Verdict:
    """Returns the verdict on a study, with its result in three sentences at most."""
    answer = facts.answer
    lines = [*answer.get("headline", ()), _entering(answer)]
    if not answer["ok"]:
        lines = [*(f"{answer['verdict'].capitalize()}: {reason}." for reason in answer["because"]), *lines]
    return Verdict(answer["verdict"], "good" if answer["ok"] else "doubt", lines)


def _entering(answer: Mapping[str, Any]) -> str:
    """Returns how many recordings enter."""
    total, left_out = len(answer["recordings"]), len(answer["left_out"])
    if not left_out:
        return f"All {total} recordings enter."
    are = "is" if left_out == 1 else "are"
    return f"{total - left_out} of {total} recordings enter; {left_out} {are} left out (see Recordings)."


def study_picture(facts: StudyFacts, name: str) -> list[Picture]:
    """Returns a figure of the study in a list, which is empty where it was not drawn."""
    if name not in facts.figures:
        return []
    return [Picture(f"study-{name}", *FIGURES[name], inline_svg(facts.figures[name], f"study-{name}"))]


def study_sections(facts: StudyFacts) -> list[Section]:
    """Returns the sections below the answer."""
    always = [_recordings(facts), _provenance(facts)]
    if not facts.parameters:
        return always
    return [_groups(facts), _variation(facts), _in_words(facts), *always]


def _groups(facts: StudyFacts) -> Section:
    """Returns the section on medians of the groups, and on their ratios."""
    groups = list(next(iter(facts.parameters.values()))["medians"])
    head = ("parameter", "meaning", *(group or "median" for group in groups))
    rows = [
        row(
            (
                name,
                parameter["meaning"],
                *(_estimate(parameter["medians"][group], parameter["unit"]) for group in groups),
            )
        )
        for name, parameter in facts.parameters.items()
    ]
    title = "Medians of the groups" if len(groups) > 1 else "Medians of the population"
    blocks: list[Block] = [Table(f"{title}, with 90 % intervals", head, rows, symbols=True)]
    ratios = [
        row((
            name, f"{ratio['numerator']} / {ratio['denominator']}", _estimate(ratio, ""),
            Cell(probability(ratio["probability_above_1"]), ratio["probability_above_1"]),
        ))
        for name, parameter in facts.parameters.items()
        for ratio in parameter["ratios"]
    ]  # fmt: skip
    if ratios:
        head = ("parameter", "ratio of the medians of", "ratio [90 %]", "probability of a ratio above 1")
        blocks.append(Table("Differences", head, ratios, symbols=True))
    return Section("groups", "Groups" if len(groups) > 1 else "Medians", blocks)


def _variation(facts: StudyFacts) -> Section:
    """Returns the section on the variation between and within subjects."""
    known = {
        key: title
        for key, title in _SPREADS.items()
        if any(parameter[key] is not None for parameter in facts.parameters.values())
    }
    rows = [
        row((name, *(_variation_cell(parameter[key]) for key in known), *_informing(facts, parameter)))
        for name, parameter in facts.parameters.items()
    ]
    head = ("parameter", *known.values(), "recordings that inform it", "posteriors that lean on a bound")
    caption = "Coefficients of variation, with 90 % intervals; the second is the repeatability"
    if len(known) == 1:
        caption = "Coefficients of variation, with 90 % intervals"
    return Section("variation", "Variation", [Table(caption, head, rows, symbols=True)])


def _informing(facts: StudyFacts, parameter: Mapping[str, Any]) -> tuple[Cell, Cell]:
    count, leaning = parameter["informative_recordings"], parameter["leaning_on_bounds"]
    total = len(facts.answer["recordings"]) - len(facts.answer["left_out"])
    sides = [f"{leaning[side]} on the {side}" for side in ("lower", "upper") if leaning[side]]
    return (
        Cell(f"{count} of {total}", count),
        Cell(", ".join(sides) or "none", sum(leaning.values())),
    )


def _variation_cell(spread: Mapping[str, Any] | None) -> Cell:
    if spread is None:
        return Cell("–")
    cv = spread["coefficient_of_variation"]
    if spread["only_upper_bound"]:
        return Cell(f"below {percent(cv['high_90'], 2)}", cv["high_90"])
    text = f"{percent(cv['median'], 2)} [{number(100 * cv['low_90'], 2)}, {number(100 * cv['high_90'], 2)}]"
    return Cell(text, cv["median"])


def _in_words(facts: StudyFacts) -> Section:
    """Returns the section with the result in sentences, and with what the data cannot tell."""
    return Section("words", "In words", [Text(facts.answer["sentences"], listed=True)])


def _recordings(facts: StudyFacts) -> Section:
    """Returns the section on the recordings, whose names open their reports."""
    rows = facts.answer["recordings"]
    columns = [
        key for key in ("subject", "group", "site", "session") if any(recording[key] for recording in rows)
    ]
    head = ("recording", *columns, "posterior", *facts.parameters)
    table = Table(
        "Recordings. A name opens the recording's own report; values are given the whole study",
        head,
        [
            (
                Cell(recording["name"], href=recording["report"] or ""),
                *(Cell(str(recording[key])) for key in columns),
                Cell("trusted" if recording["left_out"] is None else "left out"),
                *_values(recording, facts.parameters),
            )
            for recording in rows
        ],
    )
    blocks: list[Block] = [*study_picture(facts, "recordings"), table]
    if unused := facts.answer.get("markers_unused"):
        blocks.append(Text([markers_unused_in_words("a study", unused)]))
    if reasons := facts.answer["left_out"]:
        listed = [f"{name}: {reason}" for name, reason in reasons.items()]
        blocks.insert(0, Text(["These recordings are left out:"]))
        blocks.insert(1, Text(listed, listed=True))
    return Section("recordings", "Recordings", blocks)


def _values(recording: Mapping[str, Any], parameters: Mapping[str, Any]) -> Sequence[Cell]:
    given = recording.get("given_the_study")
    if given is None:
        return [Cell("–")] * len(parameters)
    return [_estimate(given[name], parameter["unit"]) for name, parameter in parameters.items()]


def _estimate(estimate: Mapping[str, float], unit: str) -> Cell:
    """Returns a median with its 90 % interval."""
    return Cell(
        with_interval(estimate["median"], estimate["low_90"], estimate["high_90"], unit), estimate["median"]
    )


def _provenance(facts: StudyFacts) -> Section:
    """Returns the section on provenance: version, files, hashes and seed."""
    answer = facts.answer
    models = sorted(
        {recording["model_hash"] for recording in answer["recordings"] if recording["model_hash"]}
    )
    pairs = [
        ("bayeskin", facts.version), ("study", facts.config_path),
        ("sha256 of its settings", answer["config_sha256"]), ("sha256 of its table", answer["table_sha256"]),
        ("hashes of the models", ", ".join(models) or "–"), ("seed", str(answer["seed"])),
    ]  # fmt: skip
    hashes = [
        row((recording["name"], recording["recording"], str(recording["sha256"] or "–")))
        for recording in answer["recordings"]
    ]
    return Section(
        "provenance", "Provenance",
        [
            Facts(pairs),
            Folded("Hashes of the recordings", [Table("Recordings", ("name", "file", "sha256"), hashes)]),
            Source("The study's file", facts.config_text),
            Source(f"The table {facts.table_name}", facts.table_text),
        ],
    )  # fmt: skip
