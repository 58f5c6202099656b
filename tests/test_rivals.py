"""The rivals of the most probable set, whose further maxima are searched for."""

from __future__ import annotations

import pytest
from toys import closed_form_reduced
from toys.closed_form_reduced import BASE, KNOWN

from bayeskin.mismatch.further_maxima import rivals
from bayeskin.mismatch.hypotheses import Evidences
from bayeskin.mismatch.search_context import SearchContext
from bayeskin.mismatch.search_record import Names, SearchRecord
from bayeskin.mismatch.search_settings import SearchSettings

DRIFT, OFFSET, BOTH = ("sensor-drift",), ("force-offset",), ("force-offset", "sensor-drift")


def compared(nats: dict[Names, float]) -> SearchContext:
    """A search that has compared sets, whose log-evidences without a discrepancy are given."""
    evidences = {names: Evidences(value, value - 50.0) for names, value in nats.items()}
    return SearchContext(
        list, closed_form_reduced.recorded(0), BASE, KNOWN, (), {}, 1, str, SearchSettings(),
        SearchRecord(evidences=evidences),
    )  # fmt: skip


@pytest.mark.parametrize(("offset", "expected"), [(92.0, [OFFSET]), (79.0, [])])
def test_a_rival_is_at_most_so_far_behind_the_most_probable_set(offset: float, expected: list[Names]) -> None:
    context = compared({(): 60.0, DRIFT: 100.0, OFFSET: offset})
    assert context.record.chosen == DRIFT
    assert rivals(context, 20.0) == expected


def test_the_set_without_mechanisms_is_no_rival_and_has_none() -> None:
    assert rivals(compared({(): 99.0, DRIFT: 109.0}), 20.0) == []
    assert rivals(compared({(): 99.0, DRIFT: 100.0}), 20.0) == []


def test_a_set_that_contains_a_rival_is_none() -> None:
    context = compared({(): 60.0, DRIFT: 94.0, OFFSET: 97.0, BOTH: 110.0})
    assert context.record.chosen == BOTH
    assert rivals(context, 20.0) == [OFFSET, DRIFT]
    context = compared({(): 60.0, OFFSET: 100.0, BOTH: 98.0})
    assert context.record.chosen == OFFSET
    assert rivals(context, 20.0) == []
