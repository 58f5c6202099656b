"""A file becomes a recording in SI, or one line that says which row is wrong, and how."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toys.synthetic_recordings import article_recording

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.recordings import Stated, read_recording, stated_unit, uniform_edges
from bayeskin.recordings.headers import parse_header
from bayeskin.types import Recording

SAMPLES = 200
TIME = 0.05 * np.arange(SAMPLES)
TRAVEL_MM = np.round(np.clip(TIME - 1.0, 0.0, 5.0), 4)
FORCE_N = np.round(0.08 * TRAVEL_MM - 0.02, 5)
ROWS = [list(map(str, row)) for row in zip(TIME.round(4), TRAVEL_MM, FORCE_N, strict=True)]
HEADER = ["Temps (s)", "Déplacement (mm)", "RF (N)"]


def written(path: Path, rows: Sequence[Sequence[str]], delimiter: str = ",", encoding: str = "utf-8") -> Path:
    path.write_bytes("\n".join(delimiter.join(row) for row in rows).encode(encoding))
    return path


def workbook(path: Path, **sheets: Sequence[Sequence[object]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
    book.save(path)
    return path


NUMBERS = [[float(cell) for cell in row] for row in ROWS]


def assert_is_the_test(recording: Recording) -> None:
    np.testing.assert_allclose(recording.time_s, TIME, atol=1e-12)
    np.testing.assert_allclose(recording.displacement_m, 1e-3 * TRAVEL_MM, atol=1e-15)
    np.testing.assert_allclose(recording.force_n, FORCE_N, atol=1e-15)


def assert_sound_or_refused_in_one_line(path: Path) -> None:
    refusal, recording = "", None
    try:
        recording = read_recording(path)
    except InputError as error:
        refusal = str(error)
    assert "\n" not in refusal
    if recording is not None:
        assert len(recording.time_s) == len(recording.force_n) == len(recording.displacement_m) >= 50
        assert np.isfinite([recording.time_s, recording.displacement_m, recording.force_n]).all()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize(
    ("name", "delimiter", "comma"),
    [
        ("a.csv", ",", False),
        ("a.csv", ";", False),
        ("a.csv", ";", True),
        ("a.tsv", "\t", True),
        ("a.txt", "  ", True),
    ],
)
def test_text_in_any_usual_dress_gives_the_same_recording(
    tmp_path: Path, name: str, delimiter: str, comma: bool, encoding: str
) -> None:
    rows = [[cell.replace(".", ",") for cell in row] for row in ROWS] if comma else ROWS
    path = written(tmp_path / name, [HEADER, *rows], delimiter, encoding)
    recording = read_recording(path)
    assert_is_the_test(recording)
    assert recording.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert "column 'Déplacement (mm)' read as displacement in mm" in recording.notes


@pytest.mark.parametrize(
    ("header", "quantity", "unit"),
    [
        ("Temps (s)", "time", "s"), ("time_s", "time", "s"), ("t [ms]", "time", "ms"),
        ("Time, min", "time", "min"),
        ("Déplacement (mm)", "displacement", "mm"), ("DEPLACEMENT [MM]", "displacement", "mm"),
        ("displacement_m", "displacement", "m"), ("disp (µm)", "displacement", "um"),
        ("LVDT mm", "displacement", "mm"), ("Réaction", "force", ""),
        ("RF (N)", "force", "N"), ("force_n", "force", "N"), ("Effort [mN]", "force", "mN"),
        ("Displacement rate (mm/s)", "displacement", "mm/s"), ("Temps (mn)", "time", "min"),
        ("Load / kgf", "force", "kgf"), ("Position (z), mm", "displacement", "mm"), ("Fz, gf", "force", "gf"),
        ("Load(Linear:Load) (lbf)", "force", "lbf"), ("Displacement (Ch 1) [in]", "displacement", "in"),
        ("Temps d'essai", "time", ""), ("Standardkraft", "force", ""), ("# time_ms", "time", "ms"),
        ("変位（ｍｍ）", "displacement", "mm"), ("荷重 [N]", "force", "N"), ("時間 [秒]", "time", "s"),
        ("Extension (%)", "displacement", "%"), ("AxialForce_uN", "force", "uN"),
    ],
)  # fmt: skip
def test_headers_name_quantity_and_unit(header: str, quantity: str, unit: str) -> None:
    column = parse_header(0, header)
    assert column is not None
    assert (column.quantity, column.unit) == (quantity, unit)


@pytest.mark.parametrize(
    "header",
    ["Temperature (C)", "pressure", "", "n", "Force per displacement (N/mm)", "Température d'ambiance", "d0",
     "Fmax", "圧力 (kPa)"],
)  # fmt: skip
def test_other_headers_name_nothing(header: str) -> None:
    assert parse_header(0, header) is None


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("Displacement setpoint (mm)", "a set point"), ("Sollweg Traverse (mm)", "a set point"),
        ("Load step", "a count"), ("荷重設定値 (N)", "a set point"), ("Vitesse course (mm/s)", "a rate"),
        ("Force min (N)", "an extreme or a limit"), ("Clock time (s)", "a time of day"),
        ("Time, min", ""), ("Elapsed Time (s)", ""),
    ],
)  # fmt: skip
def test_headers_of_what_was_not_measured_say_so(header: str, reason: str) -> None:
    column = parse_header(0, header)
    assert column is not None
    assert column.aside == reason


def test_units_become_si(tmp_path: Path) -> None:
    rows = [[str(1e3 * t), str(1e3 * u), str(1e3 * f)] for t, u, f in NUMBERS]
    assert_is_the_test(
        read_recording(written(tmp_path / "a.csv", [["t [ms]", "disp (µm)", "Effort_mN"], *rows]))
    )


def test_units_may_stand_in_a_row_of_their_own_below_a_preamble(tmp_path: Path) -> None:
    rows = [["operator", "A"], [], ["Time", "Displacement", "Force"], ["[s]", "[mm]", "[N]"], *ROWS]
    assert_is_the_test(read_recording(written(tmp_path / "a.csv", rows, ";")))


def test_a_unit_left_out_is_asked_for(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", [["time (s)", "disp", "force"], *ROWS])
    said = r"the unit of 'disp', 'force' is not known; .* --unit displacement=UNIT --unit force=UNIT"
    with pytest.raises(InputError, match=said):
        read_recording(path)
    units = {"displacement": stated_unit("displacement", "mm"), "force": stated_unit("force", "N")}
    recording = read_recording(path, stated=Stated(units=units))
    assert_is_the_test(recording)
    assert "column 'force' read as force in N (stated by --unit)" in recording.notes


def test_further_columns_and_rates_are_named_and_ignored(tmp_path: Path) -> None:
    rows = [[*row, "1", "2"] for row in ROWS]
    path = written(tmp_path / "a.csv", [[*HEADER, "Displacement rate (mm/s)", "note"], *rows])
    recording = read_recording(path)
    assert_is_the_test(recording)
    assert "ignored columns: 'Displacement rate (mm/s)' (a rate), 'note'" in recording.notes


def test_a_clock_that_starts_late_is_shifted_and_noted(tmp_path: Path) -> None:
    rows = [[str(float(t) + 12.5), u, f] for t, u, f in ROWS]
    recording = read_recording(written(tmp_path / "a.csv", [HEADER, *rows]))
    np.testing.assert_allclose(recording.time_s, TIME, atol=1e-9)
    assert any("starts at 12.5 s" in note for note in recording.notes)


def test_workbooks_are_read_from_the_one_sheet_with_the_columns(tmp_path: Path) -> None:
    path = workbook(tmp_path / "a.xlsx", Notes=[["hello"]], Test=[HEADER, *NUMBERS])
    assert_is_the_test(read_recording(path))
    both = workbook(tmp_path / "b.xlsx", A=[HEADER, *NUMBERS], B=[HEADER, *NUMBERS])
    with pytest.raises(InputError, match=r"2 of its tables 'A', 'B' .*--sheet"):
        read_recording(both)
    assert_is_the_test(read_recording(both, sheet="B"))
    with pytest.raises(InputError, match="no sheet or table 'C'"):
        read_recording(both, sheet="C")


def test_a_formula_without_a_stored_value_is_refused_with_its_row(tmp_path: Path) -> None:
    rows: list[list[object]] = [list(row) for row in NUMBERS]
    rows[7][2] = "=1+1"
    path = workbook(tmp_path / "a.xlsx", Test=[HEADER, *rows])
    with pytest.raises(InputError, match=r"row 9, column 'RF \(N\)': the cell is empty, or has a formula"):
        read_recording(path)


def test_h5_keeps_the_recording(tmp_path: Path) -> None:
    recording = read_recording(written(tmp_path / "a.csv", [HEADER, *ROWS]))
    storage.save(tmp_path / "a.h5", recording)
    again = read_recording(tmp_path / "a.h5")
    assert_is_the_test(again)
    assert (again.sha256, again.notes, again.name) == (recording.sha256, recording.notes, "a")


def spoiled(row: int, column: int, text: str) -> list[list[str]]:
    rows = [list(r) for r in ROWS]
    rows[row][column] = text
    return [HEADER, *rows]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([HEADER[:2], *[row[:2] for row in ROWS]], r"row 1: .*force column .*is needed"),
        (
            [[*HEADER, "Force (N)"], *[[*row, row[1]] for row in ROWS]],
            r"'RF \(N\)' and 'Force \(N\)' are force columns; .*--force NAME or NUMBER",
        ),
        (
            [["Temps (s)", "Displacement (px)", "RF (N)"], *ROWS],
            r"'Displacement \(px\)' is in the unit 'px'; .* m, cm, mm, .*--displacement",
        ),
        (
            spoiled(3, 1, "abc"),
            r"row 5, column 'Déplacement \(mm\)': the cell contains 'abc'; it must be a number",
        ),
        (spoiled(3, 1, ""), r"row 5, .*the cell is empty"),
        (spoiled(3, 0, "10:00:01"), r"row 5, .*a date or a time of day, '10:00:01'"),
        (spoiled(3, 1, "1,5"), r"row 5, .*contains '1,5'; it must be a number with the decimal sign '.'"),
        (spoiled(3, 1, "1_0"), r"row 5, .*contains '1_0'; it must be a number"),
        (spoiled(3, 2, "nan"), r"row 5, column 'RF \(N\)': the value is nan; it must be a finite number"),
        (spoiled(3, 2, "-inf"), r"row 5, .*the value is -inf"),
        (spoiled(9, 0, "0.4"), r"row 11: the time is 0.4 s after 0.4 s"),
        (spoiled(9, 0, "0.1"), r"row 11: the time is 0.1 s after 0.4 s"),
        (
            [["Temps (s)", "Disp (m)", "RF (N)"], *ROWS],
            r"the displacement is .* m; .*is the column in mm\?",
        ),
        (
            [["Temps (s)", "Disp (um)", "RF (N)"], *ROWS],
            r"the displacement changes by .*is its unit right",
        ),
        (spoiled(3, 2, "2000"), r"row 5: the force is 2000 N; .*is the column in mN\?"),
        ([HEADER, *ROWS[:40]], r"samples is 40; it must be at least 50"),
        ([HEADER], r"no rows of numbers"),
        (
            [*[HEADER], *ROWS[:20], ROWS[20][:2], *ROWS[21:]],
            r"row 22: the number of cells is 2; it must be 3",
        ),
        (
            [*[HEADER], *ROWS[:20], [*ROWS[20], "7"], *ROWS[21:]],
            r"row 22: the number of cells is 4; it must be 3",
        ),
        ([*[HEADER], *ROWS[:20], [], *ROWS[21:]], r"row 22: it is empty, although numbers follow in row 23"),
        (
            ROWS,
            r"no names stand above rows of 3 cells; .* import with --time 1 --displacement 2",
        ),
        ([["some", "text"]], r"no rows of numbers"),
        (
            [*[HEADER], *ROWS[:20], ["n/a"] * 3, *ROWS[21:]],
            r"row 22: 'n/a n/a n/a' stands between rows of numbers",
        ),
    ],
)
def test_a_fault_is_named_with_its_place(tmp_path: Path, rows: list[list[str]], said: str) -> None:
    path = written(tmp_path / "fault.csv", rows, ";")
    with pytest.raises(InputError, match=said) as caught:
        read_recording(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", [HEADER, *ROWS], ";")
    assert_is_the_test(read_recording(path, sheet="1"))
    with pytest.raises(InputError, match=r"no sheet or table 'Test 3'; use one of '1'"):
        read_recording(path, sheet="Test 3")


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.csv", b"", "the file is empty"), ("a.csv", b" \n\n", "the file is empty"),
        ("a.csv", b"\x00\x01\x81", "not text"), ("a.csv", b"t,d,f\n1,1\x002,3\n", "NUL within a number"),
        ("a.txt", b"t_s d_mm f_N T_C\n" + 60 * b"1 2 3 4\n" + b"1 2 4\n", "row 62: the number of cells is 3"),
        ("a.xlsx", b"PK\x03\x04 no workbook", "an xlsx workbook"), ("a.xlsx", b"", "an xlsx workbook"),
        ("a.h5", b"\x89HDF\r\n\x1a\n", "HDF5"), ("a.pdf", b"%PDF", "ending '.pdf'"),
    ],
)  # fmt: skip
def test_files_that_are_nothing_are_refused(tmp_path: Path, name: str, data: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said):
        read_recording(tmp_path / name)


def test_a_file_that_is_absent_or_a_folder_is_refused(tmp_path: Path) -> None:
    for path, message in ((tmp_path / "absent.csv", "there is no such file"), (tmp_path, "it is a folder")):
        with pytest.raises(InputError, match=f": {message}; bayeskin needs a recording"):
            read_recording(path)


@pytest.mark.parametrize("ending", [".csv", ".xlsx", ".h5", ""])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path, ending: str) -> None:
    os.mkfifo(tmp_path / f"pipe{ending}")
    with pytest.raises(InputError, match="a pipe or a device instead of a file; bayeskin needs a recording"):
        read_recording(tmp_path / f"pipe{ending}")


def test_a_file_beyond_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with open(tmp_path / "a.csv", "wb") as handle:
        handle.truncate(2**31 + 1)  # a hole: takes no room
    with pytest.raises(InputError, match="2147483649 bytes; bayeskin needs a recording, of at most"):
        read_recording(tmp_path / "a.csv")


def test_bins_beyond_memory_are_refused() -> None:
    for width_s, end_s in ((1e-9, 130.0), (1e-320, 130.0), (0.5, 1e300), (0.5, np.nan)):
        with pytest.raises(InputError, match=r"bin_width_s: .*; use a width that gives fewer"):
            uniform_edges(end_s, width_s)


@pytest.mark.parametrize("ending", [".xlsx", ".h5"])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, ending: str) -> None:
    whole = workbook(tmp_path / "whole.xlsx", Test=[HEADER, *NUMBERS])
    if ending == ".h5":
        storage.save(tmp_path / "whole.h5", read_recording(whole))
    data = (tmp_path / f"whole{ending}").read_bytes()
    for share in (0.02, 0.3, 0.6, 0.9, 0.99):
        (tmp_path / f"cut{ending}").write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError):
            read_recording(tmp_path / f"cut{ending}")


def test_a_workbook_with_wrong_bytes_in_it_is_read_or_refused(tmp_path: Path) -> None:
    whole = workbook(tmp_path / "whole.xlsx", Test=[HEADER, *NUMBERS])
    data = np.frombuffer(whole.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(5)
    for _ in range(40):
        bad = data.copy()
        bad[rng.integers(len(bad), size=20)] = rng.integers(256, size=20)
        (tmp_path / "bad.xlsx").write_bytes(bad.tobytes())
        assert_sound_or_refused_in_one_line(tmp_path / "bad.xlsx")


CELL = st.one_of(
    st.floats().map(str),
    st.integers().map(str),
    st.sampled_from(["", " ", "1,5", '"', "'", "=A1", "nan", "s", "mm", "N"]),
    st.text(max_size=6),
)
TABLE = st.builds(
    lambda header, rows, delimiter, end: end.join([header, *(delimiter.join(row) for row in rows)]).encode(
        "utf-8", "surrogatepass"
    ),
    st.sampled_from(
        ["t;disp;force", "Temps (s),Deplacement (mm),RF (N)", "time\tu\tforce", "t disp f", "force;time;d;x"]
    ),
    st.lists(st.lists(CELL, max_size=5), max_size=8),
    st.sampled_from(";,\t "),
    st.sampled_from(["\n", "\r\n", "\r"]),
)


@given(
    data=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(str.encode), TABLE), long=st.booleans()
)
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_at_all_are_a_recording_or_an_input_error(tmp_path: Path, data: bytes, long: bool) -> None:
    path = tmp_path / "fuzz.csv"
    tail = "\n".join(";".join(row) for row in ROWS).encode()
    path.write_bytes(data + b"\n" + tail if long else data)
    assert_sound_or_refused_in_one_line(path)


@given(
    st.lists(st.floats(-50, 50, allow_subnormal=False), min_size=100, max_size=120),
    st.sampled_from([",", ";", "\t"]),
    st.booleans(),
)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_what_is_read(
    tmp_path: Path, force: list[float], delimiter: str, comma: bool
) -> None:
    rows = [[repr(0.1 * i), repr(0.05 * i), repr(f)] for i, f in enumerate(force)]
    if comma and delimiter != ",":
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    either_sign = Stated(units={"force": stated_unit("force", "+N")})
    recording = read_recording(written(tmp_path / "a.csv", [HEADER, *rows], delimiter), stated=either_sign)
    assert recording.force_n.tolist() == force


def test_the_articles_recording_is_read_whole() -> None:
    recording = article_recording()
    assert len(recording.time_s) == 34740
    assert recording.time_s[0] == 0.0
    assert recording.time_s[-1] == pytest.approx(347.39)
    assert recording.displacement_m.max() == pytest.approx(9.46e-3)
    assert recording.force_n[0] == -0.077
    assert recording.notes == tuple(
        f"column {name} read as {what}"
        for name, what in (
            ("'Temps (s)'", "time in s"),
            ("'Deplacement (mm)'", "displacement in mm"),
            ("'RF (N)'", "force in N"),
        )
    )  # fmt: skip
