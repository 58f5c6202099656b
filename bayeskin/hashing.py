"""Hashes how a Python source behaves, so that stored results show whether they are still valid.

Comments, docstrings, ``pass`` and layout do not count, because a corrected sentence must not cost hours of
runs. Everything else counts: names, constants, operators, defaults, decorators, the order of statements, all
annotations (pydantic and dataclasses read them), and string expressions that are not docstrings.
"""

from __future__ import annotations

import ast
import hashlib
import json
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

from bayeskin.json_files import plain

DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@lru_cache(maxsize=1024)  # the hash of all of a diagnosis's sources is needed again and again
def sha256_of_behaviour(source: bytes) -> str:
    """Returns the sha256 of a Python source's syntax tree without docstrings.

    All versions of Python give the same hash. A source that Python cannot parse has no behaviour, so its
    bytes are hashed instead. The error in it is reported when the source is executed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a warning made an error would end the parsing
            tree = ast.parse(source)
        _strip(tree)
        text = "\n".join(_line(node) for node in ast.walk(tree))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # all that `ast.parse` can raise
        return hashlib.sha256(source).hexdigest()
    return hashlib.sha256(text.encode()).hexdigest()


def _strip(tree: ast.Module) -> None:
    """Removes docstrings, ``pass``, and the empty ends that Python 3.12 adds to formatted strings."""
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
        if isinstance(node, ast.JoinedStr):
            node.values = [part for part in node.values if getattr(part, "value", None) != ""]
        for _, value in ast.iter_fields(node):
            if isinstance(value, list):
                value[:] = [part for part in value if not isinstance(part, ast.Pass)]


def _line(node: ast.AST) -> str:
    """Returns the type and the fields of a node as text; nodes within it appear with their types only.

    The inner nodes have lines of their own. Empty fields carry no information and may exist in some Python
    versions only, so they are left out. The field `kind`, the prefix u of a string, is left out too.
    """
    fields = [(name, _shallow(value)) for name, value in ast.iter_fields(node) if name != "kind"]
    return ascii([type(node).__name__, *sorted((n, v) for n, v in fields if v is not None and v != [])])


def _shallow(value: object) -> object:
    """Returns the value of a field, in which nodes are replaced by the names of their types."""
    if isinstance(value, list):
        return [_shallow(item) for item in value]
    return type(value).__name__ if isinstance(value, ast.AST) else value


def sha256_of(value: Any) -> str:
    """Returns the hash of any value that `plain` can convert to JSON."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def sha256_of_input(path: Path) -> str:
    """Returns the hash of a Python source's behaviour, or of the bytes of any other file.

    Results that were computed from the file are valid while this hash stays the same. The hash is empty where
    the file cannot be read.
    """
    if path.suffix != ".py":
        return sha256_of_file(path)
    try:
        return sha256_of_behaviour(path.read_bytes())
    except OSError:
        return ""


def sha256_of_file(path: Path) -> str:
    """Returns the hash of a file's bytes; the hash is empty where the file cannot be read."""
    try:
        with open(path, "rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError:
        return ""
