"""Whether an installation works: what is installed, what solves, a folder to write in, a test of both models.

Nothing of the models is imported before it is tested, so that one broken part is a finding and no crash; the
command line itself needs click and rich.
"""

from __future__ import annotations

import math
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import bayeskin

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
LEAST_FREE_BYTES = 500_000_000  # a run's folder, chains and all, takes a tenth of it
_REQUIREMENT = re.compile(r"^([A-Za-z0-9_.-]+)\s*(?:\[[^]]*\])?\s*([^;]*?)\s*(?:;\s*(.*))?$")

# The full model pulled 2 mm in 2 s, on the default bricks, and the demo's surrogate, both at THETA.
THETA = {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 0.0}
FULL_MODEL_N, FULL_MODEL_TOLERANCE = 0.089143, 1e-3  # solvers differ by what Newton leaves
SURROGATE_N, SURROGATE_TOLERANCE = 0.378489, 1e-5  # its largest mean force


@dataclass(frozen=True)
class Finding:
    """One thing looked at: whether it is as it should be, what was found, and what would mend it."""

    name: str
    ok: bool
    found: str
    advice: str = ""


def examine(folder: Path) -> dict[str, Any]:
    """The answer of `bayeskin doctor` for a folder to work in; ``ok`` is False when something is broken."""
    packages = list(_packages())
    findings = [
        Finding("bayeskin", True, bayeskin.__version__),
        Finding("python", sys.version_info >= (3, 11), platform.python_version(), "Python 3.11 or newer"),
        *packages,
        _tested("linear solver", _solver),
        _threads(),
        _tested("disk space", partial(_room, folder)),
        _access(folder),
        _tested("full model", _full_model),
        _tested("surrogate", _surrogate),
    ]
    ok = all(finding.ok for finding in findings)
    lines = [
        f"{'ok    ' if one.ok else 'BROKEN'}  {one.name}: {one.found}"
        + ("" if one.ok else f"; expected {one.advice}")
        for one in findings
    ]
    text = "\n".join([*lines, "all is well" if ok else "something is broken"])
    return {
        "ok": ok,
        "platform": platform.platform(),
        "findings": [asdict(finding) for finding in findings],
        "text": text,
    }


def _packages() -> Iterator[Finding]:
    """Each package that this one asks for, with its version; those of extras only where they are there."""
    try:
        asked = metadata.requires("bayeskin") or []
    except metadata.PackageNotFoundError:
        yield Finding("packages", False, "bayeskin is not installed", "pip install bayeskin")
        return
    for line in asked:
        matched = _REQUIREMENT.match(line)
        if matched is None:
            continue
        name, limits, marker = matched.groups()
        if name == "bayeskin" or (marker and "extra" in marker and "dev" in marker):
            continue
        version = _version(name)
        if version is not None:
            yield Finding(name, within(version, limits), version, limits)
        elif not marker:
            yield Finding(name, False, "not installed", limits or "any version")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def within(version: str, limits: str) -> bool:
    """Whether a version lies within limits such as ``>=0.20,<1``; limits of other kinds hold."""
    own = _numbers(version)
    lows = [_numbers(limit) for limit in re.findall(r">=\s*([\d.]+)", limits)]
    highs = [_numbers(limit) for limit in re.findall(r"<(?!=)\s*([\d.]+)", limits)]
    return all(own >= low for low in lows) and all(own < high for high in highs)


def _numbers(version: str) -> list[int]:
    """Of a version, such that 1 and 1.0 are the same."""
    found = [int(part) for part in re.findall(r"\d+", version.split("+")[0])]
    while found and found[-1] == 0:
        found.pop()
    return found


def _tested(name: str, test: Callable[[], Finding]) -> Finding:
    """What a test finds; that it could not be made is a finding too, whatever the reason."""
    try:
        return test()
    except Exception as error:  # a broken installation fails in any way it likes
        return Finding(name, False, f"{type(error).__name__}: {error}", "a reinstalled package")


def _solver() -> Finding:
    from bayeskin.finite_element import SOLVER_NAME

    slower = "" if SOLVER_NAME == "MKL PARDISO" else " (pypardiso would be faster)"
    return Finding("linear solver", True, SOLVER_NAME + slower)


def _threads() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    settings = ", ".join(f"{name}={os.environ.get(name, 'unset')}" for name in THREADS)
    return Finding("threads", True, f"{cores} cores; {settings}")


def _room(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    expected = f"at least {LEAST_FREE_BYTES / 1e9:g} GB"
    return Finding("disk space", free >= LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free", expected)


def _access(folder: Path) -> Finding:
    try:
        with tempfile.TemporaryFile(dir=folder) as handle:
            handle.write(b"bayeskin")
    except OSError as error:
        return Finding("write access", False, f"{folder}: {error.strerror}", "a folder to write runs in")
    return Finding("write access", True, str(folder))


def _full_model() -> Finding:
    import numpy as np

    from bayeskin.finite_element import ModelSpec, simulate
    from bayeskin.types import PadMotion

    started = time.perf_counter()
    run = simulate(ModelSpec(), PadMotion(np.array([0.0, 2.0]), np.array([0.0, 2e-3])), THETA)
    if run.status != "ok":
        return Finding("full model", False, run.message, "a run that ends")
    return _compared("full model", float(run.force_n[-1]), FULL_MODEL_N, FULL_MODEL_TOLERANCE, started)


def _surrogate() -> Finding:
    from bayeskin.shipped import shipped
    from bayeskin.surrogates import load_surrogate

    started = time.perf_counter()
    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    prediction = surrogate.predict([[THETA[name] for name in surrogate.space.names]])
    return _compared("surrogate", float(prediction.mean.max()), SURROGATE_N, SURROGATE_TOLERANCE, started)


def _compared(name: str, found_n: float, expected_n: float, tolerance: float, started: float) -> Finding:
    ok = math.isclose(found_n, expected_n, rel_tol=tolerance)
    seconds = time.perf_counter() - started
    return Finding(
        name, ok, f"{found_n:.6f} N in {seconds:.1f} s", f"{expected_n:.6f} N within {100 * tolerance:g} %"
    )
