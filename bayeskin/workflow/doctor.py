"""Checks an installation: packages, linear solver, working folder, full model and surrogate.

The parts of bayeskin that run models are imported only in their own test. A broken part is thus reported as a
finding, and does not end the program. The command line itself needs click and rich.
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
from bayeskin.errors import reason_of

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
LEAST_FREE_BYTES = 500_000_000  # a run's folder with its chains takes a tenth of this
_REQUIREMENT = re.compile(r"^([A-Za-z0-9_.-]+)\s*(?:\[[^]]*\])?\s*([^;]*?)\s*(?:;\s*(.*))?$")

# The stored forces are those of the full model on the default bricks, pulled 2 mm in 2 s, and of the demo's
# surrogate. Both are at THETA.
THETA = {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 0.0}
FULL_MODEL_N, FULL_MODEL_TOLERANCE = 0.089143, 1e-3  # solvers differ by Newton's residual
SURROGATE_N, SURROGATE_TOLERANCE = 0.378489, 1e-5  # the largest mean force of its prediction


@dataclass(frozen=True)
class Finding:
    """The result of one check: whether the part works, its state, and what it needs."""

    name: str
    ok: bool
    state: str
    needed: str = ""


def examine(folder: Path) -> dict[str, Any]:
    """Returns the answer of `bayeskin doctor` for a folder; ``ok`` is False if something is broken."""
    packages = list(_packages())
    findings = [
        Finding("bayeskin", True, bayeskin.__version__),
        Finding("python", sys.version_info >= (3, 11), platform.python_version(), "Python 3.11 or newer"),
        *packages,
        _finding_of("linear solver", _solver),
        _threads(),
        _finding_of("disk space", partial(_disk_space, folder)),
        _write_access(folder),
        _finding_of("full model", full_model_finding),
        _finding_of("surrogate", surrogate_finding),
    ]
    ok = all(finding.ok for finding in findings)
    lines = [
        f"{'ok    ' if finding.ok else 'BROKEN'}  {finding.name}: {finding.state}"
        + ("" if finding.ok else f"; needed: {finding.needed}")
        for finding in findings
    ]
    text = "\n".join([*lines, "all is well" if ok else "something is broken"])
    return {
        "ok": ok,
        "platform": platform.platform(),
        "findings": [asdict(finding) for finding in findings],
        "text": text,
    }


def _packages() -> Iterator[Finding]:
    """Yields a finding for each package that bayeskin requires, with its version.

    Packages of extras are reported only where they are installed.
    """
    try:
        requirements = metadata.requires("bayeskin") or []
    except metadata.PackageNotFoundError:
        yield Finding("packages", False, "bayeskin is not installed", "pip install bayeskin")
        return
    for line in requirements:
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
    """Returns the version of an installed package, and None where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def within(version: str, limits: str) -> bool:
    """Returns whether a version lies within limits such as ``>=0.20,<1``; other limits are ignored."""
    numbers = _numbers(version)
    lows = [_numbers(limit) for limit in re.findall(r">=\s*([\d.]+)", limits)]
    highs = [_numbers(limit) for limit in re.findall(r"<(?!=)\s*([\d.]+)", limits)]
    return all(numbers >= low for low in lows) and all(numbers < high for high in highs)


def _numbers(version: str) -> list[int]:
    """Returns the numbers of a version without trailing zeros, so that 1 and 1.0 are the same."""
    numbers = [int(part) for part in re.findall(r"\d+", version.split("+")[0])]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return numbers


def _finding_of(name: str, test: Callable[[], Finding]) -> Finding:
    """Returns the finding of a test; a test that raises any error is a finding too."""
    try:
        return test()
    except Exception as error:  # a broken installation can raise any error
        return Finding(
            name, False, f"{type(error).__name__}: {error}", "a complete installation (reinstall bayeskin)"
        )


def _solver() -> Finding:
    """Returns which linear solver is used."""
    from bayeskin.finite_element import SOLVER_NAME

    slower = "" if SOLVER_NAME == "MKL PARDISO" else " (pypardiso would be faster)"
    return Finding("linear solver", True, SOLVER_NAME + slower)


def _threads() -> Finding:
    """Returns the number of cores and the settings of threads."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    settings = ", ".join(f"{name}={os.environ.get(name, 'unset')}" for name in THREADS)
    return Finding("threads", True, f"{cores} cores; {settings}")


def _disk_space(folder: Path) -> Finding:
    """Returns whether the disk has enough free space for a run."""
    free = shutil.disk_usage(folder).free
    needed = f"at least {LEAST_FREE_BYTES / 1e9:g} GB"
    return Finding("disk space", free >= LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free", needed)


def _write_access(folder: Path) -> Finding:
    """Returns whether files can be written in the folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as handle:
            handle.write(b"bayeskin")
    except OSError as error:
        return Finding(
            "write access", False, f"{folder}: {reason_of(error)}", "a folder in which runs can be written"
        )
    return Finding("write access", True, str(folder))


def full_model_finding() -> Finding:
    """Returns whether a short run of the full model gives the stored force."""
    import numpy as np

    from bayeskin.finite_element import ModelSpec, simulate
    from bayeskin.types import PadMotion

    started = time.perf_counter()
    run = simulate(ModelSpec(), PadMotion(np.array([0.0, 2.0]), np.array([0.0, 2e-3])), THETA)
    if run.status != "ok":
        return Finding("full model", False, run.message, "a run without an error")
    return _compared("full model", float(run.force_n[-1]), FULL_MODEL_N, FULL_MODEL_TOLERANCE, started)


def surrogate_finding() -> Finding:
    """Returns whether the demo's surrogate predicts the stored force."""
    from bayeskin.shipped import shipped
    from bayeskin.surrogates import load_surrogate

    started = time.perf_counter()
    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    prediction = surrogate.predict([[THETA[name] for name in surrogate.space.names]])
    return _compared("surrogate", float(prediction.mean.max()), SURROGATE_N, SURROGATE_TOLERANCE, started)


def _compared(name: str, computed_n: float, stored_n: float, tolerance: float, started: float) -> Finding:
    """Returns whether a force [N] equals the stored force within a relative tolerance."""
    ok = math.isclose(computed_n, stored_n, rel_tol=tolerance)
    seconds = time.perf_counter() - started
    return Finding(
        name, ok, f"{computed_n:.6f} N in {seconds:.1f} s", f"{stored_n:.6f} N within {100 * tolerance:g} %"
    )
