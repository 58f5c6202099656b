"""Stores the project's dataclasses in HDF5 and reads them again: arrays, numbers and text, but no code."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import h5py
import numpy as np

from bayeskin import types
from bayeskin.errors import CannotWrite, InputError

T = TypeVar("T")
FORMAT = "bayeskin"
FORMAT_VERSION = 1

# Files name the class of each value in them.
_STORED = {
    name: cls for name, cls in vars(types).items() if isinstance(cls, type) and dataclasses.is_dataclass(cls)
}


def save(path: Path | str, value: Any, attributes: Mapping[str, str] | None = None) -> None:
    """Writes a dataclass of `bayeskin.types` to `path`, with `attributes` at the root of the file.

    The file is written completely or not at all. Raises InputError where it cannot be written.
    """

    def fill(handle: h5py.File) -> None:
        """Fills the file with the attributes and the dataclass."""
        handle.attrs["format"] = FORMAT
        handle.attrs["format_version"] = FORMAT_VERSION
        handle.attrs.update(attributes or {})
        write(handle, value)

    write_hdf5(Path(path), fill)


def write_hdf5(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Writes an HDF5 file that `fill` fills, completely or not at all.

    The file gets its name only when it is complete and on disk, so an interruption leaves an earlier file
    unchanged. It is built in memory, because libhdf5 ends the process when a disk is full. Raises InputError
    where the file cannot be written.
    """
    with h5py.File(path.name, "w", driver="core", backing_store=False) as handle:
        fill(handle)
        handle.flush()
        image = handle.id.get_file_image()
    write_bytes(path, image)


def write_bytes(path: Path, contents: bytes) -> None:
    """Writes a file completely or not at all; an earlier file stays until the new one is complete.

    Raises InputError where the file cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as out:
            out.write(contents)
            out.flush()
            os.fsync(out.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise CannotWrite(path, error) from None
    finally:
        partial.unlink(missing_ok=True)


def load(path: Path | str, cls: type[T]) -> T:
    """Reads the dataclass `cls` that `save` wrote.

    Raises InputError if the file is absent, is not HDF5, is not a file of bayeskin, or holds another type.
    """
    path, expected = Path(path), f"a {cls.__name__} in its own HDF5 form"
    with reading(path, expected) as handle:
        if handle.attrs.get("format") != FORMAT:
            raise InputError(path, "it is an HDF5 file of another origin", f"bayeskin needs {expected}")
        return read(handle, cls, path)


@contextmanager
def reading(path: Path, expected: str) -> Iterator[h5py.File]:
    """Yields an open HDF5 file.

    All errors inside the context are taken as errors in this file: each becomes an InputError that names it.
    """
    if not path.is_file():
        raise InputError(path, "there is no such file", f"bayeskin needs {expected}")
    try:
        with h5py.File(path, "r") as handle:
            yield handle
    except InputError as error:
        if error.where.startswith(str(path)):
            raise
        raise InputError(f"{path}: {error.where}", error.problem, error.remedy) from None
    except Exception as error:  # libhdf5, json and numpy raise many types of error for a damaged file
        problem = "it cannot be read as HDF5" if isinstance(error, OSError) else "its contents cannot be read"
        raise InputError(path, f"{problem} ({in_a_line(error)})", f"bayeskin needs {expected}") from None


def in_a_line(error: Exception) -> str:
    """Returns a library's message about a file in one line of limited length."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def write(group: h5py.Group, value: Any) -> None:
    """Writes the fields of a dataclass into an open HDF5 group."""
    group.attrs["type"] = type(value).__name__
    for field in dataclasses.fields(value):
        _write_field(group, field.name, getattr(value, field.name))


def read(group: h5py.Group, cls: type[T], where: object = "") -> T:
    """Reads a dataclass from an open HDF5 group.

    A field that was added in a later version has its default. Raises InputError when the group holds another
    type, or when a field has a value of another type than the dataclass states.
    """
    stored_type = group.attrs.get("type")
    if stored_type != cls.__name__:
        raise InputError(where or group.name, f"its type is {stored_type!r}", f"it must be {cls.__name__!r}")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if field.name not in group and field.name not in group.attrs:
            if field.default is not dataclasses.MISSING:
                continue
            raise InputError(
                where or group.name,
                f"it has no field {field.name!r}",
                f"it needs all fields of {cls.__name__}",
            )
        values[field.name] = _read_field(group, field.name)
    return checked(cls(**values), where or group.name)


def checked(value: T, where: object) -> T:
    """Returns a dataclass that was made from a file's content, after a check of its fields.

    Raises InputError unless each field has the type of its annotation. The shapes of arrays are not checked.
    """
    kinds = get_type_hints(type(value))
    for field in dataclasses.fields(value):  # type: ignore[arg-type]
        given = getattr(value, field.name)
        if not _is(given, kinds[field.name]):
            value_text = " ".join(repr(given).split())[:60]
            raise InputError(
                f"{where}: {field.name}",
                f"its value is {value_text}",
                f"it must be {field.type}, as a {type(value).__name__} needs it",
            )
    return value


def _is(value: Any, kind: Any) -> bool:
    """Returns whether a value has the type of an annotation; for arrays, the type of their numbers counts."""
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if hasattr(origin, "__value__"):  # a named alias, as numpy's NDArray from Python 3.12 on
        return _is(value, origin.__value__[parts])
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is np.ndarray:
        needed = get_args(parts[1])[0]
        return isinstance(value, np.ndarray) and np.can_cast(value.dtype, needed, "same_kind")
    if origin is tuple:
        return isinstance(value, tuple) and all(_is(part, parts[0]) for part in value)
    if hasattr(origin, "_fields"):  # a named tuple, which becomes a list in JSON
        needed = get_type_hints(origin).values()
        return isinstance(value, list | tuple) and len(value) == len(needed) and all(map(_is, value, needed))
    if origin in (int, float):
        return isinstance(value, int | origin) and not isinstance(value, bool)
    return isinstance(value, origin)


def _write_field(group: h5py.Group, name: str, value: Any) -> None:
    """Writes one field into a group, as a dataset, a group or an attribute."""
    if isinstance(value, np.ndarray):
        compress = {"compression": "gzip", "shuffle": True} if value.size > 256 else {}
        group.create_dataset(name, data=value, **compress)
    elif dataclasses.is_dataclass(value):
        write(group.create_group(name), value)
    elif isinstance(value, tuple) and value and all(dataclasses.is_dataclass(v) for v in value):
        items = group.create_group(name)
        items.attrs["type"] = "tuple"
        for index, item in enumerate(value):
            write(items.create_group(f"{index:06d}"), item)
    elif isinstance(value, str | bool | int | float):
        group.attrs[name] = value
    elif isinstance(value, tuple | list | Mapping):
        plain = dict(value) if isinstance(value, Mapping) else list(value)
        data = json.dumps({"json": plain}, allow_nan=True)
        group.create_dataset(name, data=np.frombuffer(data.encode(), dtype=np.uint8)).attrs["json"] = True
    else:
        raise TypeError(f"{group.name}/{name}: cannot store a {type(value).__name__}")


def _read_field(group: h5py.Group, name: str) -> Any:
    """Reads one field that `_write_field` wrote."""
    if name in group.attrs:
        value = group.attrs[name]
        return value.item() if isinstance(value, np.generic) else value
    node = group[name]
    if isinstance(node, h5py.Dataset):
        if node.attrs.get("json"):
            plain = json.loads(node[()].tobytes().decode())["json"]
            return tuple(plain) if isinstance(plain, list) else plain
        return types.frozen_array(node[()], node.dtype)
    if node.attrs.get("type") == "tuple":
        return tuple(_read_dataclass(node[key], key) for key in sorted(node))
    return _read_dataclass(node, name)


def _read_dataclass(group: h5py.Group, name: str) -> Any:
    """Reads a dataclass whose type the group itself states. Raises InputError for an unknown type."""
    stored_type = group.attrs.get("type")
    if stored_type not in _STORED:
        raise InputError(group.name, f"its type is {stored_type!r}", "it must be a type that bayeskin stores")
    return read(group, _STORED[stored_type], name)


def contents_hash(handle: h5py.File) -> str:
    """Returns the SHA-256 of all datasets and attributes below the root, in the order of their names."""
    digest = hashlib.sha256()
    names: list[str] = []
    handle.visit(names.append)
    for name in sorted(names):
        node = handle[name]
        for key in sorted(node.attrs):
            digest.update(f"{name}@{key}={node.attrs[key]!s};".encode())
        if isinstance(node, h5py.Dataset):
            values = np.ascontiguousarray(node[()])
            digest.update(f"{name}:{values.dtype.str}{values.shape};".encode())
            digest.update(values.tobytes())
    return digest.hexdigest()
