"""Reads tracks of points on the skin from a table, and refuses tracks that do not belong to a recording."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.number_format import number
from bayeskin.probe import bytes_of, refuse_damaged, refuse_endless
from bayeskin.types import Array, Markers, Recording

COLUMNS = ("time", "point", "x", "y")
_REMEDY = "the table needs the columns time (s), point, x (mm), y (mm), and no others"
_STORED = (".h5", ".hdf5")


@dataclass(frozen=True)
class PlausibleTracks:
    """Sizes that tracks of points on the skin can have.

    points, images : least numbers of them; a rigid motion of the camera alone explains one point
    covered : least share of the recording's time that the images span
    rest : largest opening of the pads before the first image, as a share of the largest opening
    jump_m : a point may move by so much more between two images than the pads and the other points do
    largest_m : no skin has points further from its middle; larger values are not in mm
    beyond_s : an image may lie so far outside the recording
    """

    points: int = 3
    images: int = 2
    covered: float = 0.5
    rest: float = 0.02
    jump_m: float = 1e-3
    largest_m: float = 0.5
    beyond_s: float = 0.05


TRACKS = PlausibleTracks()


def read_markers(path: Path | str, recording: Recording, start_s: float = 0.0) -> Markers:
    """Returns the tracks of a file, on the axis of time of their recording.

    The file is a table with the columns time (s), point, x and y (mm), or a file that bayeskin wrote.

    start_s : time in a table that is zero in the recording

    Raises InputError for a file that is no such table, and for tracks that do not belong to the recording.
    """
    path = Path(path)
    refuse_endless(path, "tracks of markers")
    if path.suffix.lower() in _STORED:
        refuse_damaged(path, "tracks in their own HDF5 form")
        markers = _checked_shapes(path, storage.load(path, Markers))
    else:
        markers = markers_of(str(path), bytes_of(path, "tracks of markers"), path.stem, start_s)
    refuse_other_test(str(path), markers, recording)
    return markers


def markers_of(where: str, data: bytes, name: str, start_s: float = 0.0) -> Markers:
    """Returns the tracks of a table, given its bytes.

    Raises InputError for a table with other columns, with cells that are no numbers, with a point twice in an
    image, and with a point that is missing in the first image.
    """
    rows = list(_rows(where, data))
    times = sorted({time_s for _, time_s, _, _ in rows})
    points = list(dict.fromkeys(point for _, _, point, _ in rows))
    for count, least, what in (
        (len(times), TRACKS.images, "times"),
        (len(points), TRACKS.points, "points"),
    ):
        if count < least:
            raise InputError(where, f"the number of {what} is {count}", f"it must be at least {least}")
    of_time = {time_s: number for number, time_s in enumerate(times)}
    of_point = {point: number for number, point in enumerate(points)}
    position_m = np.full((len(times), len(points), 2), np.nan)
    for row, time_s, point, xy_mm in rows:
        cell = position_m[of_time[time_s], of_point[point]]
        if np.isfinite(cell[0]):
            problem = f"point {point!r} is there twice at {number(time_s, 6)} s"
            raise InputError(f"{where}, row {row}", problem, "each point may have one row at each time")
        cell[:] = 1e-3 * np.array(xy_mm)
    lost = np.flatnonzero(~np.isfinite(position_m[0, :, 0]))
    if len(lost):
        problem = f"point {points[lost[0]]!r} has no row at the first time, {number(times[0], 6)} s"
        raise InputError(where, problem, "every point needs its place at rest, which this time gives")
    shifted_s = np.array(times) - start_s
    return Markers(shifted_s, position_m, tuple(points), name, hashlib.sha256(data).hexdigest())


def _rows(where: str, data: bytes) -> Iterator[tuple[int, float, str, tuple[float, float]]]:
    """Yields row number, time [s], point and position [mm] of each row of a table."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(where, "its bytes are no text in UTF-8", _REMEDY) from None
    if "\0" in text:
        raise InputError(where, "its bytes are no text", _REMEDY)
    first = text.partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        header = [cell.strip().lower() for cell in next(reader, [])]
        places = _places(f"{where}, row 1", header)
        for row, cells in enumerate(reader, start=2):
            if any(cell.strip() for cell in cells):
                yield (row, *_numbers(f"{where}, row {row}", cells, places))
    except csv.Error as error:
        raise InputError(where, f"the table cannot be read ({error})", _REMEDY) from None


def _places(where: str, header: Sequence[str]) -> dict[str, int]:
    """Returns the place of each column. Raises InputError for unknown, double or missing columns."""
    unknown = [name for name in header if name not in COLUMNS]
    if unknown:
        raise InputError(where, f"the column {unknown[0][:40]!r} is unknown", _REMEDY)
    for name in COLUMNS:
        if header.count(name) != 1:
            problem = f"the column {name!r} is {'missing' if name not in header else 'there twice'}"
            raise InputError(where, problem, _REMEDY)
    return {name: header.index(name) for name in COLUMNS}


def _numbers(
    where: str, cells: Sequence[str], places: dict[str, int]
) -> tuple[float, str, tuple[float, float]]:
    """Returns time [s], point and position [mm] of a row."""
    if len(cells) != len(COLUMNS):
        raise InputError(where, f"the number of cells is {len(cells)}", f"it must be {len(COLUMNS)}")
    values = {}
    for name in ("time", "x", "y"):
        cell = cells[places[name]].strip()
        try:
            values[name] = float(cell)
        except ValueError:
            values[name] = np.nan
        if not np.isfinite(values[name]):
            problem = f"{cell[:40]!r} in column {name!r} is no finite number"
            raise InputError(where, problem, "leave out the row where a point is not seen")
        if name != "time" and abs(values[name]) > 1e3 * TRACKS.largest_m:
            remedy = f"it must be at most {1e3 * TRACKS.largest_m:g} mm from the middle between the pads"
            raise InputError(where, f"{name} is {number(values[name], 4)} mm", remedy)
    point = cells[places["point"]].strip()
    if not point:
        raise InputError(where, "the cell in column 'point' is empty", "each row needs the name of a point")
    return values["time"], point, (values["x"], values["y"])


def refuse_other_test(where: str, markers: Markers, recording: Recording) -> None:
    """Raises InputError for tracks that lie outside a recording's time, do not cover it, or jump."""
    first_s, last_s, end_s = float(markers.time_s[0]), float(markers.time_s[-1]), float(recording.time_s[-1])
    if first_s < -TRACKS.beyond_s or last_s > end_s + TRACKS.beyond_s:
        problem = f"the images are from {number(first_s, 5)} to {number(last_s, 5)} s on the recording's time"
        remedy = f"they must lie within 0 to {number(end_s, 5)} s, on the clock of the recording's file"
        raise InputError(where, problem, remedy)
    if last_s - first_s < TRACKS.covered * end_s:
        problem = f"the images cover {number(last_s - first_s, 5)} s of {number(end_s, 5)} s"
        raise InputError(where, problem, f"they must cover at least {TRACKS.covered:.0%} of the recording")
    opening_m = np.abs(recording.displacement_m - recording.displacement_m[0])
    before = recording.time_s <= max(first_s, 0.0)
    opened = float(opening_m[before].max() / opening_m.max())
    if opened > TRACKS.rest:
        problem = f"before the first image the pads have opened by {opened:.0%} of their largest opening"
        raise InputError(where, problem, "the first image must show the places at rest")
    _refuse_jumps(where, markers, recording)


def _refuse_jumps(where: str, markers: Markers, recording: Recording) -> None:
    """Raises InputError for a point that moves from one sight to the next as nothing else does."""
    moved_m = markers.position_m - markers.position_m[0]
    moved_m = moved_m - np.nanmedian(moved_m, axis=1, keepdims=True)
    pulled_m = np.concatenate([[0.0], np.cumsum(_pulled(markers.time_s, recording))])
    for point, name in enumerate(markers.points):
        seen = np.flatnonzero(np.isfinite(moved_m[:, point, 0]))
        step_m = np.linalg.norm(np.diff(moved_m[seen, point], axis=0), axis=1)
        allowed_m = np.diff(pulled_m[seen])
        worst = int(np.argmax(step_m - allowed_m)) if len(step_m) else 0
        if len(step_m) and step_m[worst] > allowed_m[worst] + TRACKS.jump_m:
            at_s = number(float(markers.time_s[seen[worst + 1]]), 6)
            problem = f"point {name!r} moves {number(1e3 * step_m[worst])} mm from the others up to {at_s} s"
            remedy = (
                f"skin moves at most {1e3 * TRACKS.jump_m:g} mm more than the pads, which move "
                f"{number(1e3 * allowed_m[worst])} mm: leave out the rows where the track is lost"
            )
            raise InputError(where, problem, remedy)


def _pulled(time_s: Array, recording: Recording) -> Array:
    """Returns by how much [m] the pads' opening varies between one image and the next, (t - 1,)."""
    opening_m, at_images = recording.displacement_m, np.searchsorted(recording.time_s, time_s)
    at_times_m = np.interp(time_s, recording.time_s, opening_m)
    return np.array([
        np.ptp(np.concatenate([at_times_m[i : i + 2], opening_m[at_images[i] : at_images[i + 1]]]))
        for i in range(len(time_s) - 1)
    ])  # fmt: skip


def _checked_shapes(path: Path, markers: Markers) -> Markers:
    """Returns stored markers. Raises InputError for arrays that do not fit together."""
    t, p = len(markers.time_s), len(markers.points)
    valid = (
        markers.time_s.ndim == 1
        and markers.position_m.shape == (t, p, 2)
        and markers.position_m.dtype.kind == markers.time_s.dtype.kind == "f"
        and t >= TRACKS.images
        and p >= TRACKS.points
        and bool(np.all(np.isfinite(markers.time_s)) and np.all(np.diff(markers.time_s) > 0))
        and bool(np.all(np.isfinite(markers.position_m[0])))
    )
    if not valid:
        raise InputError(path, "its arrays do not fit together", "bayeskin import must write it again")
    return markers
