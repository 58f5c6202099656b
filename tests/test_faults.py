"""Disks that are full, folders read-only or taken, files of another origin: one line, and nothing lost.

What is done to the bytes of files stands in test_fuzz.py; kill -9 at random times in benchmarks/kills.py.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from toys import fuzzed_files
from toys.closed_form_model import MOTION
from toys.external_models import PARAMETERS, SPRING, TRUE, spring
from toys.full_disk import files_at_most

from bayeskin import storage
from bayeskin.design_files import load_design
from bayeskin.errors import InputError
from bayeskin.types import Recording
from bayeskin.workflow.folder import read_record

ROOT = Path(__file__).parents[1]
MAIN = "from bayeskin.cli import main; main()"
CONFIG = """
[recording]
file = "measured.h5"
[model]
forward = "spring.py:force"
[fit]
bin_width_s = 1.0
[design]
points = [24]
held_out = 6
workers = 1
"""


@pytest.fixture
def case() -> Iterator[Path]:
    """A configuration of a small model of its own, in a folder that anybody may enter."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    time_s = np.arange(0.0, 130.001, 0.1)
    pulled = MOTION.at(time_s)
    force_n = spring()(TRUE, time_s, pulled) + 2e-3 * np.random.default_rng(5).standard_normal(len(time_s))
    storage.save(folder / "measured.h5", Recording(time_s, pulled, force_n, "spring", "0" * 64))
    (folder / "spring.py").write_text(SPRING)
    (folder / "case.toml").write_text(CONFIG + PARAMETERS)
    yield folder / "case.toml"
    shutil.rmtree(folder)


Command = Callable[..., tuple[int, str, str]]


def refused(answer: tuple[int, str, str], says: str) -> None:
    code, _, err = answer
    assert code == 2, err
    assert "Traceback" not in err
    assert [line for line in err.splitlines() if line.startswith("bayeskin: ")] == [err.splitlines()[-1]]
    assert says in err.splitlines()[-1]


@pytest.mark.parametrize("size", [0, 1000, 10_000])
def test_a_full_disk_is_told_and_leaves_the_earlier_file(case: Path, size: int, bayeskin: Command) -> None:
    out = case.parent / "out.h5"
    out.write_bytes(b"what was there before")
    with files_at_most(size):
        answer = bayeskin("import", case.parent / "measured.h5", "-o", out)
    refused(answer, "")
    assert out.read_bytes() == b"what was there before"
    assert sorted(p.name for p in case.parent.iterdir()) == [
        "case.toml",
        "measured.h5",
        "out.h5",
        "spring.py",
    ]


def test_a_real_disk_that_is_full_is_told(case: Path, bayeskin: Command) -> None:
    disk = case.parent / "disk"
    disk.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mounted, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a small disk")
    try:
        for name in ("case.toml", "spring.py"):
            shutil.copy(case.parent / name, disk)
        (disk / "measured.h5").symlink_to(case.parent / "measured.h5")
        refused(bayeskin("design", disk / "case.toml"), "no space left on device")
        refused(bayeskin("import", disk / "measured.h5", "-o", disk / "again.h5"), "")
        assert not (disk / "again.h5").exists()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def told_of_a_full_disk(kind: str, folder: Path, room: AbstractContextManager[None]) -> None:
    """Writes a kind of file where there is no room for it."""
    make = fuzzed_files.HDF5[kind][0]
    with tempfile.TemporaryDirectory() as elsewhere:
        make(Path(elsewhere) / kind)  # what is compiled on the way has files of its own
    path = folder / kind
    path.write_bytes(b"what was there before")
    with room, pytest.raises(InputError, match=f"^cannot write .*{kind}: "):
        make(path)
    assert path.read_bytes() == b"what was there before"
    assert [file.name for file in folder.iterdir()] == [kind]


@pytest.mark.parametrize("size", [0, 1000])
@pytest.mark.parametrize("kind", ["surrogate.h5", "chain.h5"])
def test_a_full_disk_under_surrogates_and_chains_is_told(kind: str, size: int, tmp_path: Path) -> None:
    told_of_a_full_disk(kind, tmp_path, files_at_most(size))


@pytest.mark.parametrize("kind", ["surrogate.h5", "chain.h5", "posterior.nc"])
def test_a_real_disk_that_is_full_under_what_a_run_writes_is_told(kind: str, tmp_path: Path) -> None:
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8k", "tmpfs", str(tmp_path)], capture_output=True, check=False
    ).returncode:
        pytest.skip("no right to mount a small disk")
    try:
        told_of_a_full_disk(kind, tmp_path, nullcontext())
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def without_a_superusers_rights() -> None:
    """Nobody's rights go beyond a file's mode: PR_CAPBSET_DROP of CAP_DAC_OVERRIDE, which exec then lacks."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


def test_a_read_only_folder_is_told(case: Path) -> None:
    case.parent.chmod(0o555)
    measured, out = str(case.parent / "measured.h5"), str(case.parent / "out")
    commands = [
        ["design", str(case)],
        ["import", measured, "-o", f"{out}.h5"],
        ["new", measured, "-o", f"{out}.toml"],
    ]
    code = (
        "from bayeskin.cli import main\n"
        f"for command in {commands!r}:\n"
        "    try:\n        main(command)\n"
        "    except SystemExit as end:\n        print(end.code)"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            preexec_fn=without_a_superusers_rights,
        )  # fmt: skip
        assert done.stdout.split() == ["2", "2", "2"]
        assert "Traceback" not in done.stderr
        told = [line for line in done.stderr.splitlines() if line.startswith("bayeskin: ")]
        assert ["permission denied" in line for line in told] == [True, True, True]
        assert sorted(p.name for p in case.parent.iterdir()) == ["case.toml", "measured.h5", "spring.py"]
    finally:
        case.parent.chmod(0o755)


def test_a_folder_that_is_not_the_runs_own_is_left_as_it_is(case: Path, bayeskin: Command) -> None:
    """A run is named after its configuration: somebody may keep recordings in a folder of that name."""
    lab_book = case.parent / "case" / "recording" / "lab-book.txt"
    lab_book.parent.mkdir(parents=True)
    lab_book.write_text("measured on Monday")
    refused(bayeskin("design", case), "case/recording: it contains other files, such as lab-book.txt")
    assert lab_book.read_text() == "measured on Monday"


def test_a_link_to_another_place_is_not_written_through(case: Path, bayeskin: Command) -> None:
    other = case.parent / "other"
    other.mkdir()
    (case.parent / "case").mkdir()
    (case.parent / "case" / "recording").symlink_to(other, target_is_directory=True)
    refused(bayeskin("design", case), "case/recording: it is a link to another place")
    assert not list(other.iterdir())


@pytest.mark.parametrize(
    "record", ["[]", '{"inputs_sha256": 1, "done": "yes", "seconds": []}',
               '{"inputs_sha256": "", "done": true, "seconds": 1, "outputs": [], "summary": 3}'],
)  # fmt: skip
def test_a_record_of_other_contents_is_none(tmp_path: Path, record: str) -> None:
    (tmp_path / "stage.json").write_text(record)
    assert read_record(tmp_path) is None


def test_a_second_run_on_a_folder_is_refused_and_the_first_goes_on(case: Path, bayeskin: Command) -> None:
    go = case.parent / "go"
    waiting = f"    while not os.path.exists({str(go)!r}):\n        time.sleep(0.05)\n    pull ="
    (case.parent / "spring.py").write_text("import os\nimport time\n" + SPRING.replace("    pull =", waiting))
    first = subprocess.Popen([sys.executable, "-c", MAIN, "design", str(case)], stderr=subprocess.DEVNULL)
    lock = case.parent / "case" / ".lock"
    while not lock.is_file() or lock.read_text() != str(first.pid):
        assert first.poll() is None
        time.sleep(0.05)
    refused(bayeskin("train", case), f"another bayeskin (process {first.pid}) uses this folder")
    go.touch()
    assert first.wait() == 0
    assert len(load_design(case.parent / "case/design/design.h5").theta) == 30


def altered_surrogate(path: Path) -> None:
    with h5py.File(path, "r+") as handle:
        handle["edges_s"][3] += 1e-9


def later_format(path: Path) -> None:
    with h5py.File(path, "r+") as handle:
        handle.attrs["format_version"] = 99


def of_somebody_else(path: Path) -> None:
    with h5py.File(path, "w") as handle:
        handle["x"] = np.arange(3)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (altered_surrogate, "its contents differ from their stored hash"),
        (later_format, "format is 99"),
        (of_somebody_else, "another origin"),
        (cut, "cannot be read as HDF5"),
        (lambda path: path.write_bytes(b""), "cannot be read as HDF5"),
    ],
    ids=["altered", "later", "foreign", "cut", "empty"],
)
def test_a_surrogate_that_is_not_what_it_was_is_refused(
    tmp_path: Path, fault: Callable[[Path], None], says: str, bayeskin: Command
) -> None:
    for file in ("surrogates/demo.h5", "surrogates/demo-design.h5", "data/demo.h5"):
        shutil.copy(ROOT / file, tmp_path / Path(file).name.replace("demo", "mine"))
    shutil.copy(ROOT / "data/demo.h5", tmp_path / "measured.h5")
    shutil.copy(ROOT / "surrogates/demo.h5", tmp_path / "mine.h5")
    fault(tmp_path / "mine.h5")
    config = '[recording]\nfile = "measured.h5"\n[surrogate]\nfile = "mine.h5"\n'
    (tmp_path / "case.toml").write_text(config)
    refused(bayeskin("train", tmp_path / "case.toml"), says)


def test_a_surrogate_of_another_model_is_refused(tmp_path: Path, bayeskin: Command) -> None:
    shutil.copy(ROOT / "data/demo.h5", tmp_path / "measured.h5")
    config = '[recording]\nfile = "measured.h5"\n[model]\nrefinement = 2\n[surrogate]\nfile = "demo.h5"\n'
    (tmp_path / "case.toml").write_text(config)
    refused(bayeskin("train", tmp_path / "case.toml"), "it belongs to another model")


@pytest.mark.parametrize(
    "counts",
    [(20_000, 80_000), pytest.param((100_000, 10_000_000), marks=pytest.mark.slow)],
    ids=["80 thousand", "ten million"],
)
def test_memory_grows_by_at_most_200_bytes_a_sample(tmp_path: Path, counts: tuple[int, int]) -> None:
    paths = [tmp_path / f"{count}.csv" for count in counts]
    for count, path in zip(counts, paths, strict=True):
        time_s = np.linspace(0.0, 130.0, count)
        noise_n = 2e-3 * np.random.default_rng(1).standard_normal(count)
        force_n = spring()(TRUE, time_s, MOTION.at(time_s)) + noise_n
        table = np.column_stack([time_s, 1e3 * MOTION.at(time_s), force_n])
        np.savetxt(
            path, table, delimiter=",", fmt="%.6f", comments="", header="time (s),displacement (mm),force (N)"
        )
    code = (
        "import resource, sys; from pathlib import Path; from bayeskin.recordings import read_recording\n"
        "for path in sys.argv[1:]:\n"
        "    read_recording(Path(path))\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code, *paths], capture_output=True, text=True, check=True)
    peaks = [1024 * int(peak) for peak in done.stdout.split()]
    assert (peaks[1] - peaks[0]) / (counts[1] - counts[0]) < 200.0


@pytest.mark.slow
def test_kills_lose_nothing_and_change_nothing(tmp_path: Path, benchmark: Callable[[str], Any]) -> None:
    rows = list(benchmark("kills").study(tmp_path, 14, 1))
    assert sum(row.kills for row in rows) >= 50
    assert [row.lost for row in rows] == [()] * 4
    assert all(row.same for row in rows)


def test_one_kill_of_a_design_loses_nothing_and_is_seen_by_the_study(
    case: Path, benchmark: Callable[[str], Any], bayeskin: Command
) -> None:
    kills = benchmark("kills")
    process = subprocess.Popen([sys.executable, "-c", MAIN, "design", str(case)], stderr=subprocess.DEVNULL)
    while len(kills.finished_items(case.parent)["result"]) < 3:
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    had = kills.finished_items(case.parent)["result"]
    assert bayeskin("design", case)[0] == 0
    now = kills.finished_items(case.parent)
    assert had <= now["result"]
    assert now["stage"] == {"recording", "design"}
    assert len(now["result"]) == 31
    record = read_record(case.parent / "case/design")
    assert record is not None
