"""Sentences about a study: they say what is known, in plain words, and what the table cannot tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from toys.made_up_population import PERMEABILITY, about, population, table

from bayeskin.study import Contrast, Estimate, Overlap, Spread, sentences
from bayeskin.study.layout import Layout


def said(*arguments, **keywords) -> str:
    return "\n".join(sentences(population(*arguments, **keywords)))


def test_groups_are_compared_with_a_probability_and_a_factor() -> None:
    text = said(table())
    assert (
        "E_c: group keloid is stiffer than group control with probability 0.97, by a factor of 1.8 [1.3, 2.5]"
        in text
    )
    assert "in group control and" in text


def test_the_larger_group_is_named_first_whatever_their_order() -> None:
    contrast = Contrast("group", "control", "keloid", Estimate(0.5, 0.4, 0.8), 0.02)
    text = said(table(), {"parameter": PERMEABILITY, "contrasts": (contrast,)})
    assert (
        "group control is more permeable than group keloid with probability 0.98, by a factor of 2 [1.2, 2.5]"
        in text
    )


def test_spreads_are_coefficients_of_variation() -> None:
    text = said(table())
    assert "the coefficient of variation between subjects is 42 % [32, 56 %]" in text
    assert "the coefficient of variation within a subject is 10 %" in text


def test_a_spread_that_may_be_zero_has_an_upper_bound_only() -> None:
    text = said(table(), {"within": Spread(Estimate(0.05, 0.005, 0.2))})
    assert (
        "within a subject cannot be told from zero; its coefficient of variation is below 20 % with" in text
    )


def test_one_recording_a_subject_leaves_the_variation_within_a_subject_unknown() -> None:
    text = said(table(sessions=1))
    assert "Each subject has one recording. The variation within a subject is therefore not known" in text
    assert "coefficient of variation within" not in text


def test_recordings_of_one_session_do_not_show_differences_between_sessions() -> None:
    entries = [replace(entry, session="1") for entry in table()]
    assert "does not include differences between sessions" in said(entries)
    assert "sessions" not in said(table())


def test_sites_that_are_groups_are_mentioned() -> None:
    entries = [replace(entry, site=f"at {entry.group}") for entry in table()]
    assert "Sites cannot be told apart from groups" in said(entries)


def test_what_the_recordings_leave_open_is_said() -> None:
    assert "no recording informs it, so all its numbers are those of the prior" in said(
        table(), {"informative": 0}
    )
    text = said(table(), {"informative": 5, "at_lower": 2})
    assert "only 5 of 12 recordings inform it" in text
    assert "posteriors of 2 of 12 recordings lean on the lower bound of the prior" in text


def test_results_that_are_not_trusted_say_so() -> None:
    assert "Not trusted" not in said(table())
    assert "Not trusted: R-hat is 1.3." in said(table(), trusted=False)
    overlaps = (Overlap("a.h5", 900.0, 0.3, 0.8), Overlap("b.h5", 3.0, 0.9, 0.8))
    text = said(table(), overlaps=overlaps)
    assert "Not trusted: the weighted draws of a.h5 differ from its shrunk estimate by 0.8 of its sd" in text
    assert "The draws of 1 of 2 recordings hardly overlap" in text
    assert "b.h5" not in text
    assert not population(table(), overlaps=overlaps).trusted


def test_every_sentence_is_one() -> None:
    text = sentences(
        population(table(), {}, {"informative": 0}, {"at_upper": 1, "between": Spread(about(9.0))})
    )
    assert all(line.endswith(".") and "\n" not in line for line in text)
    assert any("more than 1000 %" in line for line in text)


@pytest.mark.parametrize(
    ("entries", "repetition", "levels"),
    [
        (table(sessions=1), "none", []),
        (table(), "sessions", ["subject"]),
        ([replace(e, session=None) for e in table()], "recordings", ["subject"]),
        ([replace(e, session="1") for e in table()], "recordings of a session", ["subject"]),
        (
            [replace(e, recording=Path(f"{e.recording}{k}")) for e in table() for k in range(2)],
            "sessions and recordings", ["subject", "session"],
        ),
    ],
    ids=["none", "sessions", "recordings", "one session", "both"],
)  # fmt: skip
def test_a_layout_has_the_levels_that_its_table_repeats(entries, repetition, levels) -> None:
    layout = Layout.of(entries)
    assert layout.repetition == repetition
    assert [level.name for level in layout.levels] == levels


def test_a_row_of_the_layout_is_a_group_averaged_over_the_sites() -> None:
    entries = [
        replace(entry, site="xyz"[k], session=None)
        for entry in table(sessions=1, groups=("a", "b", "c"))
        for k in range(3)
    ]
    layout = Layout.of(entries)
    assert layout.row("a").tolist() == [1.0, 0.0, 0.0, 1 / 3, 1 / 3]
    assert layout.row("c").tolist() == [1.0, 0.0, 1.0, 1 / 3, 1 / 3]
    assert layout.matrix[-1].tolist() == [1.0, 0.0, 1.0, 0.0, 1.0]
    assert not layout.site_is_group
