"""Every reader of somebody's files, given nonsense: an answer, or one line that says what is wrong.

Each example is a seed of `EACH` damaged copies of a sound file: bytes changed, cut out, doubled, swapped for
those of another format, or all random. The slow runs together take more than a hundred thousand.
"""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys.fuzzed_files import (
    HDF5,
    MODEL,
    READERS,
    REQUEST,
    ROOT,
    TOKENS,
    as_hdf5,
    as_text,
    as_workbook,
    refused,
)

from bayeskin import probe
from bayeskin.errors import InputError
from bayeskin.inference import inference_data, load_inference_data
from bayeskin.recordings import read_recording
from bayeskin.storage import contents_hash

EACH = 10
MOST_HDF5 = 400  # each takes a process
MANY = 170  # times the examples, in a slow run
GUIDED = 10_000  # inputs of each reader that coverage leads to, in a slow run
TIMES = pytest.mark.parametrize("times", [1, pytest.param(MANY, marks=pytest.mark.slow)])


def damaged(sound: bytes, rng: np.random.Generator, others: list[bytes]) -> bytes:
    """One damaged copy."""
    kind, data = rng.integers(8), bytearray(sound)
    at, long = int(rng.integers(len(data))), int(rng.integers(1, 40))
    if kind == 0:
        return bytes(data[:at])
    if kind == 1:
        return rng.bytes(int(rng.integers(300)))
    if kind == 2:
        other = others[int(rng.integers(len(others)))]
        return bytes(data[:at]) + other[int(rng.integers(len(other))) :]
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(len(data)))
        if kind in (3, 4):
            data[at : at + 1] = rng.bytes(1)
        elif kind == 5:
            data[at : at + long] = b""
        elif kind == 6:
            data[at:at] = data[at : at + long]
        else:
            data[at : at + long] = TOKENS[int(rng.integers(len(TOKENS)))]
        data = data or bytearray(b" ")
    return bytes(data)


@pytest.mark.filterwarnings("ignore")
@TIMES
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused_in_one_line(name: str, times: int, tmp_path: Path) -> None:
    read, make, examples = READERS[name]
    sound, others, path = (
        make(tmp_path),
        [b"PK\3\4", as_text(";"), b"{}", b"[a]\nb=1\n"],
        tmp_path / "in" / name,
    )
    path.parent.mkdir()
    path.write_bytes(sound)
    assert not refused(read, path), "the sound file itself is read"
    count = [0]

    @settings(max_examples=times * examples, deadline=None, database=None, derandomize=True)
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(EACH):
            path.write_bytes(damaged(sound, rng, others))
            count[0] += refused(read, path)

    run()
    assert count[0] or name in ("stage.json", "a.store", "request.json")  # these pass over what is torn


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_inputs_that_reach_new_code_are_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris is not installed (extra `fuzz`)")
    command = [sys.executable, str(ROOT / "tests/toys/coverage_fuzz.py"), name, str(GUIDED)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, f"Done {GUIDED}" in ended.stderr) == (0, True), ended.stdout[-3000:]


KEYS = st.sampled_from([*REQUEST, "time_s", "displacement_m"])
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(), lambda v: st.lists(v) | st.dictionaries(KEYS, v)
)


@pytest.mark.filterwarnings("ignore")
@TIMES
def test_a_request_of_any_shape_is_answered_or_refused(times: int) -> None:
    @settings(max_examples=20 * times, deadline=None, database=None, derandomize=True)
    @given(st.dictionaries(KEYS, ANYTHING))
    def run(config: dict[str, Any]) -> None:
        ended.add(refused(MODEL.output_sizes, config))

    ended = set[bool]()
    run()
    assert ended == {True, False}  # some are refused, and the empty one is none of these


@TIMES
@pytest.mark.parametrize("name", ["a.h5", "a.nc"])
def test_damaged_hdf5_neither_hangs_nor_ends_us(name: str, times: int, tmp_path: Path) -> None:
    read = read_recording if name == "a.h5" else load_inference_data
    sound, path, rng = as_hdf5(tmp_path), tmp_path / name, np.random.default_rng(7)
    count = 0
    for _ in range(min(4 * times, MOST_HDF5) if name == "a.h5" else 4):
        path.write_bytes(damaged(sound, rng, [sound]))
        count += refused(read, path)
    assert count


NONSENSE = [
    np.ones((2, 2)), np.zeros(0), np.arange(3), np.nan, -1, 2**62, True, "[" * 9999, "[]", "[1]", "{}",
    '{"a": [null]}', "text", b"\xff\xfe", "", h5py.Empty("f8"),
]  # fmt: skip


def alter(path: Path, rng: np.random.Generator) -> None:
    """Takes one part out of a sound HDF5 file, or puts nonsense in its place; hashes are mended."""
    with h5py.File(path, "r+") as handle:
        names: list[str] = ["/"]
        handle.visit(names.append)
        node = handle[names[int(rng.integers(len(names)))]]
        value = NONSENSE[int(rng.integers(len(NONSENSE)))]
        keys = [*node.attrs] if rng.integers(2) or node.name == "/" else []
        at = keys[int(rng.integers(len(keys)))] if keys else None
        parent, own = (node.attrs, at) if at else (node.parent, node.name)
        if node.name != "/" or at:
            del parent[own]
            if rng.integers(4):
                parent[own] = value
        with suppress(UnicodeEncodeError):  # of a text that is none
            handle.attrs["arrays_sha256"] = contents_hash(handle)


@pytest.mark.filterwarnings("ignore")
@TIMES
@pytest.mark.parametrize("name", HDF5)
def test_altered_contents_are_read_or_refused_in_one_line(
    name: str, times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, read, examples, _ = HDF5[name]
    make(tmp_path / name)
    read(tmp_path / name)
    sound, path, count = (tmp_path / name).read_bytes(), tmp_path / "in" / name, 0
    path.parent.mkdir()
    monkeypatch.setattr(inference_data, "refuse_damaged", lambda *_: None)  # written by a sound libhdf5
    for seed in range(times * examples):
        path.write_bytes(sound)
        alter(path, np.random.default_rng(seed))
        count += refused(read, path)
    assert count


@pytest.mark.filterwarnings("ignore")
@TIMES
@pytest.mark.parametrize("name", [name for name, (*_, examples) in HDF5.items() if examples])
def test_damaged_bytes_of_what_a_user_brings_do_not_end_us(name: str, times: int, tmp_path: Path) -> None:
    make, read, _, examples = HDF5[name]
    make(tmp_path / name)
    sound, path, rng = (tmp_path / name).read_bytes(), tmp_path / "in" / name, np.random.default_rng(8)
    path.parent.mkdir()
    told = 0
    for _ in range(min(times * examples, MOST_HDF5)):
        path.write_bytes(damaged(sound, rng, [sound]))
        told += refused(lambda path: probe.refuse_damaged(path, name), path) or refused(read, path)
    assert told


def test_the_file_that_libhdf5_reads_for_ever_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(as_hdf5(tmp_path))
    monkeypatch.setattr(probe, "READ_ALL", "import time; time.sleep(600)")
    monkeypatch.setattr(probe, "STARTS_S", 0.5)
    with pytest.raises(InputError, match=r"cannot be read as HDF5 \(reading it does not end\)"):
        read_recording(path)
    path.write_bytes(as_hdf5(tmp_path))
    os.utime(path, (1, 1))
    monkeypatch.setattr(probe, "READ_ALL", "import os; os.abort()")
    monkeypatch.setattr(probe, "STARTS_S", 60.0)
    with pytest.raises(InputError, match="reading it ends the process"):
        read_recording(path)


def test_an_hdf5_bomb_is_refused_before_it_takes_the_memory(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as handle:
        handle.attrs["format"] = "bayeskin"
        handle.create_dataset("time_s", shape=(2**32,), dtype="f8", compression="gzip", chunks=(2**20,))
    with pytest.raises(InputError, match=r"cannot be read as HDF5 \(.*Memory"):
        read_recording(tmp_path / "a.h5")


def test_a_workbook_that_unpacks_to_more_than_any_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.xlsx").write_bytes(as_workbook())
    with (
        zipfile.ZipFile(tmp_path / "a.xlsx", "a", zipfile.ZIP_DEFLATED) as book,
        book.open("xl/sharedStrings2.xml", "w", force_zip64=True) as part,
    ):
        for _ in range(1100):
            part.write(b" " * 2**20)
    assert (tmp_path / "a.xlsx").stat().st_size < 5e6
    with pytest.raises(InputError, match=r"1\.2e\+09 bytes when unpacked; .* at most 1\.1e\+09"):
        read_recording(tmp_path / "a.xlsx")
