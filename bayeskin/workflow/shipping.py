"""Finds and checks surrogates that were trained before.

Such a surrogate is a file NAME.h5 that contains its manifest. Its design NAME-design.h5 lies beside it. Where
the design is a coarser model's, the runs of the finer model lie beside it too, as NAME-fine.h5.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayeskin.config import parameter_space
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.hashing import sha256_of
from bayeskin.probe import refuse_damaged
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest
from bayeskin.types import BinnedForce, Design, PadMotion
from bayeskin.workflow.engine import Run
from bayeskin.workflow.model import model_spec, waves_model


class ShippedFiles(NamedTuple):
    """The files of a surrogate that was trained before; `fine` exists only with a coarser model's design."""

    surrogate: Path
    design: Path
    fine: Path | None

    @property
    def present(self) -> tuple[Path, ...]:
        """Returns the files, without `fine` where it is None."""
        return tuple(path for path in self if path is not None)


def shipped_files(run: Run) -> ShippedFiles:
    """Returns the files that ``surrogate.file`` names: beside the configuration, or else shipped ones.

    A recording of the same name beside the configuration is not taken for a surrogate. Raises InputError
    where a file is absent or cannot be read.
    """
    name, folder = run.config.surrogate.file, run.config_path.resolve().parent
    assert name is not None
    beside = folder / name
    brought = beside.is_file() and name != run.config.only_recording(run.config_path).file
    path = beside if brought else _shipped_folder() / name
    if not path.is_file():
        names = ", ".join(f"{file.stem}.h5" for file in _shipped_manifests())
        raise InputError(
            f"{run.config_path}: surrogate.file",
            f"there is no file {beside}",
            f"name a file beside the configuration, or a shipped one: {names}",
        )
    fine = None if run.config.design.coarse is None else path.with_name(f"{path.stem}-fine.h5")
    files = ShippedFiles(path, path.with_name(f"{path.stem}-design.h5"), fine)
    for file in files.present[1:]:
        if not file.is_file():
            raise InputError(
                f"{run.config_path}: surrogate.file",
                f"there is no file {file}",
                "the design of the surrogate must lie beside it",
            )
    for file in files.present if brought else ():
        refuse_damaged(file, "a surrogate and its design in its own HDF5 form")
    return files


def _shipped_folder() -> Path:
    """Returns the folder of the shipped surrogates."""
    return shipped("surrogates/README.md").parent


def _shipped_manifests() -> dict[Path, Mapping[str, Any]]:
    """Returns the manifests of the shipped surrogates by their files, without those of reduced models."""
    files = sorted(_shipped_folder().glob("*.json"))
    manifests = {path: json.loads(path.read_text(encoding="utf-8")) for path in files}
    return {path: manifest for path, manifest in manifests.items() if "motion_sha256" in manifest}


def shipped_for(motion: PadMotion, geometry: Geometry = Geometry()) -> Path | None:
    """Returns the shipped surrogate for a protocol, and None where there is none.

    It predicts the reaction on the generator's bricks. All shipped surrogates are for the article's device
    and tissue.
    """
    if geometry != Geometry():
        return None
    for path, manifest in _shipped_manifests().items():
        fits = (manifest.get("observation"), manifest.get("mesh")) == ("reaction", "bricks")
        if fits and manifest.get("motion_sha256") == motion_sha256(motion):
            return path.with_suffix(".h5")
    return None


def origin(run: Run, motion: PadMotion, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns what a manifest states besides the surrogate's own facts.

    These values show later whether the surrogate fits a run.
    """
    model = run.config.model
    return {
        "observation": model.observation,
        "mesh": Path(model.mesh).name,
        "motion_sha256": motion_sha256(motion),
        "geometry_sha256": model_spec(run).geometry.hash,
        "waves": list(records),
    }


def check_fits(run: Run, files: ShippedFiles, design: Design, binned: BinnedForce, motion: PadMotion) -> None:
    """Raises InputError unless a surrogate fits a run.

    Model, protocol and bins have to be those of the run, and the run's priors have to lie in the surrogate's
    box.
    """
    manifest = load_manifest(files.surrogate)
    where = f"{run.config_path}: surrogate.file {files.surrogate.name}"
    waves = manifest.get("waves")
    if not isinstance(waves, list) or not all(isinstance(w, dict) and "kept_fraction" in w for w in waves):
        raise InputError(
            f"{where}: manifest: waves",
            f"it is {waves!r:.60}",
            "it must describe how the points of each wave were chosen",
        )
    if manifest.get("geometry_sha256", Geometry().hash) != model_spec(run).geometry.hash:
        remedy = "use one of this configuration's [device] and [tissue], or a design without surrogate.file"
        raise InputError(where, "it belongs to another device or tissue", remedy)
    if (design.model_hash, manifest.get("model_hash")) != (waves_model(run).hash, model_spec(run).hash):
        raise InputError(where, "it belongs to another model", "use one of this configuration's model")
    if manifest.get("motion_sha256") != motion_sha256(motion):
        raise InputError(where, "it belongs to another protocol", "use one of this recording's protocol")
    if len(design.edges_s) != len(binned.edges_s) or not np.allclose(design.edges_s, binned.edges_s):
        problem = f"it has {len(design.edges_s) - 1} bins to {design.edges_s[-1]:g} s"
        remedy = f"the recording needs {len(binned.edges_s) - 1} bins to {binned.edges_s[-1]:g} s"
        raise InputError(where, problem, remedy)
    for parameter in parameter_space(run.config, run.config_path).parameters:
        box = manifest["parameters"].get(parameter.name)
        if box is None:
            remedy = "use one with this configuration's parameters"
            raise InputError(where, f"it has no parameter {parameter.name}", remedy)
        if parameter.lower < box["lower"] or parameter.upper > box["upper"]:
            raise InputError(
                f"{run.config_path}: parameters.{parameter.name}",
                f"it reaches from {parameter.lower:g} to {parameter.upper:g} {parameter.unit}",
                f"it must lie within {box['lower']:g} to {box['upper']:g}, the box of surrogate.file",
            )


def motion_sha256(motion: PadMotion) -> str:
    """Returns the hash of a protocol's corners, rounded to a microsecond and a nanometre."""
    return sha256_of([np.round(motion.time_s, 6), np.round(motion.displacement_m, 9)])
