"""`bayeskin import` takes what a user states, says what it took for what, and writes each table."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from toys.command_line import Command, assert_refused
from toys.laboratory_exports import NAMED, PULLED_MM, TIME_S, F, T
from toys.laboratory_files import cells, fixed, text, workbook

from bayeskin import storage
from bayeskin.types import Recording

BARE = text([["clock", "pull", "cell"], *cells(T, fixed(-PULLED_MM - 7, 3), F)], ",")


def test_everything_can_be_stated(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "bare.csv").write_bytes(BARE)
    code, out, err = bayeskin(
        "import", tmp_path / "bare.csv", "-o", tmp_path / "r.h5", "--time", "clock", "--displacement", "2",
        "--force", "CELL", "--unit", "time=s", "--unit", "displacement=-mm", "--unit", "force=mN", "--zero",
        "--json",
    )  # fmt: skip
    said = json.loads(out)
    assert code == 0
    assert err.splitlines() == [
        "column 'clock' read as time in s (stated by --unit)",
        "column 'pull' read as displacement in -mm (stated by --unit), with its sign turned",
        "column 'cell' read as force in mN (stated by --unit)",
        "--zero subtracted the first displacement, 7 mm",
    ]
    assert said["columns"]["displacement"] == {
        "number": 2,
        "header": "pull",
        "unit": "mm",
        "factor_to_si": -1e-3,
    }
    assert said["zero_m"] == pytest.approx(7e-3)
    recording = storage.load(tmp_path / "r.h5", Recording)
    np.testing.assert_allclose(1e3 * recording.displacement_m, PULLED_MM, atol=1e-9)
    np.testing.assert_allclose(1e3 * recording.force_n, np.array(F, dtype=float), atol=1e-9)


def test_the_text_has_the_answer_and_stderr_what_was_taken_for_what(
    bayeskin: Command, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_bytes(text(NAMED, ","))
    code, out, err = bayeskin("import", tmp_path / "a.csv", "-o", tmp_path / "r.h5")
    assert code == 0
    assert "480 samples at 10 Hz" in out
    assert "read as" not in out
    assert err.count("read as") == 3


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--unit", "force"], ["--unit force", "QUANTITY=UNIT"]),
        (["--unit", "mass=kg"], ["'mass'", "one of time, displacement, force"]),
        (["--unit", "force=psi"], ["--unit force=psi", "the unit 'psi'", "N, kN"]),
        (["--unit", "force=--N"], ["the unit '-N'"]),
        (["--unit", "force=N", "--unit", "force=mN"], ["once for each quantity"]),
        (["--time", "9"], ["--time 9", "1 'clock', 2 'pull', 3 'cell'", "a number from 1 to 3"]),
        (["--force", "load"], ["--force load", "3 'cell'"]),
        (["--time", "1", "--displacement", "2", "--force", "3"], ["is not known", "--unit time"]),
        (["--sheet", "7"], ["no sheet or table '7'", "use one of '1'"]),
    ],
)  # fmt: skip
def test_a_statement_that_does_not_fit_is_refused(
    bayeskin: Command, tmp_path: Path, options: list[str], says: list[str]
) -> None:
    (tmp_path / "bare.csv").write_bytes(BARE)
    assert_refused(bayeskin("import", tmp_path / "bare.csv", "-o", tmp_path / "r.h5", *options), *says)
    assert not (tmp_path / "r.h5").exists()


def test_a_sign_and_a_zero_are_kept_where_the_user_says_so(bayeskin: Command, tmp_path: Path) -> None:
    header = ["Time (s)", "Displacement (mm)", "Force (N)"]
    pushed = cells(T, fixed(-PULLED_MM, 3), fixed(-np.array(F, dtype=float), 5))
    (tmp_path / "pushed.csv").write_bytes(text([header, *pushed], ","))
    answer = bayeskin(
        "import", tmp_path / "pushed.csv", "-o", tmp_path / "p.h5", "--unit", "displacement=+mm"
    )
    assert answer[0] == 0
    assert storage.load(tmp_path / "p.h5", Recording).displacement_m.min() == pytest.approx(-4.5e-3)
    (tmp_path / "late.csv").write_bytes(text([header, *cells(T, fixed(PULLED_MM + 2, 3), F)], ","))
    answer = bayeskin("import", tmp_path / "late.csv", "-o", tmp_path / "l.h5", "--no-zero")
    assert answer[0] == 0
    assert "the displacement starts at 2 mm, which was kept" in answer[2]
    assert storage.load(tmp_path / "l.h5", Recording).displacement_m[0] == pytest.approx(2e-3)


def test_every_table_becomes_a_recording(bayeskin: Command, tmp_path: Path) -> None:
    sheets = {"left arm": NAMED, "right arm": NAMED, "Notes": [["none"]]}
    (tmp_path / "series.xlsx").write_bytes(workbook(sheets))
    code, out, err = bayeskin(
        "import", tmp_path / "series.xlsx", "-o", tmp_path / "s.h5", "--sheet", "all", "--json"
    )
    said = json.loads(out)
    files = [tmp_path / "s-left-arm.h5", tmp_path / "s-right-arm.h5"]
    assert (code, said["ok"]) == (0, True)
    assert [Path(table["out"]) for table in said["recordings"]] == files
    assert [table["table"] for table in said["recordings"]] == ["left arm", "right arm"]
    assert [storage.load(file, Recording).name for file in files] == ["series left arm", "series right arm"]
    assert err.count("s-left-arm.h5: column 'Force (N)' read as force in N") == 1
    assert not (tmp_path / "s.h5").exists()


def test_one_bad_table_of_several_leaves_nothing_written(bayeskin: Command, tmp_path: Path) -> None:
    spoiled = [*NAMED[:100], ["9.90", "oops", "0.2"], *NAMED[101:]]
    (tmp_path / "series.xlsx").write_bytes(workbook({"A": NAMED, "B": spoiled}))
    answer = bayeskin("import", tmp_path / "series.xlsx", "-o", tmp_path / "s.h5", "--sheet", "all")
    assert_refused(answer, "sheet 'B', row 101", "'oops'")
    assert list(tmp_path.glob("*.h5")) == []
    assert bayeskin("import", tmp_path / "series.xlsx", "-o", tmp_path / "s.h5", "--sheet", "A")[0] == 0


def test_names_that_are_not_utf8_are_read_and_written(bayeskin: Command, tmp_path: Path) -> None:
    source, out = tmp_path / os.fsdecode(b"peau_\xe9.csv"), tmp_path / os.fsdecode(b"r\xe9sultat.h5")
    source.write_bytes(text(NAMED, ","))
    code, said, _ = bayeskin("import", source, "-o", out)
    assert code == 0
    assert said.splitlines()[0].startswith("peau_\\xe9: 480 samples")
    assert said.splitlines()[-1].endswith("r\\xe9sultat.h5")
    assert len(storage.load(out, Recording).time_s) == len(TIME_S)
    assert_refused(
        bayeskin("new", source, "-o", tmp_path / "c.toml"), "a configuration cannot contain this name"
    )


def test_a_slow_recording_gets_wider_bins(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "slow.csv").write_bytes(text([NAMED[0], *NAMED[1::5]], ","))
    code, out, _ = bayeskin("new", tmp_path / "slow.csv", "-o", tmp_path / "slow.toml")
    assert code == 0
    assert "Samples are 0.5 s apart" in out
    written = (tmp_path / "slow.toml").read_text()
    assert tomllib.loads(written)["fit"] == {"bin_width_s": 1}
    assert written.count("[fit]") == 1
    assert "# windows_s = " in written


def test_a_pull_without_a_hold_is_imported_and_says_what_it_cannot_tell(
    bayeskin: Command, tmp_path: Path
) -> None:
    time_s = np.arange(0.0, 50.0, 0.1)
    force_n = 0.01 * time_s + 0.001 * np.random.default_rng(4).standard_normal(len(time_s))
    rows = cells(fixed(time_s, 1), fixed(0.1 * time_s, 3), fixed(force_n, 5))
    (tmp_path / "pull.csv").write_bytes(text([NAMED[0], *rows], ","))
    code, out, _ = bayeskin("import", tmp_path / "pull.csv", "-o", tmp_path / "pull.h5", "--json")
    said = json.loads(out)
    assert code == 0
    assert [phase["kind"] for phase in said["phases"]] == ["load"]
    assert [sentence.split(",")[0] for sentence in said["cannot_tell"]] == [
        "There is no hold", "There is no unloading",
    ]  # fmt: skip
