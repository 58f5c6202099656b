"""Figures of a study: each recording has its rows, each group its colour, and the headline the finding."""

from __future__ import annotations

import pytest
from toys.figure_inputs import drawn, headline, labels
from toys.made_up_population import PERMEABILITY, about, population, table

from bayeskin import report
from bayeskin.study import Contrast, Estimate, Spread

pytestmark = pytest.mark.filterwarnings("error")
K_S = {"parameter": PERMEABILITY, "medians": {"control": about(1e-13), "keloid": about(2e-13)}}


def texts(figure) -> list[str]:
    return [text.get_text() for ax in figure.axes for text in ax.texts]


def test_every_subject_has_a_label_and_every_group_a_name() -> None:
    figure = drawn(report.figure_recordings(population(table(), {}, K_S)))
    assert len(figure.axes) == 2
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        "s0",
        "s2",
        "s4",
        "s1",
        "s3",
        "s5",
    ]
    assert {"control", "keloid"} <= set(texts(figure))
    assert "log$_{10}$ $E_{c}$ / Pa" in labels(figure)


def test_the_headline_is_the_clearest_difference() -> None:
    vague = Contrast("group", "control", "keloid", about(1.1), 0.6)
    figure = drawn(report.figure_population(population(table(), K_S | {"contrasts": (vague,)}, {})))
    assert "stiffer" in headline(figure)
    assert "0.97" in headline(figure)


def test_the_headline_of_the_recordings_is_how_much_the_study_narrows_them() -> None:
    """Made-up intervals are a factor of 2 about the median alone, and of 1.3 given the study."""
    figure = drawn(report.figure_recordings(population(table(), {}, K_S)))
    assert headline(figure).count("2.6") == 2  # log(2) / log(1.3)


def test_without_groups_the_widest_spread_is_the_headline() -> None:
    figure = drawn(
        report.figure_population(population(table(groups=()), {}, {"between": Spread(about(0.9))}))
    )
    assert len(figure.axes) == 1
    assert "Subjects differ most" in headline(figure)


def test_what_is_not_trusted_or_not_informed_is_no_finding() -> None:
    assert "not to be trusted" in headline(report.figure_recordings(population(table(), trusted=False)))
    assert "No recording" in headline(report.figure_population(population(table(), {"informative": 0})))


def test_ratios_have_their_probability_and_spreads_may_have_an_upper_bound_only() -> None:
    upper = Spread(Estimate(0.05, 0.001, 0.2))
    figure = drawn(report.figure_population(population(table(), {"within": upper}, K_S)))
    assert len(figure.axes) == 2
    assert texts(figure).count("0.97") == 2
    markers = [line.get_marker() for line in figure.axes[1].lines]
    assert markers.count("<") == 1


@pytest.mark.parametrize("groups", [(), ("control", "keloid"), tuple("abcdefgh")])
def test_many_recordings_and_groups_fit_on_a_page(groups: tuple[str, ...]) -> None:
    entries = table(subjects=96, groups=groups)
    medians = {group: about(1e5) for group in groups or ("",)}
    contrasts = tuple(Contrast("group", "a", b, about(1.5), 0.9) for b in groups[1:])
    result = population(entries, {"medians": medians, "contrasts": contrasts})
    for figure in (report.figure_recordings(result), report.figure_population(result)):
        assert drawn(figure).get_figheight() < 11.0
    assert len(report.figure_recordings(result).axes[0].get_yticks()) >= 48
