"""Checks an installation: packages, linear solver, working folder and models.

The parts of bayeskin that run models are imported only in their own check. A broken part is thus reported as
a finding, and does not end the program. The command line itself needs click and rich.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayeskin
from bayeskin.errors import reason_of
from bayeskin.workflow.doctor_models import Finding, cores, finding_of, findings_of_models
from bayeskin.workflow.remedies import install, reinstall

if TYPE_CHECKING:
    from bayeskin.workflow.engine import Reporter

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
PYTHON = "install bayeskin with a newer Python: python3.11 -m venv .venv && .venv/bin/python -m pip install ."
LEAST_FREE_BYTES = 500_000_000  # a run's folder with its chains takes a tenth of this
_REQUIREMENT = re.compile(r"^([A-Za-z0-9_.-]+)\s*(?:\[[^]]*\])?\s*([^;]*?)\s*(?:;\s*(.*))?$")


def examine(folder: Path, reporter: Reporter) -> dict[str, Any]:
    """Returns the answer of `bayeskin doctor` for a folder; ``ok`` is False if something is broken."""
    packages = list(_packages())
    findings = [
        Finding("bayeskin", True, bayeskin.__version__),
        Finding(
            "python", sys.version_info >= (3, 11), platform.python_version(), "Python 3.11 or newer", PYTHON
        ),
        *packages,
        finding_of("linear solver", _solver),
        _threads(),
        finding_of("disk space", partial(_disk_space, folder)),
        _write_access(folder),
        *findings_of_models(reporter),
    ]
    ok = all(finding.ok for finding in findings)
    lines = [
        f"{'ok    ' if finding.ok else 'BROKEN'}  {finding.name}: {finding.state}"
        + ("" if finding.ok else f"; needed: {finding.needed}; remedy: {finding.remedy}")
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
        yield Finding("packages", False, "bayeskin is not installed", "an installed bayeskin", reinstall())
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
            yield Finding(name, within(version, limits), version, limits, install(f"{name}{limits}"))
        elif not marker:
            yield Finding(name, False, "not installed", limits or "any version", install(f"{name}{limits}"))


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


def _solver() -> Finding:
    """Returns which linear solver is used."""
    from bayeskin.finite_element import SOLVER_NAME

    slower = "" if SOLVER_NAME == "MKL PARDISO" else " (pypardiso would be faster)"
    return Finding("linear solver", True, SOLVER_NAME + slower)


def _threads() -> Finding:
    """Returns the number of cores and the settings of threads."""
    settings = ", ".join(f"{name}={os.environ.get(name, 'unset')}" for name in THREADS)
    return Finding("threads", True, f"{cores()} cores; {settings}")


def _disk_space(folder: Path) -> Finding:
    """Returns whether the disk has enough free space for a run."""
    free = shutil.disk_usage(folder).free
    needed = f"at least {LEAST_FREE_BYTES / 1e9:g} GB"
    remedy = f"remove files from the disk of {folder}, or work in a folder on another disk"
    return Finding("disk space", free >= LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free", needed, remedy)


def _write_access(folder: Path) -> Finding:
    """Returns whether files can be written in the folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as handle:
            handle.write(b"bayeskin")
    except OSError as error:
        needed, remedy = "a folder in which runs can be written", "work in a folder of your own: cd ~"
        return Finding("write access", False, f"{folder}: {reason_of(error)}", needed, remedy)
    return Finding("write access", True, str(folder))
