"""A hash of all that the verdict of a diagnosis depends on, by which a stored one is known to still hold."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bayeskin
from bayeskin import mechanisms
from bayeskin.hashing import sha256_of, sha256_of_input
from bayeskin.shipped import shipped
from bayeskin.workflow import diagnosis

WITHOUT_EFFECT = ("report", "scripting")  # figures; what the package offers to scripts that ask for it
PACKAGE = Path(bayeskin.__file__).parent


def diagnosing_sources() -> str:
    """Returns the sha256 of what a diagnosis is made by: its sources' behaviour, and the bytes of data.

    The sources are the modules that a diagnosis imports and all mechanisms; the data are the model's tables
    and the manifest of the shipped reduced model. A corrected comment or docstring changes nothing.
    """
    files = sorted({*imported(Path(diagnosis.__file__)), *Path(mechanisms.__file__).parent.glob("*.py")})
    files += sorted(PACKAGE.glob("finite_element/*.json"))
    files.append(shipped("surrogates/article-device-reduced.json"))
    return sha256_of([[path.name, sha256_of_input(path)] for path in files])


def imported(module: Path) -> set[Path]:
    """Returns the files of the package that `module` imports, itself among them, also by way of others."""
    found: set[Path] = set()
    waiting = {module}
    while waiting:
        file = waiting.pop()
        found.add(file)
        waiting |= set(_imports(file)) - found
    return found


def _imports(file: Path) -> Iterator[Path]:
    """Yields what one file imports of the package, with the packages that these modules lie in."""
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
