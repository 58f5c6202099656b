"""Imports point downward only: no module of bayeskin knows what stands above or beside it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import bayeskin

PACKAGE = Path(bayeskin.__file__).parent
BASE = {
    "errors",
    "geometry",
    "types",
    "storage",
    "shipped",
    "execution",
    "probe",
    "number_format",
    "access_guard",
    "polynomials",
    "hashing",
    "json_files",
    "store",
}
SIBLINGS = {"recordings", "finite_element", "design", "surrogates"}
BELOW = {
    "compiled_code": set(),
    "errors": set(),
    "json_files": set(),
    "hashing": {"json_files"},
    "geometry": {"errors"},
    "types": {"errors"},
    "polynomials": {"types"},
    "storage": {"types", "errors"},
    "store": {"errors", "hashing", "storage"},
    "shipped": {"errors"},
    "access_guard": set(),
    "execution": {"errors", "access_guard"},
    "probe": {"errors"},
    "number_format": set(),
    **dict.fromkeys(SIBLINGS, BASE),
    "finite_element": BASE | {"external"},
    "config": BASE | {"design", "finite_element"},
    "external": {"errors", "hashing", "types"},
    "mechanisms": BASE | {"finite_element"},
    "reduced": BASE | {"finite_element", "mechanisms"},
    "forward": BASE | {"finite_element", "mechanisms", "reduced", "surrogates", "inference"},
    "history_matching": BASE | {"design"},
    "design_files": BASE,
    "runner": BASE | {"design"},
    "inference": BASE,  # a Surrogate is all that it knows of a model
    "sensitivity": BASE,
    "mismatch": BASE | {"finite_element", "mechanisms", "inference", "forward"},
    "experiments": BASE | {"mechanisms", "inference", "mismatch"},
    "proof": BASE | SIBLINGS | {"mechanisms", "reduced", "runner"},  # and nothing that diagnoses imports it
    "study": BASE | {"inference"},
    "report": BASE | {"recordings", "inference", "sensitivity", "study"},
    "workflow": BASE
    | SIBLINGS
    | {
        "mechanisms",
        "reduced",
        "config",
        "history_matching",
        "design_files",
        "runner",
        "mismatch",
        "experiments",
        "external",
        "forward",
        "inference",
        "sensitivity",
        "study",
        "report",
    },
}
BELOW["workflow"] |= {"proof", "compiled_code"}
BELOW["scripting"] = BELOW["workflow"] | {"workflow"}
BELOW["app"] = BELOW["workflow"] | {"workflow"}
BELOW["cli"] = BELOW["workflow"] | {"workflow", "app"}
BELOW["__main__"] = {"cli"}


def imported(source: str, module: tuple[str, ...], is_package: bool) -> Iterator[str]:
    """Top-level units of bayeskin that a source imports, wherever in it the import stands."""
    submodules = {p.stem for p in PACKAGE.iterdir()}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            up = node.level - is_package
            start = (("bayeskin", *module)[: len(module) + 1 - up]) if node.level else ()
            stem = (*start, *(node.module or "").split(".")) if node.module else start
            targets = [(*stem, alias.name) for alias in node.names]
        else:
            continue
        for target in targets:
            if target[0] == "bayeskin" and len(target) > 1 and target[1] in submodules:
                yield target[1]


def wrong_arrows(source: str, module: tuple[str, ...], is_package: bool = False) -> set[str]:
    return set(imported(source, module, is_package)) - BELOW[module[0]] - {module[0]}


PROVES = {("workflow", "proof")}  # all that may know of the proof, itself apart


SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downward(path: Path) -> None:
    is_package = path.name == "__init__.py"
    relative = path.relative_to(PACKAGE)
    module = relative.parent.parts if is_package else relative.with_suffix("").parts
    assert module[0] in BELOW, f"{module[0]} has no place in the layers"
    assert wrong_arrows(path.read_text(), module, is_package) == set()
    if module[0] != "proof" and module not in PROVES:
        assert "proof" not in set(imported(path.read_text(), module, is_package))


@pytest.mark.parametrize(
    "source",
    [
        "from bayeskin.runner import run",
        "from bayeskin import runner",
        "import bayeskin.runner as r",
        "def f():\n    from ..runner import run",
        "from .. import runner",
    ],
)
def test_an_upward_arrow_is_seen_however_it_is_written(
    source: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "runner.py").touch()
    monkeypatch.setattr(f"{__name__}.PACKAGE", tmp_path)
    assert wrong_arrows(source, ("finite_element", "mesh")) == {"runner"}
    assert wrong_arrows(source, ("cli", "x")) == set()


def test_a_sideways_arrow_is_seen() -> None:
    assert wrong_arrows("from bayeskin.finite_element import mesh", ("surrogates", "gp")) == {
        "finite_element"
    }
    assert wrong_arrows("from bayeskin.finite_element import mesh", ("inference", "sample")) == {
        "finite_element"
    }
    assert wrong_arrows("from .pca import fit", ("surrogates", "gp")) == set()
    assert wrong_arrows("from .pca import fit", ("surrogates",), is_package=True) == set()
