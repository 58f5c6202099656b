"""Reads a configuration from a TOML file and writes it as TOML."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayeskin.config.configuration import Config
from bayeskin.config.priors import parameter_space
from bayeskin.config.sections import checked, read_toml

EXPECTED = "a TOML configuration, as `bayeskin new RECORDING` writes one"


def load_config(path: Path | str) -> Config:
    """Reads and checks a configuration; ``name`` defaults to the file's name without its suffix.

    Raises InputError for a file that is absent or is not TOML, an unknown key, a value of the wrong type or
    range, and a lower bound above the upper.
    """
    path = Path(path)
    plain = read_toml(path, EXPECTED)
    plain.setdefault("name", path.stem)
    return config_of(plain, path)


def config_of(plain: Mapping[str, Any], where: Path | str) -> Config:
    """Returns a checked configuration. Raises InputError, which names `where`, as `load_config` does."""
    config = checked(Config, plain, where, EXPECTED)
    parameter_space(config, where)
    config.geometry(where)
    return config


def to_toml(config: Config) -> str:
    """Returns a configuration as TOML text with all keys, from which `load_config` reads the same values."""
    return "\n".join(_table(config.model_dump(mode="json", exclude_none=True))) + "\n"


def _table(plain: Mapping[str, Any], name: str = "") -> list[str]:
    """Returns the lines of a TOML table and of the tables in it."""
    # JSON and TOML write a scalar, and a list of scalars, in the same way.
    lines = [f"{key} = {json.dumps(value)}" for key, value in plain.items() if not isinstance(value, dict)]
    for key, value in plain.items():
        if isinstance(value, dict):
            path = f"{name}.{key}" if name else key
            lines += [f"[{path}]", *_table(value, path)]
    return lines
