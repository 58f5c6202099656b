"""Computes hashes of the mechanisms' laws, by which stored results know whether they are still valid."""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType

from bayeskin.hashing import sha256_of_behaviour
from bayeskin.mechanisms import catalogue, mechanism

PACKAGE = "bayeskin.mechanisms."
ENTRY = "MECHANISM"


def law_hashes(names: Iterable[str]) -> dict[str, str]:
    """Returns, by mechanism name, the sha256 of the behaviour of the files that contain each law.

    These are the mechanism's own file and the files of this package from which it takes functions. The entry
    in the catalogue does not count, because sentences, priors and look-alikes are not part of a law. Imports
    do not count either: functions of this package are hashed with their own files, and functions of the full
    model have a version (`PHYSICS_VERSION`).
    Raises KeyError for a name that is not in the catalogue.
    """
    known = catalogue()
    return {name: _hash(sys.modules[known[name].act.bind.__module__]) for name in names}


@cache
def _hash(module: ModuleType) -> str:
    files = sorted(_files(module, set()))
    return hashlib.sha256("\n".join(sha256_of_behaviour(law_source(f)) for f in files).encode()).hexdigest()


def law_source(file: Path) -> bytes:
    """Returns a file's source without its imports and without its entry in the catalogue."""
    source = file.read_bytes()
    lines = source.splitlines(keepends=True)
    for node in reversed(ast.parse(source).body):
        if isinstance(node, ast.Import | ast.ImportFrom) or _is_entry(node):
            lines[node.lineno - 1 : node.end_lineno] = []
    return b"".join(lines)


def _is_entry(node: ast.stmt) -> bool:
    """Returns whether a statement assigns the mechanism's entry in the catalogue."""
    return isinstance(node, ast.Assign) and [getattr(t, "id", None) for t in node.targets] == [ENTRY]


def _files(module: ModuleType, seen: set[Path]) -> set[Path]:
    """Returns `seen` with the file of a module and the files of this package from which it takes functions.

    The file `mechanism.py` is left out.
    """
    own = Path(inspect.getfile(module))
    if own not in seen:
        seen.add(own)
        sources = {getattr(value, "__module__", None) or "" for value in vars(module).values()}
        for name in sorted(sources - {mechanism.__name__, module.__name__}):
            if name.startswith(PACKAGE):
                _files(sys.modules[name], seen)
    return seen
