"""Reads and checks the sections of a TOML file, and reports the first error in one line."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from bayeskin.errors import InputError
from bayeskin.probe import bytes_of

MOST_BYTES = 1_000_000
TOO_DEEP = "its tables or lists are nested too deeply"


class Section(BaseModel):
    """A frozen table that has only known keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Checked = TypeVar("Checked", bound=Section)


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """Returns the tables of a file. Raises InputError for a file that is absent, not text or not TOML."""
    data = bytes_of(path, expected, MOST_BYTES)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(path, "this file is not text in UTF-8", f"bayeskin needs {expected}") from None
    except RecursionError:
        raise InputError(path, TOO_DEEP, f"bayeskin needs {expected}") from None
    except ValueError as error:  # from the TOML reader, or for a number with thousands of digits
        raise InputError(path, f"this file is not TOML ({error})", f"bayeskin needs {expected}") from None


def checked(kind: type[Checked], plain: Mapping[str, Any], where: Path | str, expected: str) -> Checked:
    """Returns the tables as a checked value. Raises InputError for the first error in them."""
    try:
        return kind.model_validate_json(json.dumps(plain, default=str))
    except ValidationError as error:
        raise _input_error(where, error, kind) from None
    except RecursionError:
        raise InputError(where, TOO_DEEP, f"bayeskin needs {expected}") from None
    except ValueError as error:  # for a number with thousands of digits
        raise InputError(
            where, f"its values cannot be read ({error})", f"bayeskin needs {expected}"
        ) from None


def _input_error(path: Path | str, complaint: ValidationError, root: type[Section]) -> InputError:
    """Returns pydantic's first complaint as an InputError, whose text is one line."""
    first = complaint.errors()[0]
    key = ".".join(str(part) for part in first["loc"] if not str(part).startswith("<"))  # no tags
    kind, given = first["type"], first["input"]
    if kind == "extra_forbidden":
        return InputError(
            f"{path}: {key}", "this key is not known", f"use {one_of(_keys_beside(root, first['loc']))}"
        )
    if kind == "missing" and isinstance(first["loc"][-1], int):
        return InputError(f"{path}: {key}", "this entry is missing", "the list needs it")
    if kind == "missing":
        return InputError(f"{path}: {key}", "there is no value", "give one, because this key has no default")
    if kind == "value_error":
        error = first["ctx"]["error"]
        assert isinstance(error, InputError)  # the checks of this package raise no other
        where = f"{key}.{error.where}" if key else error.where
        return InputError(f"{path}: {where}", error.problem, error.remedy)
    text = first["msg"].replace("False", "false")  # as TOML writes it
    _, should, rule = text.rpartition(" should ")  # as in "Input should be greater than 0"
    remedy = f"it must {rule}" if should else rule[:1].lower() + rule[1:]
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        remedy = "it must be a table"
    elif kind in ("list_type", "tuple_type"):
        remedy = "it must be a list"
    elif kind == "too_long":
        remedy = f"the number of entries must be at most {first['ctx']['max_length']}"
    elif kind == "too_short":
        remedy = f"the number of entries must be at least {first['ctx']['min_length']}"
    given_text = "a table" if isinstance(given, Mapping) else json.dumps(given, default=str)
    return InputError(f"{path}: {key}", f"{given_text} is not allowed", remedy)


def _keys_beside(root: type[Section], location: tuple[Any, ...]) -> tuple[str, ...]:
    """Returns the names of the keys that are allowed in the table that `location` points into."""
    section: type[BaseModel] = root
    for part in location[:-1]:  # other parts name a parameter or the form of a value
        if part in section.model_fields:
            section = next(_models_in(section.model_fields[part].annotation))
    return tuple(section.model_fields)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yields the pydantic models that an annotation contains."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_in(part)


def one_of(names: tuple[str, ...]) -> str:
    """Returns the allowed names, as an error message lists them."""
    return "one of " + ", ".join(names)
