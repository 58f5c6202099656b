"""The documentation does what it says: its blocks run, in order, and the site builds without a warning."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

from bayeskin.cli import cli
from bayeskin.config import Config

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
RUN_HERE = [page for page in PAGES if page.name != "scripting.md"]  # which test_scripting.py runs
FENCE = re.compile(r"(?:<!-- (slow|not run): [^>]*-->\n)?^```(python|sh|toml)\n(.*?)^```$", re.S | re.M)
COMMAND = "import sys; from bayeskin.cli import main; main(sys.argv[1:])"


class Block(NamedTuple):
    """One fenced block: when it is run ("", "slow" or "not run"), its language, its text."""

    when: str
    language: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*parts) for parts in FENCE.findall(page.read_text(encoding="utf-8"))]


def run_page(page: Path, folder: Path, slow: bool, monkeypatch: pytest.MonkeyPatch) -> int:
    """Runs a page's blocks in a folder with the demo in it; returns how many."""
    for name in ("data/demo.h5", "runs/demo.toml"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    shim = folder / "bin" / "bayeskin"
    shim.parent.mkdir()
    shim.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{COMMAND}' \"$@\"\n")
    shim.chmod(0o755)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PATH", str(shim.parent), prepend=":")
    monkeypatch.setattr(sys, "path", list(sys.path))
    names: dict[str, object] = {"__name__": "page"}
    wanted = [block for block in blocks(page) if block.when == "" or (slow and block.when == "slow")]
    for block in wanted:
        if block.language == "python":
            exec(compile(block.text, str(page), "exec"), names)
        elif block.language == "sh":
            command = ["bash", "-euo", "pipefail", "-c", block.text]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{block.text}\n{done.stderr[-2000:]}"
        else:
            checked_toml(block.text)
    return len(wanted)


def checked_toml(text: str) -> None:
    """A fragment of a configuration is one, with a recording added; of a package's it is TOML.

    The file of a study has a table in place of the recording.
    """
    plain = tomllib.loads(text)
    plain.pop("table", None)
    if "project" not in plain:
        recording = {} if "recordings" in plain else {"recording": {"file": "x.h5"}}
        Config.model_validate_json(json.dumps({"name": "x", **recording, **plain}))


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", [p for p in RUN_HERE if any(not b.when for b in blocks(p))], ids=named)
def test_the_blocks_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_page(page, tmp_path, False, monkeypatch) > 0


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in RUN_HERE if any(b.when == "slow" for b in blocks(p))], ids=named)
def test_all_blocks_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_page(page, tmp_path, True, monkeypatch) > 0


def test_every_fence_with_a_language_is_seen() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert len(blocks(page)) == len(re.findall(r"^```(?:python|sh|toml)", text, re.M)), page
    assert len([b for p in PAGES for b in blocks(p)]) > 20


def test_each_row_of_a_table_has_its_own_line() -> None:
    for page in PAGES:
        for line in page.read_text(encoding="utf-8").splitlines():
            if " --- |" in line:
                assert set(line) <= set("|- "), (page, line)


def test_every_command_that_the_pages_name_exists() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        shell = "\n".join(block.text for block in blocks(page) if block.language == "sh")
        commands = re.findall(r"(?:^    |`)(?:\.venv/bin/)?bayeskin ([a-z]+)\b", text, re.M)
        commands += re.findall(r"\bbayeskin ([a-z]+)\b", shell)
        assert set(commands) <= set(cli.commands), page
    assert set(cli.commands) <= set(re.findall(r"`bayeskin ([a-z]+)", (ROOT / "README.md").read_text()))


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "docs",
        str(tmp_path),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    reference = (tmp_path / "reference.html").read_text()
    for name in ("finite_element.simulate.simulate", "runner.run_design", "types.Design"):
        assert f'id="bayeskin.{name}"' in reference
    assert "bayeskin serve [OPTIONS] [CONFIG]" in (tmp_path / "commands.html").read_text()
