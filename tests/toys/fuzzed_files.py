"""Sound files of every kind that bayeskin reads, with the function that reads each of them."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import arviz as az
import emcee
import numpy as np
import openpyxl
from toys.closed_form_model import EDGES_S, MOTION, SPACE, toy_bin_means, toy_force
from toys.gmsh_file import coarse_tetrahedra, gmsh_text
from toys.laboratory_exports import npy, xls

from bayeskin import storage
from bayeskin.config import load_config
from bayeskin.config.device import load_device
from bayeskin.design_files import load_design
from bayeskin.errors import InputError
from bayeskin.external.umbridge import Refused, parsed_answer
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import Geometry
from bayeskin.inference import chains, draws_of, load_inference_data, save_inference_data
from bayeskin.recordings import phase_noise, read_recording, segment
from bayeskin.runner import FinishedRun
from bayeskin.store import Store
from bayeskin.study import read_table
from bayeskin.surrogates import load_manifest, manifest_of, save_surrogate, train
from bayeskin.types import Design, Recording
from bayeskin.workflow import folder
from bayeskin.workflow.serve import Asked, ServedModel

ROOT = Path(__file__).parents[2]
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


def as_rows() -> list[list[object]]:
    rows = zip(*(column.tolist() for column in a_test()), strict=True)
    return [["time (s)", "displacement (m)", "force (N)"], *map(list, rows)]


def as_workbook() -> bytes:
    book, out = openpyxl.Workbook(), io.BytesIO()
    for row in as_rows():
        book.active.append(row)
    book.save(out)
    return out.getvalue()


FLAT = Geometry(arm_radius_m=None)
DEVICE = b"[device]\nguard_mm = { gap = 1, width = 8 }\n[tissue]\ncutis_mm = { mean = 2, sd = 0.2 }\n"


def as_mesh() -> bytes:
    """Flat skin as gmsh writes it."""
    return gmsh_text(coarse_tetrahedra(FLAT)).encode()


def as_study(tmp: Path) -> bytes:
    """A table, in a folder beside the recordings that it names."""
    for name in ("a.h5", "b.h5", "c.h5"):
        (tmp / name).touch()
    return b"recording,subject,site\n../a.h5,anna,arm\n../b.h5,bela,arm\n../c.h5,bela,leg\n"


def as_store(tmp: Path) -> bytes:
    with Store(tmp / "a.store", "same") as store:
        for n in range(4):
            store.add(n, FinishedRun(np.arange(3.0), n != 2, "why", 0.5))
    return (tmp / "a.store").read_bytes()


def as_hdf5(tmp: Path) -> bytes:
    storage.save(tmp / "sound.h5", Recording(*a_test(), "toy", "0" * 64))
    return (tmp / "sound.h5").read_bytes()


def read_and_segment(path: Path) -> object:
    recording = read_recording(path)
    return phase_noise(recording, segment(recording))


def read_store(path: Path) -> object:
    with Store(path, "same") as store:
        return [store.read(n, FinishedRun) for n in range(4) if n in store]


def read_stage(path: Path) -> object:
    record = folder.read_record(path.parent)
    return None if record is None else (record.sha256, folder.current_record(path.parent, "x"))


def read_answer(path: Path) -> object:
    try:
        return parsed_answer("http://here", path.read_bytes())
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
    "a.xls": (read_and_segment, lambda tmp: xls({"test": as_rows()}), 1),
    "a.npy": (
        read_and_segment,
        lambda tmp: npy(np.rec.fromarrays(a_test(), names="time_s,disp_m,force_N")),
        2,
    ),
    "a.toml": (load_config, lambda tmp: (ROOT / "runs/demo.toml").read_bytes(), 10),
    "device.toml": (load_device, lambda tmp: DEVICE, 10),
    "study.csv": (read_table, as_study, 10),
    "a.msh": (lambda path: read_gmsh(path, FLAT), lambda tmp: as_mesh(), 4),
    "a.store": (read_store, as_store, 10),
    "stage.json": (read_stage, lambda tmp: json.dumps(STAGE).encode(), 10),
    "answer.json": (read_answer, lambda tmp: b'{"output": [[1.0, 2.0]], "inputSizes": [5]}', 10),
    "request.json": (read_request, lambda tmp: json.dumps(REQUEST).encode(), 10),
}
HERE = {"name": "toy", "contents": "1"}  # what a chain is of


def refused(read: Callable[[Any], Any], given: Any) -> bool:
    """Returns whether an input was refused; fails unless it was read, or refused in one line."""
    said = "one line"
    try:
        read(given)
        return False
    except (InputError, OSError) as error:
        said = str(error)
    assert len(said.splitlines()) == 1, said
    return True


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
    "design.h5": (lambda path: storage.save(path, a_design()), load_design, 40, 2),
    "posterior.nc": (as_posterior, lambda path: draws_of(load_inference_data(path)), 10, 2),
    "chain.h5": (as_chain, lambda path: chains.load(path, ("a", "b"), HERE), 40, 0),  # a run's own
}
