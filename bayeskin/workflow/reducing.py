"""Builds the reduced model of a device, and finds the reduced model that fits a geometry."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from bayeskin.config import load_config
from bayeskin.config.device import load_device, stated_geometry
from bayeskin.config.sections import read_toml
from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.execution.cluster import on_scheduler
from bayeskin.execution.local import Map, local
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import Geometry
from bayeskin.json_files import plain
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.reduced.build import BuildSettings, base_model, with_mechanisms
from bayeskin.reduced.cases import Trained
from bayeskin.reduced.files import load_reduced, save_reduced, trained_geometry
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import other_geometry
from bayeskin.reduced.runs import FullRuns
from bayeskin.shipped import shipped
from bayeskin.store import Store
from bayeskin.types import ParameterSpace
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.executor import WORKERS
from bayeskin.workflow.folder import locked
from bayeskin.workflow.output_paths import check_ending

SHIPPED = "surrogates/article-device-reduced.h5"
REFINEMENT = 1  # refinement of the full model that reduced models replace
EXPECTED = "a configuration, or a file with [device] and [tissue]"


def reduce(
    source: Path | None, out: Path | None, reporter: Reporter, scheduler: str | None = None
) -> dict[str, Any]:
    """Builds the reduced model of a device: the base model first, and then all mechanisms of the tissue.

    source : a configuration, or a file with the sections `device` and `tissue`; None is the article's device
    out : HDF5 file to write; by default beside the source, with "-reduced" after its name
    scheduler : address of a Dask scheduler that makes the training runs; without it, this machine makes them

    Training runs are stored in a folder beside `out` until the model is finished, so the same command
    continues after an interruption. Raises InputError for wrong input, with nothing written. An `out` that is
    finished stays unchanged.
    """
    geometry = _geometry(source)
    path = out or default_path(source)
    check_ending(path, ".h5")
    trained = trained_for(geometry)
    finished = _finished(path, trained)
    if finished:
        return _answer(path, load_reduced(path), 0.0, "done before, unchanged")
    folder, started = training_folder(path), time.perf_counter()
    executor = nullcontext(local(WORKERS)) if scheduler is None else on_scheduler(scheduler)
    training_runs = Store(folder / "runs.store", "training runs", reporter.log)
    with executor as run_all, locked(folder), training_runs as store:
        _build(path, trained, BuildSettings(), store, run_all, reporter)
    shutil.rmtree(folder)
    return _answer(path, load_reduced(path), time.perf_counter() - started, "built")


def _build(
    path: Path, trained: Trained, settings: BuildSettings, store: Store, run_all: Map, reporter: Reporter
) -> None:
    """Builds a first base model, then one from more runs, then the mechanisms, first from fewer runs.

    Each replaces the one before it in the file, so that it can be used meanwhile.
    """
    full = FullRuns(ModelSpec(refinement=REFINEMENT, geometry=trained.geometry), store)

    def progress(what: str, share: float) -> None:
        """Reports the progress."""
        reporter.progress(what, share)

    def write(model: ReducedModel, sizes: BuildSettings, message: str) -> None:
        """Writes a model that can be used, and says so, with the seconds since the command started."""
        save_reduced(path, model, _manifest(sizes))
        reporter.log(f"{path}: {message} ({time.perf_counter() - started:.0f} s)")

    started = time.perf_counter()
    first, names = settings.first, f"all {len(trained.mechanisms)} mechanisms"
    if not path.is_file():
        reporter.log(f"a first base model is trained with {first.base_runs} full runs")
        write(base_model(trained, full, first, run_all, progress), first, "the first base model can be used")
    model = load_reduced(path)
    if not model.trained.mechanisms:
        reporter.log(f"the base model is trained with {settings.base_runs} full runs")
        model = base_model(trained, full, settings, run_all, progress)
        write(model, settings, f"the base model can be used; {names} follow")
        reporter.log(f"{names} are trained with {first.runs} full runs each")
        model = with_mechanisms(model, trained, full, first, run_all, progress)
        write(model, replace(settings, runs=first.runs), "the mechanisms can be used; better ones follow")
    reporter.log(f"{names} are trained with {settings.runs} full runs each")
    complete = with_mechanisms(model, trained, full, settings, run_all, progress)
    write(complete, settings, "the model is finished")


def _manifest(settings: BuildSettings) -> dict[str, Any]:
    """Returns the facts that are stored with a reduced model."""
    return {"settings": asdict(settings), "made_by": "bayeskin reduce"}


def trained_for(geometry: Geometry) -> Trained:
    """Returns the region that the reduced model of a device is trained for: all priors of the catalogue."""
    tissue = {
        name: ParameterSpace(m.parameters) for name, m in catalogue().items() if isinstance(m.act, Tissue)
    }
    return Trained(geometry, default_space(), tissue)


def _geometry(source: Path | None) -> Geometry:
    """Returns the geometry that a source states, by default the article's."""
    if source is None:
        return Geometry()
    if not source.is_file():
        raise InputError(source, "there is no such file", f"bayeskin needs {EXPECTED}")
    if "recording" not in read_toml(source, EXPECTED):
        return load_device(source).geometry
    config = load_config(source)
    return stated_geometry(config.device, config.tissue, source).geometry


def default_path(source: Path | None) -> Path:
    """Returns the path where a source's reduced model is looked for, and written by default."""
    return (
        Path("article-device-reduced.h5") if source is None else source.with_name(f"{source.stem}-reduced.h5")
    )


def _finished(path: Path, trained: Trained) -> bool:
    """Returns whether a file already contains the finished model, so that no training is left to be done.

    Raises InputError for a file of another device.
    """
    if not path.is_file():
        return False
    stored = load_reduced(path)
    if stored.trained.geometry != trained.geometry:
        raise InputError(
            f"-o {path}", "this file has a reduced model of another geometry", "use another name"
        )
    return set(stored.trained.mechanisms) == set(trained.mechanisms) and not training_folder(path).exists()


def training_folder(path: Path) -> Path:
    """Returns the folder that keeps the training runs of a reduced model until the model is finished."""
    return path.with_name(f"{path.stem}-training")


def find_reduced(geometry: Geometry, beside: Sequence[Path]) -> Path | None:
    """Returns the file of a reduced model that fits a geometry, or None where there is none.

    The candidates are files beside the given files that are named as in `default_path`, and the shipped file.
    If several fit, the first one that was made for exactly this geometry is taken. Raises InputError for a
    candidate that cannot be read.
    """
    beside_files = [
        path for source in beside for path in sorted(source.resolve().parent.glob("*-reduced.h5"))
    ]
    known = [(trained_geometry(path), path) for path in (*beside_files, shipped(SHIPPED))]
    fitting = [(trained != geometry, path) for trained, path in known
               if trained is not None and not other_geometry(trained, geometry)]  # fmt: skip
    return min(fitting, key=itemgetter(0))[1] if fitting else None


def reduced_file(geometry: Geometry, beside: Sequence[Path]) -> Path:
    """Returns the file that `find_reduced` finds. Raises InputError where it finds none."""
    file = find_reduced(geometry, beside)
    if file is None:
        raise InputError(
            "reduced model",
            "there is none for this device and tissue",
            "make it from the device's file with `bayeskin reduce`",
        )
    return file


def _answer(path: Path, model: ReducedModel, seconds: float, done: str) -> dict[str, Any]:
    """Returns the command's answer."""
    base, (u, p) = model.cubatures, (model.library.base.displacement, model.library.base.pressure)
    text = (
        f"{path}: {done}; {len(u)} displacement and {len(p) + 1} pressure modes in the base model, "
        f"{len(base.base.points)} cubature points, {len(model.library.beyond)} mechanisms"
    )
    return plain({
        "ok": True, "out": path, "seconds": seconds, "mechanisms": sorted(model.library.beyond),
        "modes": [len(u), len(p) + 1], "points": len(base.base.points), "text": text,
    })  # fmt: skip
