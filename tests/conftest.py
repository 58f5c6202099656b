"""Fixtures that several files of tests share."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import pytest

from bayeskin import cli

if TYPE_CHECKING:
    from toys.browser import Browser

pytest.register_assert_rewrite("toys")


@pytest.fixture(scope="session")
def concealed_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a set of the proof, made once; a test that changes it makes a copy."""
    from toys.quick_proof import conceal_quickly

    folder = tmp_path_factory.mktemp("set")
    conceal_quickly(folder)
    return folder


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Imports a module of benchmarks/ by its name."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module


@pytest.fixture
def bayeskin(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command; gives exit code, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


@pytest.fixture(scope="session")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path of a sound recording as CSV."""
    from toys.command_line import measured_csv

    return measured_csv(tmp_path_factory.mktemp("measured") / "measured.csv")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser without a window, in which a test opens pages."""
    from toys.browser import opened_browser

    with opened_browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser
