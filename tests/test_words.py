"""Numbers in sentences: as people write them."""

import re

import numpy as np
import pytest

from bayeskin.mechanisms import catalogue
from bayeskin.number_format import number, probability
from bayeskin.types import ParameterSpace


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [
        (283.0, 2, "280"),
        (12.34, 2, "12"),
        (0.0512, 2, "0.051"),
        (0.5, 3, "0.5"),
        (-1234.0, 2, "−1200"),
        (0.0, 2, "0"),
        (2e-14, 2, "2 × 10⁻¹⁴"),
        (3.21e9, 2, "3.2 × 10⁹"),
        (np.float64(99.9), 2, "100"),
    ],
)
def test_a_number_has_its_digits_and_no_power_of_ten_that_it_does_not_need(value, digits, written):
    assert number(value, digits) == written


def test_a_sign_is_there_when_it_matters():
    assert [number(v, 2, sign=True) for v in (12.0, -12.0)] == ["+12", "−12"]


@pytest.mark.parametrize("at", [0.02, 0.5, 0.98])
def test_no_statement_of_a_mechanism_has_a_power_of_ten(at):
    for mechanism in catalogue().values():
        space = ParameterSpace(mechanism.parameters)
        values = dict(zip(space.names, space.from_unit(np.full(space.dim, at)), strict=True))
        said = mechanism.statement({**values, "E_c": 6e4, "E_s": 2e4})
        small = [v for v in values.values() if 0 < abs(v) < 1e-9]  # a leakage near zero may have one
        assert small or not re.search(r"\de[+-]?\d|× 10", said), said


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "< 0.001"), (0.001, "0.001"), (0.18, "0.18"), (0.9876, "0.988"), (1.0, "> 0.999")],
)
def test_a_probability_is_never_rounded_to_certainty(value: float, text: str) -> None:
    assert probability(value) == text
