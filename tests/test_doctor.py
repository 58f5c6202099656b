"""Tests of `bayeskin doctor`: it passes a sound installation, and names each broken part."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import namedtuple
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from toys.command_line import Command, assert_refused

import bayeskin as package
from bayeskin import cli, shipped
from bayeskin.errors import InputError
from bayeskin.execution.local import Lost
from bayeskin.workflow import doctor, doctor_models, remedies
from bayeskin.workflow.engine import Silent

MODELS = ["reduced model", "full model", "posterior", "surrogate"]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves out the runs of the models."""
    monkeypatch.setattr(doctor, "findings_of_models", lambda reporter: [])


def broken(said: dict[str, Any]) -> dict[str, str]:
    return {finding["name"]: finding["state"] for finding in said["findings"] if not finding["ok"]}


def remedies_of(said: dict[str, Any]) -> dict[str, str]:
    return {finding["name"]: finding["remedy"] for finding in said["findings"] if not finding["ok"]}


def test_the_models_give_the_stored_numbers_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(metadata, "requires", lambda name: ["numpy>=2.0"])
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert broken(said) == {}
    assert (said["ok"], end.value.code) == (True, 0)
    names = [finding["name"] for finding in said["findings"]]
    expected = ["numpy", "linear solver", "threads", "disk space", "write access", *MODELS]
    assert [name for name in names if name in expected] == expected
    assert list(tmp_path.iterdir()) == []


NUMBERS = ["REDUCED_MODEL_N", "FULL_MODEL_N", "POSTERIOR_NATS", "SURROGATE_N"]


@pytest.mark.parametrize(("number", "name"), list(zip(NUMBERS, MODELS, strict=True)), ids=str)
def test_a_model_that_gives_another_number_is_broken(
    monkeypatch: pytest.MonkeyPatch, number: str, name: str
) -> None:
    monkeypatch.setattr(doctor_models, number, 1.01 * getattr(doctor_models, number))
    finding = doctor_models.CHECKS[name]()
    assert (finding.name, finding.ok) == (name, False)
    assert "within" in finding.needed
    assert finding.remedy == f"{remedies.compile_anew()}; if this does not help: {remedies.reinstall()}"


USES = """
import numpy as np
from numba.core import event
from toys.inference_problems import toy_problem
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion
from bayeskin.workflow.doctor_models import THETA
from bayeskin.workflow.reducing import SHIPPED

class Compiled(event.Listener):
    def on_start(self, told):
        name = getattr(told.data["dispatcher"], "__module__", "")
        if name.startswith("bayeskin"):
            print(name, told.data["dispatcher"].__name__)
    def on_end(self, told): pass

event.register("numba:compile", Compiled())
problem = toy_problem()
problem.log_prob(np.random.default_rng(1).uniform(*problem.bounds, (3, problem.dim)))
solid = catalogue()["solid-viscoelasticity"]
values = THETA | solid.neutral
pulled = PadMotion(np.array([0.0, 2.0, 4.0]), np.array([0.0, 3e-3, 0.0]))
model = load_reduced(shipped(SHIPPED))
run = simulate_reduced(model, pulled, values, [solid], {"E_s": 1e4}, estimate=True)
print("ended", run.status)
"""


@pytest.mark.slow  # compiles
def test_after_it_inference_and_reduced_runs_compile_nothing(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", "from bayeskin.cli import main; main(['doctor'])"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    used = subprocess.run(
        [sys.executable, "-c", USES], env=environment, check=True, capture_output=True, text=True
    )
    assert used.stdout.split("\n") == ["ended ok", ""]


@pytest.mark.usefixtures("quick")
def test_a_package_that_is_absent_or_too_old_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["numpy>=99", "no-such-package>=1.2", "scipy>=1", "no-such-wheel>=1; platform_machine == 'arm'"]
    monkeypatch.setattr(metadata, "requires", lambda name: asked)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor"])
    shown = capsys.readouterr().out
    assert end.value.code == 1
    assert "BROKEN  numpy" in shown
    assert f"needed: >=99; remedy: {sys.executable} -m pip install 'numpy>=99'" in shown
    assert "BROKEN  no-such-package: not installed" in shown
    assert f"{sys.executable} -m pip install 'no-such-package>=1.2'" in shown
    assert "ok      scipy" in shown
    assert "no-such-wheel" not in shown  # needed elsewhere only
    assert shown.splitlines()[-1] == "something is broken"


@pytest.mark.parametrize("package", ["click", "rich"])
def test_without_a_package_of_the_command_line_one_line_names_the_command(package: str) -> None:
    script = f"import sys; sys.modules[{package!r}] = None; from bayeskin.cli import main"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    command = f"{sys.executable} -m pip install {package}"
    assert done.returncode == 1
    assert done.stderr == f"bayeskin: the package {package} is not installed; run `{command}`\n"


def test_a_folder_that_was_removed_is_one_line(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    before = Path.cwd()
    os.chdir(tmp_path / "gone")
    try:
        (tmp_path / "gone").rmdir()
        assert_refused(
            bayeskin("doctor"), "current folder: it does not exist any more; change to another: cd ~"
        )
    finally:
        os.chdir(before)


@pytest.mark.usefixtures("quick")
def test_a_part_that_cannot_be_imported_is_a_finding_and_no_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "requires", lambda name: [])
    monkeypatch.setitem(sys.modules, "bayeskin.finite_element", None)
    said = doctor.examine(tmp_path, Silent())
    assert list(broken(said)) == ["linear solver"]
    assert "ModuleNotFoundError" in broken(said)["linear solver"]
    assert remedies_of(said) == {"linear solver": remedies.reinstall()}


@pytest.mark.usefixtures("quick")
def test_a_folder_without_room_or_access_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "requires", lambda name: [])
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10, 9, 12_000_000))

    def denied(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", denied)
    said = doctor.examine(tmp_path, Silent())
    assert broken(said) == {
        "disk space": "0.0 GB free",
        "write access": f"{tmp_path}: permission denied",
    }
    assert remedies_of(said) == {
        "disk space": f"remove files from the disk of {tmp_path}, or work in a folder on another disk",
        "write access": "work in a folder of your own: cd ~",
    }


def test_bayeskin_is_installed_anew_from_where_it_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkout = Path(package.__file__).parent.parent
    pip = f"{sys.executable} -m pip install --force-reinstall"
    assert remedies.reinstall() == f"{pip} --editable {checkout}"
    (tmp_path / "a b.whl").touch()
    url = json.dumps({"url": (tmp_path / "a b.whl").as_uri()})
    monkeypatch.setattr(remedies, "PACKAGE", tmp_path / "bayeskin")
    monkeypatch.setattr(metadata, "distribution", lambda name: SimpleNamespace(read_text=lambda file: url))
    assert remedies.reinstall() == f"{pip} '{tmp_path}/a b.whl'"
    (tmp_path / "a b.whl").unlink()
    assert remedies.reinstall() == f"{pip} {remedies.WHERE_FROM}"


def test_a_shipped_file_that_is_absent_or_damaged_is_brought_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*arguments: str) -> None:
        own = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        subprocess.run(["git", *own, *arguments], cwd=tmp_path, check=True, capture_output=True)

    def there(name: str) -> Path:
        if not (tmp_path / name).is_file():
            raise InputError(name, "it is absent", "bring it back")
        return tmp_path / name

    file = tmp_path / "surrogates" / "demo.h5"
    file.parent.mkdir()
    shutil.copy(shipped.shipped("surrogates/demo.h5"), file)
    git("init")
    git("add", ".")
    git("commit", "-m", "files")
    monkeypatch.setattr(remedies, "PACKAGE", tmp_path / "bayeskin")
    monkeypatch.setattr(shipped, "shipped", there)
    for harm in (Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:999])):
        harm(file)
        finding = doctor_models.finding_of("surrogate", doctor_models.surrogate_finding)
        assert (finding.ok, "surrogates/demo.h5" in finding.state) == (False, True)
        subprocess.run(finding.remedy, shell=True, check=True)
        assert doctor_models.finding_of("surrogate", doctor_models.surrogate_finding).ok


DAMAGED = """
import sys
import numba
from bayeskin.workflow.doctor_models import Finding, finding_of
sys.path.insert(0, ".")
from compiled import double
finding = finding_of("model", lambda: Finding("model", double(2.0) == 4.0, "runs"))
print(finding.ok, finding.remedy)
"""


def test_code_that_was_compiled_wrongly_or_is_damaged_is_mended_by_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "compiled.py").write_text(
        "import numba\n\n\n@numba.njit(cache=True)\ndef double(x):\n    return 2.0 * x\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "a cache")}

    def examined() -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", DAMAGED], env=environment, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip().split(" ", 1)

    assert examined() == ["True"]
    (index,) = (tmp_path / "a cache").rglob("*.nbi")
    index.write_bytes(b"damaged")
    ok, remedy = examined()
    assert ok == "False"
    subprocess.run(remedy.split("; ")[0], shell=True, check=True)
    assert examined() == ["True"]


@pytest.mark.usefixtures("quick")
def test_processes_that_do_not_begin_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> object:
        raise InputError("workers", "they die before they are ready", "check the memory")

    monkeypatch.setattr("bayeskin.execution.local.run_parallel", refused)
    (finding,) = doctor_models.findings_of_models(Silent())
    assert (finding.name, finding.ok) == ("models", False)
    assert finding.state == "workers: they die before they are ready"
    monkeypatch.setattr(
        "bayeskin.execution.local.run_parallel", lambda *_: iter([(0, Lost("its process was killed"))])
    )
    (finding,) = doctor_models.findings_of_models(Silent())
    assert (finding.ok, finding.remedy) == (False, doctor_models.MEMORY)


@pytest.mark.parametrize(
    ("version", "limits", "holds"),
    [
        ("0.23.4", "<1,>=0.20", True), ("1.0", "<1,>=0.20", False), ("0.9", ">=0.20", False),
        ("2.10.0", ">=2.9", True), ("2.0.0+local.7", ">=2.0", True), ("3.0", "", True),
        ("1.0.0", ">=1.0", True), ("1", ">=1.0", True), ("1.0", "<1", False),
    ],
)  # fmt: skip
def test_versions_are_compared_by_their_numbers(version: str, limits: str, holds: bool) -> None:
    assert doctor.within(version, limits) is holds
