"""Numba keeps compiled code elsewhere if neither the package nor the user's home can be written."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from bayeskin.compiled_code import VARIABLE, keep_compiled_code


@pytest.fixture(autouse=True)
def usual_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba chooses its folder itself, and is not told of the folders of these tests."""
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.delitem(sys.modules, "numba", raising=False)


@pytest.fixture
def no_folder(tmp_path: Path) -> Path:
    """A path at which not even root can make a folder, since a file lies above it."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "folder"


def test_a_usual_folder_is_left_to_numba(tmp_path: Path, no_folder: Path) -> None:
    assert keep_compiled_code(tmp_path, no_folder, tmp_path) is None
    assert keep_compiled_code(no_folder, tmp_path, tmp_path) is None
    assert os.environ[VARIABLE] == ""


def test_a_folder_that_the_user_states_is_used(
    tmp_path: Path, no_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert keep_compiled_code(no_folder, no_folder, tmp_path) is None


def test_all_processes_of_a_user_share_one_folder(tmp_path: Path, no_folder: Path) -> None:
    first = keep_compiled_code(no_folder, no_folder, tmp_path)
    assert first is not None
    assert os.environ[VARIABLE] == str(first)
    assert stat.S_IMODE(first.stat().st_mode) == 0o700
    os.environ[VARIABLE] = ""
    assert keep_compiled_code(no_folder, no_folder, tmp_path) == first


@pytest.mark.parametrize("planted", ["open to all", "a link"])
def test_a_folder_that_others_may_have_made_is_not_used(
    tmp_path: Path, no_folder: Path, planted: str
) -> None:
    theirs = tmp_path / f"bayeskin-compiled-{os.getuid()}"
    if planted == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        theirs.symlink_to(tmp_path / "elsewhere")
    else:
        theirs.mkdir()
        theirs.chmod(0o777)
    folder = keep_compiled_code(no_folder, no_folder, tmp_path)
    assert folder is not None
    assert folder != theirs
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_one_line_says_where_compiled_code_goes(tmp_path: Path, no_folder: Path) -> None:
    """The package is imported as if it lay where nothing can be written."""
    program = (
        "import pathlib, bayeskin.compiled_code as c, os, importlib, bayeskin; "
        f"c._is_writable = lambda folder: False; os.environ['{VARIABLE}'] = ''; importlib.reload(bayeskin); "
        "import bayeskin.finite_element.space"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, check=False, env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert f"compiled code is kept in {tmp_path}" in line
