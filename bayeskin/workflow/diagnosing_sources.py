"""Computes a hash of all that the verdict of a diagnosis depends on, which shows if a stored verdict is
valid."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bayeskin
from bayeskin import mechanisms
from bayeskin.hashing import sha256_of, sha256_of_input
from bayeskin.shipped import shipped
from bayeskin.workflow import diagnosis

WITHOUT_EFFECT = ("report", "scripting")  # figures, and functions that only scripts import
PACKAGE = Path(bayeskin.__file__).parent


def diagnosing_sources() -> str:
    """Returns the sha256 of the behaviour of a diagnosis's sources, and of the bytes of its data.

    The sources are the modules that a diagnosis imports, and all mechanisms. The data are the model's tables
    and the manifest of the shipped reduced model. A corrected comment or docstring does not change the hash.
    """
    files = sorted({*imported(Path(diagnosis.__file__)), *Path(mechanisms.__file__).parent.glob("*.py")})
    files += sorted(PACKAGE.glob("finite_element/*.json"))
    files.append(shipped("surrogates/article-device-reduced.json"))
    return sha256_of([[path.name, sha256_of_input(path)] for path in files])


def imported(module: Path) -> set[Path]:
    """Returns the package's files that `module` imports, directly or through others, and its own file."""
    reached: set[Path] = set()
    waiting = {module}
    while waiting:
        file = waiting.pop()
        reached.add(file)
        waiting |= set(_imports(file)) - reached
    return reached


def _imports(file: Path) -> Iterator[Path]:
    """Yields the files of the package that one file imports, with the packages that contain them."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            top, *parts = name.split(".")
            if top != PACKAGE.name or (parts and parts[0] in WITHOUT_EFFECT):
                continue
            place = PACKAGE
            yield place / "__init__.py"
            for part in parts:
                place /= part
                yield from (p for p in (place / "__init__.py", place.with_suffix(".py")) if p.is_file())
