"""Seals of the proof: a changed key shows, and no diagnosis can open a key."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from toys.quick_proof import COUNT, nothing_found
from toys.worker_functions import opens

import bayeskin
from bayeskin.errors import InputError
from bayeskin.execution.local import run_parallel
from bayeskin.proof import closed, seals
from bayeskin.workflow import proof as pipeline
from bayeskin.workflow.engine import Silent

PACKAGE = Path(bayeskin.__file__).parent


def test_a_key_or_a_recording_that_was_changed_shows(concealed_set: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    path = copy / "seals" / "002.json"
    path.write_text(path.read_text().replace('"floor_n"', '"floor_N"'))
    with pytest.raises(InputError, match=r"002\.json: its contents differ"):
        seals.read_keys(copy)


def test_while_it_is_diagnosed_no_key_can_be_opened(concealed_set: Path, tmp_path: Path) -> None:
    def peeks(sources: list[Path], reporter) -> dict:
        assert sources[0].parent != concealed_set / "recordings"
        with pytest.raises(PermissionError):
            (concealed_set / "seals" / "001.json").read_text()
        with pytest.raises(PermissionError):
            os.listdir(concealed_set / "seals")
        return nothing_found(sources, reporter)

    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    with closed(concealed_set):
        document = pipeline.prove(copy, Silent(), diagnose=peeks)
    assert document["scoreboard"]["judged"] == COUNT
    assert len(seals.read_keys(concealed_set)) == COUNT


def test_nor_by_a_worker_that_is_started_meanwhile(concealed_set: Path, tmp_path: Path) -> None:
    concealed_set = Path(shutil.copytree(concealed_set, tmp_path / "set:1, odd"))
    key_path = str(concealed_set / "seals" / "001.json")
    with closed(concealed_set):
        assert dict(run_parallel(opens, [key_path, str(concealed_set / "index.json")], 1)) == {
            0: False,
            1: True,
        }
    assert dict(run_parallel(opens, [key_path], 1)) == {0: True}


def test_a_diagnosis_in_a_process_that_refuses_the_seals_goes_through(concealed_set: Path) -> None:
    """The diagnosing code is loaded, and a recording read and binned, where no path under seals/ opens."""
    recording = seals.recording_path(concealed_set, "001")
    script = (
        "import sys\n"
        "def refuse(event, arguments):\n"
        "    if event == 'open' and '/seals/' in str(arguments[0]):\n"
        "        raise PermissionError(arguments[0])\n"
        "sys.addaudithook(refuse)\n"
        "from pathlib import Path\n"
        "from bayeskin.workflow import diagnosing\n"
        "from bayeskin.recordings import read_recording, segment\n"
        f"assert len(segment(read_recording(Path({str(recording)!r})))) == 14\n"
        "assert not [name for name in sys.modules if name.startswith('bayeskin.proof')]\n"
        f"open({str(concealed_set / 'seals' / '001.json')!r})\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr.strip().splitlines()[-1].startswith("PermissionError")


def test_what_diagnoses_mentions_neither_proof_nor_seals() -> None:
    for path in [*(PACKAGE / "mismatch").rglob("*.py"), *(PACKAGE / "workflow").glob("diagnos*.py")]:
        tree = ast.parse(path.read_text())
        words = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        words |= {
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        assert not [word for word in words if word in ("proof", "seals") or "data/proof" in word], path
