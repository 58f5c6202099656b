"""Tests of dataclasses read from a file: their fields hold the types that the annotations state."""

import dataclasses
import importlib
import pkgutil
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from typing_extensions import TypeAliasType

import bayeskin.types
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


# These names stand in files that have been written.
STORED = {
    "BinnedForce", "Design", "Jumps", "Markers", "PadMotion", "Parameter", "ParameterSpace", "Phase",
    "Prediction", "Provenance", "Recording", "Simulation",
}  # fmt: skip


def test_each_dataclass_of_the_types_is_exchanged_under_the_name_that_files_have() -> None:
    modules = [f"bayeskin.types.{module.name}" for module in pkgutil.iter_modules(bayeskin.types.__path__)]
    defined = {
        name: cls
        for module in map(importlib.import_module, modules)
        for name, cls in vars(module).items()
        if isinstance(cls, type) and dataclasses.is_dataclass(cls)
    }
    assert set(defined) == STORED
    assert {name: vars(bayeskin.types).get(name) for name in defined} == defined


def test_a_dataclass_within_another_is_read_back(tmp_path: Path) -> None:
    phases = (bayeskin.types.Phase("rest", 0, 0.0, 1.0), bayeskin.types.Phase("load", 1, 1.0, 2.0))
    edges, zeros = np.arange(3.0), np.zeros(2)
    binned = bayeskin.types.BinnedForce(edges, zeros, zeros, np.zeros(1), np.array([0, 1]), phases)
    storage.save(tmp_path / "binned.h5", binned)
    assert storage.load(tmp_path / "binned.h5", bayeskin.types.BinnedForce).phases == phases
