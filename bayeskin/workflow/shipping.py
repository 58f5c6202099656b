"""Surrogates that come ready: NAME.h5 with its manifest inside, its design NAME-design.h5 beside it, and
NAME-fine.h5, the fine model's runs, where the design is a coarser one's."""

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
    """The files of a surrogate that comes ready; `fine` only with a coarser model's design."""

    surrogate: Path
    design: Path
    fine: Path | None

    @property
    def present(self) -> tuple[Path, ...]:
        return tuple(path for path in self if path is not None)


def shipped_files(run: Run) -> ShippedFiles:
    """The files that ``surrogate.file`` names: beside the configuration, or among those shipped.

    A recording of that name beside it is none of them.
    """
    name, folder = run.config.surrogate.file, run.config_path.resolve().parent
    assert name is not None
    own = folder / name
    brought = own.is_file() and name != run.config.recording.file
    path = own if brought else _shipped_folder() / name
    if not path.is_file():
        ready = ", ".join(f"{file.stem}.h5" for file in _shipped_manifests())
        expected = f"a file beside the configuration, or one that is shipped: {ready}"
        raise InputError(f"{run.config_path}: surrogate.file", f"no file {own}", expected)
    fine = None if run.config.design.coarse is None else path.with_name(f"{path.stem}-fine.h5")
    files = ShippedFiles(path, path.with_name(f"{path.stem}-design.h5"), fine)
    for file in files.present[1:]:
        if not file.is_file():
            raise InputError(f"{run.config_path}: surrogate.file", f"no {file}", "its design beside it")
    for file in files.present if brought else ():
        refuse_damaged(file, "a surrogate that bayeskin wrote, and its design")
    return files


def _shipped_folder() -> Path:
    return shipped("surrogates/README.md").parent


def _shipped_manifests() -> dict[Path, Mapping[str, Any]]:
    """Returns the manifests of the shipped surrogates by their files; a reduced model's is none of them."""
    files = sorted(_shipped_folder().glob("*.json"))
    said = {path: json.loads(path.read_text(encoding="utf-8")) for path in files}
    return {path: manifest for path, manifest in said.items() if "motion_sha256" in manifest}


def shipped_for(motion: PadMotion, geometry: Geometry = Geometry()) -> Path | None:
    """The shipped surrogate of the reaction on the generator's bricks for a protocol, if there is one.

    All of them are of the article's device and tissue.
    """
    if geometry != Geometry():
        return None
    for path, said in _shipped_manifests().items():
        ours = (said.get("observation"), said.get("mesh")) == ("reaction", "bricks")
        if ours and said.get("motion_sha256") == motion_sha256(motion):
            return path.with_suffix(".h5")
    return None


def origin(run: Run, motion: PadMotion, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns what a manifest says beside the surrogate's own facts, so that it is used where it belongs."""
    model = run.config.model
    return {
        "observation": model.observation,
        "mesh": Path(model.mesh).name,
        "motion_sha256": motion_sha256(motion),
        "geometry_sha256": model_spec(run).geometry.hash,
        "waves": list(records),
    }


def check_fits(run: Run, files: ShippedFiles, design: Design, binned: BinnedForce, motion: PadMotion) -> None:
    """Raises InputError unless model, protocol and bins are this run's, and its priors lie in the box."""
    said = load_manifest(files.surrogate)
    where = f"{run.config_path}: surrogate.file {files.surrogate.name}"
    waves = said.get("waves")
    if not isinstance(waves, list) or not all(isinstance(w, dict) and "kept_fraction" in w for w in waves):
        raise InputError(f"{where}: manifest: waves", f"{waves!r:.60}", "how the points of each were chosen")
    if said.get("geometry_sha256", Geometry().hash) != model_spec(run).geometry.hash:
        expected = "one of this configuration's [device] and [tissue], or a design"
        raise InputError(where, "a surrogate of another device or tissue", expected)
    if (design.model_hash, said.get("model_hash")) != (waves_model(run).hash, model_spec(run).hash):
        raise InputError(where, "a surrogate of another model", "one of this configuration's model")
    if said.get("motion_sha256") != motion_sha256(motion):
        raise InputError(where, "a surrogate of another protocol", "one of this recording's protocol")
    if len(design.edges_s) != len(binned.edges_s) or not np.allclose(design.edges_s, binned.edges_s):
        found = f"{len(design.edges_s) - 1} bins to {design.edges_s[-1]:g} s"
        expected = f"the recording's {len(binned.edges_s) - 1} bins to {binned.edges_s[-1]:g} s"
        raise InputError(where, found, expected)
    for ours in parameter_space(run.config, run.config_path).parameters:
        box = said["parameters"].get(ours.name)
        if box is None:
            raise InputError(where, f"none of {ours.name}", "a surrogate of this configuration's parameters")
        if ours.lower < box["lower"] or ours.upper > box["upper"]:
            raise InputError(
                f"{run.config_path}: parameters.{ours.name}",
                f"{ours.lower:g} to {ours.upper:g} {ours.unit}",
                f"a part of {box['lower']:g} to {box['upper']:g}, the box of surrogate.file",
            )


def motion_sha256(motion: PadMotion) -> str:
    """Hash of a protocol's corners, to a microsecond and a nanometre."""
    return sha256_of([np.round(motion.time_s, 6), np.round(motion.displacement_m, 9)])
