"""Files as laboratories have them are read right, or refused in one line that names the option to use."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from toys.laboratory_exports import EXPORTS, FORCE_N, PULLED_MM, TIME_S, Export
from toys.synthetic_recordings import supplement

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.recordings import Stated, read_recording, read_tables, stated_unit
from bayeskin.types import Recording


def stated(columns: dict[str, str], units: dict[str, str], zero: bool | None = None) -> Stated:
    return Stated(columns, {q: stated_unit(q, unit) for q, unit in units.items()}, zero)


@pytest.mark.parametrize("export", EXPORTS, ids=lambda export: ascii(export.name))
def test_an_export_is_read_right_or_refused_with_the_option_to_use(export: Export, tmp_path: Path) -> None:
    path = tmp_path / export.name
    path.write_bytes(export.data)
    if export.refused:
        with pytest.raises(InputError) as refusal:
            read_tables(path)
        assert re.search(export.refused, str(refusal.value)), refusal.value
        assert "\n" not in str(refusal.value)
    if not export.resolved:
        return
    given = stated(dict(export.columns), dict(export.units), export.zero)
    readings = read_tables(path, sheet=export.sheet, stated=given)
    assert len({reading.recording.name for reading in readings}) == len(readings) == export.specimens
    for number, reading in enumerate(readings):
        recording = reading.recording
        np.testing.assert_allclose(recording.time_s, TIME_S, atol=1e-6)
        np.testing.assert_allclose(1e3 * recording.displacement_m, PULLED_MM, atol=6e-4)
        rounding = 6e-4 if export.name == "whole.csv" else 6e-6
        np.testing.assert_allclose(recording.force_n, FORCE_N, atol=rounding)
        assert re.search(export.noted, "; ".join(recording.notes)), recording.notes
        storage.save(tmp_path / f"{number}.h5", recording)
        assert storage.load(tmp_path / f"{number}.h5", Recording).name == recording.name


# The values of shared/field/make_exports.py: the highest displacement [mm], the duration [s], and what a user
# has to state where the file alone is not clear.
FIELD = {
    "A4": ("--zero", {"zero": True}),
    "A5": ("--unit displacement=-mm --unit force=-N", {"units": {"displacement": "-mm", "force": "-N"}}),
    "A9": ("--unit time=UNIT", {"units": {"time": "min", "displacement": "mm", "force": "N"}}),
    "A10": ("--unit displacement=UNIT", None),  # percent is no displacement
    "C8": ("--unit displacement=-mm", {"units": {"displacement": "-mm"}}),
}
HIGHEST_MM = {"A7": 5.82, "C15": 5.995}


@pytest.fixture(scope="module")
def field_exports(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("field")
    script = supplement("field/make_exports.py")
    subprocess.run([sys.executable, script, folder], check=True)
    return sorted(folder.iterdir())


def test_the_field_exports_are_read_right_or_refused_with_the_option_to_use(
    field_exports: list[Path],
) -> None:
    assert len(field_exports) == 27
    for path in field_exports:
        kind = path.name.split("_")[0]
        option, resolved = FIELD.get(kind, ("", {}))
        if option:
            with pytest.raises(InputError, match=option):
                read_recording(path)
        if resolved is None:
            continue
        units = {q: stated_unit(q, unit) for q, unit in resolved.get("units", {}).items()}
        recording = read_recording(path, stated=Stated({}, units, resolved.get("zero")))
        duration_s = {"A9": 15 * 60 - 0.75, "C14": 59.8}.get(kind, 59.95)
        assert recording.time_s[-1] == pytest.approx(duration_s, abs=2e-2 if kind == "A9" else 1e-6)
        highest_mm = 1e3 * recording.displacement_m.max()
        assert highest_mm == pytest.approx(HIGHEST_MM.get(kind, 6.0), abs=6e-4), path
        assert recording.displacement_m[0] == pytest.approx(0.0, abs=1e-9)
        assert recording.force_n.max() == pytest.approx(0.2419 if kind == "C15" else 0.2435, abs=2e-4), path
        assert len(recording.time_s) == (300 if kind == "C14" else 1200)


HEADER = b"Time (s),Displacement (mm),Force (N)\n"
TABLE = HEADER + b"".join(b"%.1f,%.2f,%.3f\n" % (i, 0.1 * i, 0.01 * i) for i in range(60))


@pytest.mark.parametrize(
    "data",
    [
        b"(" * 10**6 + TABLE,
        b"a (b" * 250_000 + b"\n0 1 2\n" * 3,
        TABLE + b"1" * 10**6 + b"x,1,2\n",
        b"Time (s) d (mm) F (N)\n" + b"[" * 10**6 + b"\n" + b"0.1 0.2 0.3\n" * 5,
        b'"' * 10**6 + b"\n" + TABLE,
        b"\n" * 10**6 + TABLE,
    ],
    ids=["brackets", "names", "digits", "blanks", "quotes", "lines"],
)
def test_no_text_takes_long(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "long.csv").write_bytes(data)
    before = time.process_time()
    try:
        read_recording(tmp_path / "long.csv")
    except InputError as error:
        assert len(str(error)) < 1000 + len(os.fspath(tmp_path))  # noqa: PT017
    assert time.process_time() - before < 20.0
