"""A hash of how a Python source behaves, by which stored results know whether they still hold.

Comments, docstrings, ``pass`` and layout do not count: correcting a sentence must not cost hours of runs.
Everything else counts: names, constants, operators, defaults, decorators, the order of statements, every
annotation (pydantic and dataclasses read them), and strings that stand alone but are no docstrings.
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


@lru_cache(maxsize=8)  # a model of one's own is asked for its hash at each run
def sha256_of_behaviour(source: bytes) -> str:
    """Returns the sha256 of a Python source's syntax tree without docstrings.

    It is the same by every version of Python. A source that Python cannot parse has no behaviour, and its
    bytes are hashed: whoever executes it says what is wrong with it.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as an error, one on a string's escapes would end the parsing
            tree = ast.parse(source)
        _strip(tree)
        text = "\n".join(_line(node) for node in ast.walk(tree))
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # whatever `ast.parse` raises
        return hashlib.sha256(source).hexdigest()
    return hashlib.sha256(text.encode()).hexdigest()


def _strip(tree: ast.Module) -> None:
    """Removes docstrings, ``pass``, and the empty ends that Python 3.12 gives to formatted strings."""
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
        if isinstance(node, ast.JoinedStr):
            node.values = [one for one in node.values if getattr(one, "value", None) != ""]
        for _, value in ast.iter_fields(node):
            if isinstance(value, list):
                value[:] = [one for one in value if not isinstance(one, ast.Pass)]


def _line(node: ast.AST) -> str:
    """Returns a node's type and fields; of nodes within, which have lines of their own, only the types.

    Fields that are empty say nothing and may be some Python versions' only; neither does a string's prefix
    u, its `kind`.
    """
    fields = [(name, _shallow(value)) for name, value in ast.iter_fields(node) if name != "kind"]
    return ascii([type(node).__name__, *sorted((n, v) for n, v in fields if v is not None and v != [])])


def _shallow(value: object) -> object:
    """Returns a field's value with the names of their types in the place of nodes."""
    if isinstance(value, list):
        return [_shallow(one) for one in value]
    return type(value).__name__ if isinstance(value, ast.AST) else value


def sha256_of(value: Any) -> str:
    """Hash of anything that `plain` makes JSON of."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def sha256_of_input(path: Path) -> str:
    """Returns the hash of a Python source's behaviour, or of any other file's bytes.

    Results that were computed from the file still hold while this stays the same. It is empty when the file
    cannot be read.
    """
    if path.suffix != ".py":
        return sha256_of_file(path)
    try:
        return sha256_of_behaviour(path.read_bytes())
    except OSError:
        return ""


def sha256_of_file(path: Path) -> str:
    """Returns the hash of a file's bytes; empty when it cannot be read."""
    try:
        with open(path, "rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError:
        return ""
