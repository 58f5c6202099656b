"""Settings of algorithms are frozen, have a default for every field, and say what each field is."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import bayeskin

PACKAGE = Path(bayeskin.__file__).parent
COVERED = {
    "experiments",
    "history_matching.py",
    "inference",
    "mismatch",
    "recordings",
    "sensitivity",
    "surrogates",
}


@cache
def classes() -> dict[str, ast.ClassDef]:
    """Every class of these packages whose name ends in Settings, by its module and name."""
    return {
        f"{path.relative_to(PACKAGE)}: {node.name}": node
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.relative_to(PACKAGE).parts[0] in COVERED
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and node.name.endswith("Settings")
    }


@pytest.mark.parametrize("name", classes())
def test_settings_are_frozen_and_documented(name: str) -> None:
    settings = classes()[name]
    assert "dataclass(frozen=True)" in map(ast.unparse, settings.decorator_list)
    fields = [node for node in settings.body if isinstance(node, ast.AnnAssign)]
    assert fields
    assert all(field.value is not None for field in fields)
    words = re.findall(r"\w+", ast.get_docstring(settings) or "")
    assert {ast.unparse(field.target) for field in fields} <= set(words)


def test_there_are_settings() -> None:
    assert len(classes()) > 30
