"""Tests of dataclasses read from a file: their fields hold the types that the annotations state."""

import dataclasses
from typing import Any, TypeVar

import numpy as np
import pytest
from typing_extensions import TypeAliasType

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.types import Recording

Scalar = TypeVar("Scalar", bound=np.generic)
# Of this form is numpy's own NDArray from Python 3.12 on.
Named = TypeAliasType("Named", np.ndarray[Any, np.dtype[Scalar]], type_params=(Scalar,))


@dataclasses.dataclass
class Held:
    numbers: Named[np.float64]


def test_arrays_by_the_name_of_an_alias_are_what_the_alias_stands_for() -> None:
    held = Held(np.arange(3.0))
    assert storage.checked(held, "file.h5") is held
    for wrong in (np.array([1j]), [1.0, 2.0], "text"):
        with pytest.raises(InputError, match=r"file\.h5: numbers"):
            storage.checked(Held(wrong), "file.h5")  # type: ignore[arg-type]


def test_numbers_of_another_kind_are_no_recording() -> None:
    times = np.arange(3.0)
    wrong = Recording(times, times, times, "text", "0" * 64)
    object.__setattr__(wrong, "force_n", np.array([b"a", b"b", b"c"]))
    with pytest.raises(InputError, match="force_n"):
        storage.checked(wrong, "file.h5")
