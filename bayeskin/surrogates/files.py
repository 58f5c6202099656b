"""A trained surrogate to and from one HDF5 file with its manifest inside: arrays and text, no code."""

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
from bayeskin.surrogates.consistency import refuse_unsound
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.shapes import ShapeTransform
from bayeskin.surrogates.surrogate import Latents, ShapeSurrogate
from bayeskin.surrogates.two_fidelities import CorrectedLatents
from bayeskin.surrogates.validate import Validation
from bayeskin.types import ParameterSpace, frozen_array

FORMAT = "bayeskin surrogate"
# 2: inputs are those of `Similarity`; 3: latents may have a correction; 4: active inputs; 5: a correction may
# have latents of its own
FORMAT_VERSION = 5
READABLE = (3, 4, 5)  # in 3 all inputs are active
EXPECTED = "a surrogate that bayeskin wrote"
LATENTS: dict[str, type[LatentGPs] | type[LatentChaos]] = {"gp": LatentGPs, "chaos": LatentChaos}


def manifest_of(surrogate: ShapeSurrogate, validation: Validation) -> dict[str, Any]:
    """What a reader wants to know before using a surrogate: origin, box, and its measured error."""
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
        "parameters": _described(surrogate.space),
    }


def _described(space: ParameterSpace) -> dict[str, dict[str, Any]]:
    return {
        p.name: {"unit": p.unit, "lower": p.lower, "upper": p.upper, "prior": p.prior}
        for p in space.parameters
    }


def save_surrogate(path: Path | str, surrogate: ShapeSurrogate, manifest: Mapping[str, Any]) -> None:
    """Writes the surrogate and, beside it as ``.json``, its manifest; each whole or not at all.

    Raises InputError where it cannot be written.
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
    """Reads what `save_surrogate` wrote; predictions are the same bit for bit on the same machine.

    Raises InputError if the file is absent, truncated, foreign, of another format version, if its arrays
    do not match the hash stored with them (which covers no attribute of the root: not the manifest), or if
    they do not belong together.
    """
    return _loaded(Path(path))[0]


def load_manifest(path: Path | str) -> dict[str, Any]:
    """The manifest inside a surrogate's file, which knows the model, and the same box as the arrays.

    Raises InputError as `load_surrogate` does, and where it does not.
    """
    surrogate, manifest = _loaded(Path(path))
    if not isinstance(manifest.get("model_hash"), str):
        raise InputError(f"{path}: manifest: model_hash", repr(manifest.get("model_hash")), "a hash")
    if manifest.get("parameters") != _described(surrogate.space):
        raise InputError(f"{path}: manifest: parameters", "others than those of the arrays", "the same box")
    return manifest


def _loaded(path: Path) -> tuple[ShapeSurrogate, dict[str, Any]]:
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
        refuse_unsound(surrogate)
        manifest = json.loads(handle.attrs["manifest"])
        if not isinstance(manifest, dict) or not isinstance(surrogate.provenance, dict):
            raise InputError("manifest or provenance", "JSON of another kind", "a table of names and values")
        return surrogate, manifest


def _refuse_unfit(path: Path, handle: h5py.File) -> None:
    if handle.attrs.get("format") != FORMAT:
        raise InputError(path, "an HDF5 file of another origin", EXPECTED)
    version = str(handle.attrs["format_version"])
    if version not in map(str, READABLE):
        raise InputError(path, f"format version {version:.40}", f"format version {FORMAT_VERSION}")
    if storage.contents_hash(handle) != handle.attrs["arrays_sha256"]:
        raise InputError(path, "contents that differ from their stored hash", "an unaltered file")
