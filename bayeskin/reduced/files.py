"""Writes a reduced model to one HDF5 file and reads it again.

The file holds arrays and text only. Its manifest is stored in the file and also beside it, as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayeskin import __version__, storage
from bayeskin.errors import InputError
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import Geometry, Guard
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.hashes import law_hashes
from bayeskin.reduced.cases import Protocols, Trained
from bayeskin.reduced.library import Library, Modes
from bayeskin.reduced.model import Cubatures, ReducedModel
from bayeskin.reduced.operators import Rule
from bayeskin.types import Array, ParameterSpace, frozen_array

FORMAT, FORMAT_VERSION = "bayeskin reduced model", 2
EXPECTED = "a reduced model that `bayeskin reduce` wrote"


def save_reduced(path: Path, model: ReducedModel, manifest: Mapping[str, Any]) -> None:
    """Writes a reduced model and, beside it as ``.json``, its manifest.

    Each file is written whole or not at all. The base's modes are stored in single precision and the modes of
    mechanisms in half precision. Each mode is divided by its largest value.
    Raises InputError where a file cannot be written.
    """
    text = ""

    def fill(handle: h5py.File) -> None:
        nonlocal text
        _write_modes(handle.create_group("base"), model.library.base, np.float32)
        for name, modes in model.library.beyond.items():
            _write_modes(handle.create_group(f"beyond/{name}"), modes, np.float16)
        for name, rule in asdict(model.cubatures).items():
            group = handle.create_group(f"cubatures/{name}")
            group["points"], group["factor"] = rule["points"].astype(np.int32), rule["factor"]
        storage.write(handle.create_group("space"), model.trained.base)
        for name, space in model.trained.mechanisms.items():
            storage.write(handle.create_group(f"mechanisms/{name}"), space)
        digest = storage.contents_hash(handle)
        full_manifest = {
            **manifest, "geometry": asdict(model.trained.geometry), "refinement": model.refinement,
            "protocols": asdict(model.trained.protocols), "full_model_hash": model.full_hash,
            "laws": law_hashes(model.trained.mechanisms), "arrays_sha256": digest,
        }  # fmt: skip
        text = json.dumps(full_manifest, indent=2, sort_keys=True)
        handle.attrs.update(
            format=FORMAT, format_version=FORMAT_VERSION, version=__version__, arrays_sha256=digest,
            manifest=text,
        )  # fmt: skip

    storage.write_hdf5(path, fill)
    storage.write_bytes(path.with_suffix(".json"), f"{text}\n".encode())


def _write_modes(group: h5py.Group, modes: Modes, kind: type) -> None:
    for name, values in asdict(modes).items():
        largest = np.abs(values).max(axis=1, initial=1e-300) if len(values) else np.zeros(0)
        group.create_dataset(
            name, data=(values / largest[:, None]).astype(kind), compression="gzip", shuffle=True
        )
        group[f"{name}_size"] = largest


def _read_modes(group: h5py.Group) -> Modes:
    def values(name: str) -> Array:
        return frozen_array(group[name][()].astype(float) * group[f"{name}_size"][()][:, None])

    return Modes(values("displacement"), values("pressure"))


def trained_geometry(path: Path) -> Geometry | None:
    """Returns the geometry of the reduced model in a file, or None where the file holds no reduced model.

    Raises InputError for a file that is absent or is not HDF5.
    """
    with storage.reading(path, EXPECTED) as handle:
        if handle.attrs.get("format") != FORMAT:
            return None
        return _geometry(json.loads(handle.attrs["manifest"])["geometry"])


def load_reduced(path: Path) -> ReducedModel:
    """Returns the reduced model that `save_reduced` wrote; a file is read again only if it has been replaced.

    Raises InputError if the file is absent, truncated, altered or of another kind, or if the model was made
    from another version of the full model or of a mechanism's law.
    """
    status = path.stat() if path.is_file() else None
    return _loaded(path, () if status is None else (status.st_ino, status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=4)
def _loaded(path: Path, state: tuple[int, ...]) -> ReducedModel:
    """Returns the reduced model in a file; `state` differs when the file has been replaced."""
    with storage.reading(path, EXPECTED) as handle:
        if handle.attrs.get("format") != FORMAT:
            raise InputError(path, "it is an HDF5 file of another origin", f"bayeskin needs {EXPECTED}")
        version = int(handle.attrs["format_version"])
        if version != FORMAT_VERSION:
            raise InputError(path, f"the version of its format is {version}", f"it must be {FORMAT_VERSION}")
        if storage.contents_hash(handle) != handle.attrs["arrays_sha256"]:
            raise InputError(
                path, "its contents differ from their stored hash", "bayeskin needs an unaltered file"
            )
        manifest = json.loads(handle.attrs["manifest"])
        model = ReducedModel(
            trained=Trained(
                _geometry(manifest["geometry"]), storage.read(handle["space"], ParameterSpace, path),
                {name: storage.read(group, ParameterSpace, path)
                 for name, group in handle.get("mechanisms", {}).items()},
                Protocols(**{name: _tupled(value) for name, value in manifest["protocols"].items()}),
            ),
            refinement=int(manifest["refinement"]),
            library=Library(
                _read_modes(handle["base"]),
                {name: _read_modes(group) for name, group in handle.get("beyond", {}).items()},
            ),
            cubatures=Cubatures(**{
                name: Rule(group["points"][()].astype(np.int64), frozen_array(group["factor"][()]))
                for name, group in handle["cubatures"].items()
            }),
            full_hash=str(manifest["full_model_hash"]),
            hash=str(handle.attrs["arrays_sha256"]),
        )  # fmt: skip
    _check_versions(path, model, manifest["laws"])
    return model


def _tupled(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _geometry(said: Mapping[str, Any]) -> Geometry:
    guard = said["guard"]
    return Geometry(**{**said, "guard": None if guard is None else Guard(**guard)})


def _check_versions(path: Path, model: ReducedModel, laws: Mapping[str, str]) -> None:
    spec = ModelSpec(refinement=model.refinement, geometry=model.trained.geometry)
    remedy = "run `bayeskin reduce` again"
    if model.full_hash != spec.hash:
        raise InputError(path, "it belongs to another version of the full model", remedy)
    known = catalogue()
    for name, digest in laws.items():
        if name not in known or law_hashes([name])[name] != digest:
            raise InputError(path, f"it belongs to another version of the mechanism {name}", remedy)
