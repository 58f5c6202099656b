"""Tangents serve again near the place where they served, and only there."""

from __future__ import annotations

import numpy as np

from bayeskin.reduced.tangents import KEEPING, Tangent, Tangents


def tangent(value: float) -> Tangent:
    tangent = Tangent(2)
    tangent.inverse[:], tangent.force_row[:], tangent.by_pads[:] = value, value, value
    return tangent


def test_the_nearest_serves_as_a_copy() -> None:
    kept, taken = Tangents(), Tangent(2)
    assert not kept.take((0.0, 0.0), taken)
    kept.keep((0.0, 0.0), tangent(1.0))
    kept.keep((0.5, 0.0), tangent(2.0))
    assert kept.take((0.4, 0.0), taken)
    assert np.all(taken.inverse == 2.0)
    taken.inverse[:] = 7.0  # corrections of a solve
    assert kept.take((0.4, 0.0), taken)
    assert np.all(taken.inverse == 2.0)


def test_one_of_a_far_longer_stage_does_not_serve() -> None:
    kept, taken = Tangents(), Tangent(2)
    kept.keep((0.0, 0.0), tangent(1.0))
    assert kept.take((0.0, 0.99 * KEEPING.far), taken)
    assert not kept.take((0.0, 1.01 * KEEPING.far), taken)


def test_one_at_the_same_place_is_replaced_and_the_oldest_goes_where_there_is_no_room() -> None:
    kept, taken = Tangents(), Tangent(2)
    kept.keep((0.0, 0.0), tangent(1.0))
    kept.keep((0.5 * KEEPING.same_place, 0.0), tangent(2.0))
    assert kept.take((0.0, 0.0), taken)
    assert np.all(taken.inverse == 2.0)
    for number in range(KEEPING.most):
        kept.keep((1.0 + 0.1 * number, 0.0), tangent(3.0 + number))
    assert kept.take((0.0, 0.0), taken)
    assert np.all(taken.inverse == 3.0)
