"""Saves a trained surrogate with its manifest in an HDF5 file and loads it: arrays and text, no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayeskin import __version__, storage
from bayeskin.errors import InputError
from bayeskin.surrogates.chaos import LatentChaos
from bayeskin.surrogates.consistency import check_consistency
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.shapes import ShapeTransform
from bayeskin.surrogates.surrogate import Latents, ShapeSurrogate
from bayeskin.surrogates.two_fidelities import CorrectedLatents
from bayeskin.surrogates.validate import Validation
from bayeskin.types import ParameterSpace, frozen_array

FORMAT = "bayeskin surrogate"
# History of the format: since version 2 the inputs are those of `Similarity`, since 3 the latents may have a
# correction, since 4 only some inputs may be active, and since 5 a correction may have additional latents.
FORMAT_VERSION = 5
READABLE = (3, 4, 5)  # in version 3 all inputs are active
EXPECTED = "a surrogate in its own HDF5 form"
LATENTS: dict[str, type[LatentGPs] | type[LatentChaos]] = {"gp": LatentGPs, "chaos": LatentChaos}


def manifest_of(surrogate: ShapeSurrogate, validation: Validation) -> dict[str, Any]:
    """Returns what a user needs to know before using a surrogate: its origin, box, and measured error."""
    return {
        **surrogate.provenance,
        "training_rows": validation.training_rows,
        "components": validation.components,
        "error_rows": validation.rows,
        "error_source": validation.source,
        "relative_error": validation.relative_error,
        "coverage_90": validation.coverage_90,
        "median_point_relative_error": float(np.median(validation.point_relative)),
        "worst_point_relative_error": float(np.max(validation.point_relative)),
        "parameters": _parameter_table(surrogate.space),
    }


def _parameter_table(space: ParameterSpace) -> dict[str, dict[str, Any]]:
    return {
        p.name: {"unit": p.unit, "lower": p.lower, "upper": p.upper, "prior": p.prior}
        for p in space.parameters
    }


def save_surrogate(path: Path | str, surrogate: ShapeSurrogate, manifest: Mapping[str, Any]) -> None:
    """Writes the surrogate and, in a ``.json`` file beside it, its manifest.

    Each file is written completely or not at all. Raises InputError if a file cannot be written.
    """
    path, latents = Path(path), surrogate.latents
    text = ""

    def fill(handle: h5py.File) -> None:
        nonlocal latents, text
        storage.write(handle.create_group("space"), surrogate.space)
        storage.write(handle.create_group("transform"), surrogate.transform)
        if isinstance(latents, CorrectedLatents):
            storage.write(handle.create_group("correction"), latents.correction)
            latents = latents.coarse
        storage.write(handle.create_group("latents"), latents)
        handle.create_dataset("edges_s", data=surrogate.edges_s)
        handle.create_dataset("active", data=surrogate.active)
        digest = storage.contents_hash(handle)
        text = json.dumps({**manifest, "arrays_sha256": digest}, indent=2, sort_keys=True)
        handle.attrs.update(
            format=FORMAT, format_version=FORMAT_VERSION, version=__version__, arrays_sha256=digest,
            kind=surrogate.provenance["kind"], manifest=text,
            provenance=json.dumps(dict(surrogate.provenance)),
        )  # fmt: skip

    storage.write_hdf5(path, fill)
    storage.write_bytes(path.with_suffix(".json"), f"{text}\n".encode())


def load_surrogate(path: Path | str) -> ShapeSurrogate:
    """Returns the surrogate that `save_surrogate` wrote.

    On the same machine, its predictions are bit-for-bit identical. Raises InputError if the file is missing,
    truncated, not from bayeskin, or of another format version. It is also raised if the arrays do not match
    their stored hash, or do not match each other. The hash covers no attribute of the root, such as the
    manifest.
    """
    return _load(Path(path))[0]


def load_manifest(path: Path | str) -> dict[str, Any]:
    """Returns the manifest inside a surrogate's file, with the hash of the model and the box of the arrays.

    Raises InputError in the cases of `load_surrogate`, if the manifest lacks the hash of the model, or if its
    box differs from that of the arrays.
    """
    surrogate, manifest = _load(Path(path))
    if not isinstance(manifest.get("model_hash"), str):
        raise InputError(
            f"{path}: manifest: model_hash", f"it is {manifest.get('model_hash')!r}", "it must be a hash"
        )
    if manifest.get("parameters") != _parameter_table(surrogate.space):
        raise InputError(
            f"{path}: manifest: parameters",
            "they differ from those in the arrays",
            "parameters and bounds must be the same",
        )
    return manifest


def _load(path: Path) -> tuple[ShapeSurrogate, dict[str, Any]]:
    with storage.reading(path, EXPECTED) as handle:
        _refuse_unfit(path, handle)
        latents: Latents = storage.read(handle["latents"], LATENTS[handle.attrs["kind"]], path)
        if "correction" in handle:
            latents = CorrectedLatents(latents, storage.read(handle["correction"], LatentGPs, path))
        active = handle["active"][()] if "active" in handle else np.arange(latents.inputs.shape[1])
        surrogate = ShapeSurrogate(
            storage.read(handle["space"], ParameterSpace, path), frozen_array(handle["edges_s"][()]),
            storage.read(handle["transform"], ShapeTransform, path), latents,
            json.loads(handle.attrs["provenance"]), frozen_array(active, np.int64),
        )  # fmt: skip
        check_consistency(surrogate)
        manifest = json.loads(handle.attrs["manifest"])
        if not isinstance(manifest, dict) or not isinstance(surrogate.provenance, dict):
            raise InputError(
                "manifest or provenance", "it is not a JSON object", "it must be a table of names and values"
            )
        return surrogate, manifest


def _refuse_unfit(path: Path, handle: h5py.File) -> None:
    if handle.attrs.get("format") != FORMAT:
        raise InputError(path, "it is an HDF5 file of another origin", f"bayeskin needs {EXPECTED}")
    version = str(handle.attrs["format_version"])
    if version not in map(str, READABLE):
        raise InputError(path, f"the version of its format is {version:.40}", f"it must be {FORMAT_VERSION}")
    if storage.contents_hash(handle) != handle.attrs["arrays_sha256"]:
        raise InputError(
            path, "its contents differ from their stored hash", "bayeskin needs an unaltered file"
        )
