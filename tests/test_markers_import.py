"""Tracks of points on the skin: the reader, its refusals, and `bayeskin import --markers`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys.command_line import Command, assert_refused

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.recordings import read_markers
from bayeskin.recordings.markers import markers_of
from bayeskin.types import Markers, Recording

START_S = 100.0
TIME_S = np.arange(0.0, 60.0, 0.05)
OPENING_MM = np.interp(TIME_S, [0, 5, 10, 30, 35, 60], [0, 0, 6, 6, 0, 0])
AT_S = np.arange(0.0, 60.0, 2.0)
PLACES_MM = np.array([[-12.0, 3.0], [0.0, -6.5], [9.5, 0.25], [14.0, 7.0]])


def recording() -> Recording:
    return Recording(TIME_S, 1e-3 * OPENING_MM, 0.1 * OPENING_MM, "arm", "0")


def rows(at_s: np.ndarray = AT_S) -> list[list[str]]:
    """The table's rows: points between the pads follow these in proportion to their place."""
    stretch = np.interp(at_s, TIME_S, OPENING_MM) / 36.0
    return [
        [f"{START_S + t:.3f}", f"p{p}", f"{x * (1 + e):.6f}", f"{y * (1 - 0.3 * e):.6f}"]
        for t, e in zip(at_s, stretch, strict=True)
        for p, (x, y) in enumerate(PLACES_MM)
    ]


def table(body: list[list[str]], header: str = "time,point,x,y") -> bytes:
    return "\n".join([header, *(",".join(row) for row in body)]).encode()


def recording_csv(folder: Path) -> Path:
    path = folder / "arm.csv"
    noise = 1e-3 * np.random.default_rng(3).standard_normal(len(TIME_S))
    columns = np.column_stack([TIME_S + START_S, OPENING_MM, 0.1 * OPENING_MM + noise])
    np.savetxt(path, columns, "%.6f", ",", header="time (s),displacement (mm),force (N)", comments="")
    return path


def test_markers_share_the_time_of_their_recording(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_bytes(table(rows()))
    out = tmp_path / "r.h5"
    code, said, _ = bayeskin(
        "import", recording_csv(tmp_path), "-o", out, "--markers", tmp_path / "tracks.csv", "--json"
    )
    assert code == 0
    facts = json.loads(said)["markers"]
    assert (facts["points"], facts["images"], facts["not_seen"]) == (4, 30, 0)
    markers = storage.load(tmp_path / "r-markers.h5", Markers)
    np.testing.assert_allclose(markers.time_s, AT_S, atol=1e-9)
    np.testing.assert_allclose(markers.reference_m, 1e-3 * PLACES_MM, atol=1e-9)
    at_20 = int(np.searchsorted(AT_S, 20.0)) - 1
    np.testing.assert_allclose(markers.displacement_m[at_20, :, 0], 1e-3 * PLACES_MM[:, 0] / 6, atol=1e-8)
    again = read_markers(tmp_path / "r-markers.h5", storage.load(out, Recording))
    np.testing.assert_array_equal(again.position_m, markers.position_m)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda b: table(b, "time,point,x,y").replace(b"x,y", b"x,z"), ["row 1", "'z'", "time (s), point"]),
        (lambda b: table([row[:3] for row in b], "time,point,x"), ["the column 'y' is missing"]),
        (lambda b: table([*b, b[-1]]), ["'p3' is there twice"]),
        (lambda b: table(b[1:]), ["'p0' has no row at the first time"]),
        (lambda b: table([[*b[0][:2], "one", "2"], *b[1:]]), ["row 2", "'one' in column 'x'"]),
        (lambda b: table([[*b[0][:2], "nan", "2"], *b[1:]]), ["'nan' in column 'x'"]),
        (lambda b: table([[*b[0][:2], "12000", "2"], *b[1:]]), ["x is 12000 mm", "500 mm"]),
        (lambda b: table([row for row in b if row[1] in ("p0", "p1")]), ["points is 2", "at least 3"]),
        (lambda b: table([row for row in b if float(row[0]) < 112]), ["cover 10 s of 59.95 s"]),
        (lambda b: table([row for row in b if float(row[0]) > 111]), ["opened by 100%"]),
        (lambda b: table([[str(float(row[0]) - 100), *row[1:]] for row in b]), ["100 to"]),
        (lambda b: table([*b[:40], [b[40][0], "p0", "-4", "3"], *b[41:]]), ["'p0' moves 8.83", "move 0 mm"]),
        (lambda b: b"", ["'time' is missing"]),
        (lambda b: b"\xff\xfe\x00", ["no text in UTF-8"]),
    ],
)  # fmt: skip
def test_a_fault_is_told_in_one_line_and_nothing_is_written(
    bayeskin: Command, tmp_path: Path, change: object, says: list[str]
) -> None:
    (tmp_path / "tracks.csv").write_bytes(change(rows()))  # type: ignore[operator]
    answer = bayeskin(
        "import", recording_csv(tmp_path), "-o", tmp_path / "r.h5", "--markers", tmp_path / "tracks.csv"
    )
    assert_refused(answer, *says)
    assert not list(tmp_path.glob("*.h5"))


def test_markers_belong_to_a_single_table(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_bytes(table(rows()))
    answer = bayeskin(
        "import", recording_csv(tmp_path), "-o", tmp_path / "r.h5", "--sheet", "all", "--markers",
        tmp_path / "tracks.csv",
    )  # fmt: skip
    assert_refused(answer, "--markers", "--sheet all")


def test_a_lost_track_may_return_where_the_skin_is_then(tmp_path: Path) -> None:
    body = [row for row in rows() if not (row[1] == "p0" and 104 < float(row[0]) < 112)]
    (tmp_path / "tracks.csv").write_bytes(table(body))
    markers = read_markers(tmp_path / "tracks.csv", recording(), START_S)
    assert int(np.sum(~np.isfinite(markers.position_m[:, 0, 0]))) == 3


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 100.0).map(lambda t: round(t, 3)), st.sampled_from(["a", "b", "c", "ü"]),
            st.floats(-400, 400), st.floats(-400, 400),
        ),
        min_size=12, max_size=40, unique_by=lambda row: row[:2],
    ),
    st.permutations(["time", "point", "x", "y"]),
    st.sampled_from([",", ";", "\t"]),
)  # fmt: skip
def test_every_row_of_a_table_is_where_it_belongs(
    body: list[tuple[float, str, float, float]], order: list[str], delimiter: str
) -> None:
    first = min(row[0] for row in body) - 1.0
    body = [*((first, point, 1.0, 2.0) for point in ("a", "b", "c", "ü")), *body]
    cells = [dict(zip(("time", "point", "x", "y"), map(str, row), strict=True)) for row in body]
    text = "\r\n".join([delimiter.join(order), *(delimiter.join(row[n] for n in order) for row in cells)])
    markers = markers_of("t.csv", text.encode(), "t", start_s=first)
    assert int(np.isfinite(markers.position_m[..., 0]).sum()) == len(body)
    for time_s, point, x, y in body:
        image = int(np.argmin(np.abs(markers.time_s - (time_s - first))))
        at = markers.position_m[image, markers.points.index(point)]
        np.testing.assert_allclose(1e3 * at, [x, y], rtol=1e-12, atol=1e-9)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_damaged_table_is_read_or_refused_in_one_line(seed: int) -> None:
    rng, data = np.random.default_rng(seed), bytearray(table(rows()[:40]))
    for _ in range(int(rng.integers(1, 5))):
        at, long = int(rng.integers(len(data))), int(rng.integers(1, 30))
        data[at : at + long] = rng.bytes(long) if rng.integers(2) else b""
    refused = ""
    try:
        markers = markers_of("t.csv", bytes(data), "t")
    except InputError as error:
        refused = str(error)
    assert refused.count("\n") == 0
    assert refused or np.all(np.isfinite(markers.position_m[0]))
