"""Markers in a configuration: what is refused, and what reaches the stages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys.command_line import Command, assert_refused

from bayeskin import storage
from bayeskin.config import load_config
from bayeskin.errors import InputError
from bayeskin.types import Markers, Recording
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.stages import run

TIME_S = np.arange(0.0, 30.0, 0.05)
OPENING_M = 1e-3 * np.interp(TIME_S, [0, 2, 6, 20, 24, 30], [0, 0, 4, 4, 0, 0])
AT_S = np.arange(0.0, 30.0, 1.0)
PLACES_M = 1e-3 * np.array([[-12.0, 3.0], [0.0, -6.5], [9.5, 0.25]])


def imported(folder: Path, places_m: np.ndarray = PLACES_M) -> Path:
    """A recording and its tracks, as the importer leaves them; returns the recording's path."""
    noise_n = 1e-3 * np.random.default_rng(1).standard_normal(len(TIME_S))
    recording = Recording(TIME_S, OPENING_M, 100.0 * OPENING_M + noise_n, "arm", "0")
    stretch = np.interp(AT_S, TIME_S, OPENING_M)[:, None, None] / 36e-3
    markers = Markers(AT_S, places_m * (1.0 + stretch * [1.0, -0.3]), ("a", "b", "c"), "tracks", "1")
    storage.save(folder / "arm.h5", recording)
    storage.save(folder / "arm-markers.h5", markers)
    return folder / "arm.h5"


def test_new_writes_the_tracks_that_lie_beside_the_recording(bayeskin: Command, tmp_path: Path) -> None:
    code, out, _ = bayeskin("new", imported(tmp_path))
    assert code == 0
    assert "shipped surrogate" not in out  # it knows the force only
    recording = load_config(tmp_path / "arm.toml").recording
    assert recording is not None
    assert recording.markers == "arm-markers.h5"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[recording]\nfile = "arm.h5"\nmarkers = "m.h5"\n[surrogate]\nfile = "s.h5"\n', "surrogate.file"),
        ('[[recordings]]\nfile = "a.h5"\nmarkers = "m.h5"\n[[recordings]]\nfile = "b.h5"\n', "several"),
        ('[recording]\nfile = "arm.h5"\nmarkers = "m.h5"\n[model]\nmesh = "skin.msh"\n', "'skin.msh'"),
    ],
)
def test_a_configuration_without_their_model_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "arm.toml").write_text(f'name = "arm"\n{text}')
    with pytest.raises(InputError, match=says):
        load_config(tmp_path / "arm.toml")


def test_points_outside_of_the_skin_are_refused_before_a_model_runs(tmp_path: Path) -> None:
    imported(tmp_path, PLACES_M * [1.0, 10.0])
    (tmp_path / "arm.toml").write_text(
        'name = "arm"\n[recording]\nfile = "arm.h5"\nmarkers = "arm-markers.h5"\n'
    )
    with pytest.raises(InputError, match=r"arm-markers\.h5: a point at x 0 mm, y -65 mm is outside the skin"):
        run(tmp_path / "arm.toml", "recording", Silent())


def test_tracks_of_another_test_are_refused(bayeskin: Command, tmp_path: Path) -> None:
    imported(tmp_path)
    markers = storage.load(tmp_path / "arm-markers.h5", Markers)
    other = Markers(markers.time_s + 20.0, markers.position_m, markers.points, "other", "2")
    storage.save(tmp_path / "arm-markers.h5", other)
    (tmp_path / "arm.toml").write_text(
        'name = "arm"\n[recording]\nfile = "arm.h5"\nmarkers = "arm-markers.h5"\n'
    )
    assert_refused(bayeskin("run", tmp_path / "arm.toml"), "20 to 49 s", "0 to 29.95 s")
