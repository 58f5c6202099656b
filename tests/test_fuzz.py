"""Every reader of somebody's files, given nonsense: an answer, or one line that says what is wrong.

Each example is a seed of `EACH` damaged copies of a sound file: bytes changed, cut out, doubled, swapped for
those of another format, or all random. The slow runs together take more than a hundred thousand.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import arviz as az
import emcee
import h5py
import numpy as np
import openpyxl
import pytest
from gmsh_file import coarse_tetrahedra, gmsh_text
from hypothesis import given, settings
from hypothesis import strategies as st
from toy import EDGES_S, MOTION, SPACE, toy_bin_means, toy_force

from bayeskin import probe, storage
from bayeskin.config import load_config
from bayeskin.device import load_device
from bayeskin.errors import InputError
from bayeskin.external.umbridge import Refused, _understood
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import Geometry
from bayeskin.inference import chains, draws_of, inference_data, load_inference_data, save_inference_data
from bayeskin.journal import Journal, Run
from bayeskin.recordings import phase_noise, read_recording, segment
from bayeskin.runner import load_waves
from bayeskin.storage import contents_hash
from bayeskin.surrogates import load_manifest, manifest_of, save_surrogate, train
from bayeskin.types import Design, Recording
from bayeskin.workflow import folder
from bayeskin.workflow.serve import Asked, ServedModel

ROOT = Path(__file__).parents[1]
TOKENS = [
    b"nan",
    b"inf",
    b"-1e999",
    b"",
    b"\0",
    b"\xff\xfe",
    b"[",
    b"]]",
    b'"',
    b"{}",
    b"null",
    b"1e400",
    b"0x",
    b"\n\n",
]


def a_test() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time_s = np.arange(0.0, 130.0, 0.1)
    force_n = 1e-3 * toy_force(SPACE.from_unit(np.full((1, 5), 0.5)), time_s)[0]
    return time_s, MOTION.at(time_s), force_n + 1e-3 * np.random.default_rng(1).standard_normal(len(time_s))


def as_text(delimiter: str) -> bytes:
    out = io.StringIO()
    header = delimiter.join(["time (s)", "displacement (m)", "force (N)"])
    np.savetxt(out, np.column_stack(a_test()), delimiter=delimiter, header=header, comments="", fmt="%.6g")
    return out.getvalue().encode()


def as_workbook() -> bytes:
    book, out = openpyxl.Workbook(), io.BytesIO()
    book.active.append(["time (s)", "displacement (m)", "force (N)"])
    for row in zip(*(column.tolist() for column in a_test()), strict=True):
        book.active.append(row)
    book.save(out)
    return out.getvalue()


FLAT = Geometry(arm_radius_m=None)
DEVICE = b"[device]\nguard_mm = { gap = 1, width = 8 }\n[tissue]\ncutis_mm = { mean = 2, sd = 0.2 }\n"


def as_mesh() -> bytes:
    """Flat skin as gmsh writes it."""
    return gmsh_text(coarse_tetrahedra(FLAT)).encode()


def as_journal(tmp: Path) -> bytes:
    with Journal(tmp / "j", "same", 3) as journal:
        for n in range(4):
            journal.append(Run(np.full(5, float(n)), np.arange(3.0), n != 2, "why", 0.5))
        found = (tmp / "j").read_bytes()
    return found


def as_hdf5(tmp: Path) -> bytes:
    storage.save(tmp / "sound.h5", Recording(*a_test(), "toy", "0" * 64))
    return (tmp / "sound.h5").read_bytes()


def read_and_segment(path: Path) -> object:
    recording = read_recording(path)
    return phase_noise(recording, segment(recording))


def read_journal(path: Path) -> object:
    with Journal(path, "same", 3) as journal:
        return journal.runs


def read_stage(path: Path) -> object:
    record = folder.read_record(path.parent)
    return None if record is None else (record.sha256, folder.current_record(path.parent, "x"))


def read_answer(path: Path) -> object:
    try:
        return _understood("http://here", path.read_bytes())
    except Refused:
        return None


MODEL = ServedModel(ModelSpec(), SPACE.parameters, Asked(MOTION, np.arange(0.0, 131.0), None, ()))


def read_request(path: Path) -> object:
    try:
        config = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return None
    return MODEL.output_sizes(config) if isinstance(config, dict) else None


REQUEST = {
    "protocol": {"time_s": [0, 1.5, 3], "displacement_m": [0, 1e-3, 0]},
    "edges_s": [0, 1, 2, 3], "times_s": [0.5, 1.0], "mechanisms": ["force-offset", "backlash"],
}  # fmt: skip
STAGE = {
    "inputs_sha256": "x",
    "done": True,
    "seconds": 1.5,
    "outputs": {"a.h5": "00"},
    "summary": {"ok": True},
}

# name of the file, how it is read, how a sound one is made, examples a run of the tests
READERS: dict[str, tuple[Callable[[Path], object], Callable[[Path], bytes], int]] = {
    "a.csv": (read_and_segment, lambda tmp: as_text(","), 2),
    "a.tsv": (read_and_segment, lambda tmp: as_text("\t"), 1),
    "a.txt": (read_and_segment, lambda tmp: as_text(" "), 1),
    "a.xlsx": (read_and_segment, lambda tmp: as_workbook(), 1),
    "a.toml": (load_config, lambda tmp: (ROOT / "runs/demo.toml").read_bytes(), 10),
    "device.toml": (load_device, lambda tmp: DEVICE, 10),
    "a.msh": (lambda path: read_gmsh(path, FLAT), lambda tmp: as_mesh(), 4),
    "a.journal": (read_journal, as_journal, 10),
    "stage.json": (read_stage, lambda tmp: json.dumps(STAGE).encode(), 10),
    "answer.json": (read_answer, lambda tmp: b'{"output": [[1.0, 2.0]], "inputSizes": [5]}', 10),
    "request.json": (read_request, lambda tmp: json.dumps(REQUEST).encode(), 10),
}
EACH = 10
MOST_HDF5 = 400  # each takes a process
MANY = 170  # times the examples, in a slow run
GUIDED = 10_000  # inputs of each reader that coverage leads to, in a slow run
HERE = {"name": "toy", "contents": "1"}  # what a chain is of
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


def refused(read: Callable[[Any], Any], given: Any) -> bool:
    """Whether an input was refused; fails unless it was read, or refused in words that fit one line."""
    said = "one line"
    try:
        read(given)
        return False
    except (InputError, OSError) as error:
        said = str(error)
    assert len(said.splitlines()) == 1, said
    return True


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
    assert count[0] or name in ("stage.json", "a.journal", "request.json")  # these pass over what is torn


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_inputs_that_reach_new_code_are_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris is not installed (extra `fuzz`)")
    command = [sys.executable, str(ROOT / "tests" / "coverage_fuzz.py"), name, str(GUIDED)]
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


def a_design() -> Design:
    theta = SPACE.from_unit(np.random.default_rng(3).random((40, SPACE.dim)))
    force_n, held_out = toy_bin_means(theta), np.arange(40) % 5 == 0
    wave, ok = np.zeros(40, dtype=np.int64), np.ones(40, dtype=bool)
    return Design(SPACE, EDGES_S, theta, force_n, wave, held_out, ok, ("",) * 40, np.ones(40), 1, "toy")


def as_surrogate(path: Path) -> None:
    surrogate, validation = train(a_design(), "gp", seed=0)
    save_surrogate(path, surrogate, manifest_of(surrogate, validation))


def as_posterior(path: Path) -> None:
    draws = SPACE.from_unit(np.random.default_rng(4).random((2, 30, SPACE.dim)))
    columns = {name: draws[..., j] for j, name in enumerate(SPACE.names)}
    said = json.dumps([dataclasses.asdict(p) for p in SPACE.parameters])
    save_inference_data(path, az.from_dict(columns, attrs={"parameters": said, "correlations": "[]"}))


def as_chain(path: Path) -> None:
    backend = emcee.backends.Backend()
    sampler = emcee.EnsembleSampler(8, 2, lambda x: -0.5 * float(x @ x), backend=backend)
    sampler.run_mcmc(np.random.default_rng(5).standard_normal((8, 2)), 5)
    chains.save(path, backend, ("a", "b"), HERE)


# name of the file, how a sound one is made, how it is read, examples a run: of altered contents, of bytes
HDF5: dict[str, tuple[Callable[[Path], object], Callable[[Path], object], int, int]] = {
    "surrogate.h5": (as_surrogate, load_manifest, 40, 2),
    "design.h5": (lambda path: storage.save(path, a_design(), {"waves": "[{}]"}), load_waves, 40, 2),
    "posterior.nc": (as_posterior, lambda path: draws_of(load_inference_data(path)), 10, 2),
    "chain.h5": (as_chain, lambda path: chains.load(path, ("a", "b"), HERE), 40, 0),  # a run's own
}
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
    monkeypatch.setattr(probe, "_READ_ALL", "import time; time.sleep(600)")
    monkeypatch.setattr(probe, "STARTS_S", 0.5)
    with pytest.raises(InputError, match=r"not readable as HDF5 \(reading it does not end\)"):
        read_recording(path)
    path.write_bytes(as_hdf5(tmp_path))
    os.utime(path, (1, 1))
    monkeypatch.setattr(probe, "_READ_ALL", "import os; os.abort()")
    monkeypatch.setattr(probe, "STARTS_S", 60.0)
    with pytest.raises(InputError, match="it ends the reading process"):
        read_recording(path)


def test_an_hdf5_bomb_is_refused_before_it_takes_the_memory(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as handle:
        handle.attrs["format"] = "bayeskin"
        handle.create_dataset("time_s", shape=(2**32,), dtype="f8", compression="gzip", chunks=(2**20,))
    with pytest.raises(InputError, match=r"not readable as HDF5 \(.*Memory"):
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
    with pytest.raises(InputError, match=r"1\.2e\+09 bytes when unpacked; expected at most 1\.1e\+09"):
        read_recording(tmp_path / "a.xlsx")
