"""A recording for the command line, and how a refusal of it looks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from toys import stand_in_model
from toys.closed_form_model import MOTION, toy_force

THETA = np.array([[200e3, 30e3, 1e-14, 1e-13, 300.0]])


def measured_csv(path: Path) -> Path:
    """Writes a sound recording as CSV; returns its path."""
    time_s = np.arange(0.0, 130.001, 0.1)
    noise_n = 0.003 * np.random.default_rng(5).standard_normal(len(time_s))
    force_n = stand_in_model.SCALE * toy_force(THETA, time_s)[0] + noise_n
    write_csv(path, "time (s),displacement (mm),force (N)", time_s, 1e3 * MOTION.at(time_s), force_n)
    return path


def write_csv(path: Path, header: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.9g")


Command = Callable[..., tuple[int, str, str]]


def assert_refused(answer: tuple[int, str, str], *says: str) -> None:
    """Exit code 2, nothing on stdout, and one line that names the fault."""
    code, out, err = answer
    line = err.splitlines()[-1]
    assert code == 2
    assert out == ""
    assert line.startswith("bayeskin: ")
    assert "Traceback" not in err
    assert [text for text in err.splitlines() if text.startswith("bayeskin: ")] == [line]
    for part in says:
        assert part in line
