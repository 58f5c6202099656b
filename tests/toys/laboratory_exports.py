"""Exports in the manner of many laboratories, of one made-up pull whose values are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from toys.laboratory_files import aligned, cells, fixed, mach1, npy, quoted, text, workbook, xls

TIME_S = np.round(np.arange(0.0, 48.0, 0.1), 1)
PULLED_MM = np.round(np.interp(TIME_S, [0, 3, 8, 26, 31, 48], [0, 0, 4.5, 4.5, 0, 0]), 3)
FORCE_N = np.round(
    0.07 * PULLED_MM * (1 - 0.006 * np.clip(TIME_S - 8, 0, 18))
    + 0.0015 * np.random.default_rng(3).standard_normal(len(TIME_S)),
    5,
)
T, D, F = fixed(TIME_S, 2), fixed(PULLED_MM, 3), fixed(FORCE_N, 5)
NUMBERS = cells(T, D, F)
COMMAS = [[cell.replace(".", ",") for cell in row] for row in NUMBERS]
HEADER = ["Time (s)", "Displacement (mm)", "Force (N)"]
NAMED = [HEADER, *NUMBERS]
GRAMS = fixed(FORCE_N / 9.80665e-3, 4)


@dataclass(frozen=True)
class Export:
    """A file, the line that refuses it where a user states nothing, and what a user states about it."""

    name: str
    data: bytes
    refused: str = ""  # "": read without a statement
    noted: str = ""  # what the notes say
    sheet: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    zero: bool | None = None
    specimens: int = 1

    @property
    def resolved(self) -> bool:
        """Returns whether the file is read with what the user states."""
        return not self.refused or bool(self.sheet or self.columns or self.units or self.zero)


NUMBERED = {"time": "1", "displacement": "2", "force": "3"}
UNITS = {"time": "s", "displacement": "mm", "force": "N"}


def set_by_blanks() -> list[Export]:
    counted = cells(range(len(T)), fixed(1e3 * TIME_S, 0), fixed(1e3 * PULLED_MM, 1), fixed(1e3 * FORCE_N, 2))
    preloaded = cells(T, D, fixed(1e3 * FORCE_N + 1300, 1, thousands=" "))
    return [
        Export("blanks.txt", aligned("Run time (s)   Pad displacement (mm)   Pull force (N)", NUMBERS)),
        Export("blanks_unit_row.txt", aligned("Test time   Crosshead   Pull force\nsec   mm   N", NUMBERS)),
        Export("one_blank.txt", aligned("Run time (s) Pad displacement (mm) Pull force (N)", NUMBERS)),
        Export(
            "unclear_blanks.txt",
            aligned("Run time Pad displacement Pull force", NUMBERS),
            refused="above rows of 3 cells; write a header, or import with --time 1",
            columns=NUMBERED,
            units=UNITS,
        ),
        Export("savetxt.dat", aligned("# n t_ms disp_um load_mN", counted)),
        Export(
            "blank_thousands.txt",
            aligned("t_s  d_mm  Pull force_mN", preloaded),
            refused="'t_s  d_mm  Pull force_mN' stands above rows of 4 cells",
        ),
        Export(
            "blank_thousands_one_blank.txt",
            aligned("t_s d_mm Pull force_mN", preloaded),
            refused=r"row 2: '1 3\d\d\.\d' in columns 3 and 4 may be one number",
        ),
        Export(
            "blank_thousands_zeros.txt",
            aligned("t_s d_mm Pull force_mN", cells(T, D, fixed(1e3 * FORCE_N + 1005, 1, thousands=" "))),
            refused=r"' .* 1 0.*' stands above rows of 4 cells",
        ),
        Export("row_number.dat", aligned("# t_ms disp_um load_mN", counted)),
    ]


def headings() -> list[Export]:
    kilo = quoted(cells(T, D, fixed(1e-3 * FORCE_N, 8)))
    results = [["Specimen", "Maximum load (N)", "Extension at it (mm)"], ["1", "0.31", "4.5"], []]
    measured = zip(T, fixed(1.04 * PULLED_MM, 3), D, fixed(1 + TIME_S // 10, 0), F, strict=True)
    set_point = ["Time (s)", "Target displacement (mm)", "Position (mm)", "Load step", "Fz (N)"]
    warm = fixed(31 + 0.01 * PULLED_MM, 3, ",")
    elided = ["Durée (s)", "Effort (N)", "Course (mm)", "Température d'étuve"]
    preamble = [["Regulation: displacement", "End: force 7 N"]]
    nuls = b'"Pull"\0\0\r\n\r\n"Elapsed Time ","Disp ","Load 2 ",\r\n"Sec","mm","N",\r\n'
    channels = ["Running Time (s)", "Axial Displacement (Ch 2) [mm]", "Load(Cell:Load) (N)"]
    same = [["Time", "Extension", "Tensile extension", "Load"], ["s", "mm", "mm", "N"]]
    cells_a_b = ["Time (s)", "Displacement (mm)", "Force A (N)", "Force B (N)"]
    return [
        Export("below.txt", b"".join(b"Gain %d:\t%d\n" % (i, i) for i in range(150)) + text(NAMED, "\t")),
        Export("preamble.csv", text([*preamble, *NAMED], ";")),
        Export("results_above.csv", text([*results, *NAMED], ",")),
        Export("footer.csv", text([*NAMED, [], ["End of test", "operator: B"]], ";")),
        Export("unit_row.csv", text([["Time", "Extension", "Load"], ["(s)", "(mm)", "(kN)"], *kilo], ",")),
        Export(
            "unit_row_gf.csv", text([["Time", "Travel", "Load"], ["s", "mm", "gf"], *cells(T, D, GRAMS)], ";")
        ),
        Export(
            "same.csv", text([*same, *cells(T, D, D, F)], ","), noted="'Tensile extension' holds the same"
        ),
        Export("channels.csv", text([channels, *NUMBERS], ",")),
        Export("nuls.txt", nuls + text(NUMBERS, ",", end=",\r\n")),
        Export("lines.csv", text([['"Time\n(s)"', '"Displacement\n(mm)"', '"Force\n(N)"'], *NUMBERS], ",")),
        Export(
            "set_point.csv", text([set_point, *map(list, measured)], ";"), noted=r"\(mm\)' \(a set point\)"
        ),
        Export(
            "elision.csv",
            text([elided, *([t, f, d, w] for (t, d, f), w in zip(COMMAS, warm, strict=True))], ";"),
        ),
        Export(
            "no_header.csv",
            text(NUMBERS, ","),
            refused="no names stand above rows of 3 cells",
            columns=NUMBERED,
            units=UNITS,
        ),
        Export(
            "two_cells.csv",
            text([cells_a_b, *cells(T, D, F, fixed(2 * FORCE_N, 5))], ","),
            refused="'Force A .N.' and 'Force B .N.' are force columns; .*--force NAME or NUMBER",
            columns={"force": "Force A (N)"},
        ),
    ]


def languages() -> list[Export]:
    german = [["Prüfzeit", "Traversenweg", "Standardkraft"], ["s", "mm", "N"], *COMMAS]
    french = [["Temps d'essai", "Course de la traverse", "Force standard"], ["s", "mm", "N"], *COMMAS]
    japanese = [["時間(s)", "変位(mm)", "試験力(N)"], *NUMBERS]
    return [
        Export("pruefung.tra", text(german, ";", "cp1252"), noted="text read as cp1252"),
        Export("essai.csv", text(french, ";")),
        Export("ensayo.csv", text([["Tiempo (s)", "Desplazamiento (mm)", "Fuerza (N)"], *COMMAS], ";")),
        Export("prova.csv", text([["Tempo (s)", "Spostamento (mm)", "Forza (N)"], *COMMAS], ";")),
        Export("shift_jis.csv", text(japanese, ",", "cp932"), noted="text read as cp932"),
        Export("utf16.txt", text(NAMED, "\t", "utf-16")),
        Export("utf16_no_mark.txt", text(NAMED, "\t", "utf-16-le"), noted="text read as utf-16-le"),
        Export("bytes_\udce9.csv", text(NAMED, ",")),
    ]


def numbers() -> list[Export]:
    micro = ["Time (s)", "Displacement (µm)", "Force (mN)"]

    def thousands(by: str, decimal: str) -> list[list[str]]:
        force = fixed(1e3 * FORCE_N, 2, decimal, by)
        return cells(fixed(TIME_S, 2, decimal), fixed(1e3 * PULLED_MM, 0, decimal, by), force)

    commas = cells(*(fixed(v, 3, ",") for v in (TIME_S, 1e3 * PULLED_MM, 1e3 * FORCE_N)))
    whole = [fixed(1e3 * v, 0, "", ".") for v in (TIME_S, PULLED_MM, np.round(FORCE_N, 3))]
    inches = [fixed(TIME_S / 60, 9), fixed(PULLED_MM / 25.4, 9), fixed(FORCE_N / 4.4482216152605, 9)]
    small = [fixed(TIME_S / 3600, 11), fixed(1e-3 * PULLED_MM, 7), fixed(1e6 * FORCE_N, 1)]
    return [
        Export(
            "thousands.csv", text([micro, *quoted(thousands(",", "."))], ","), noted="thousands separators"
        ),
        Export(
            "tausender.csv", text([micro, *thousands(".", ",")], ";"), noted="a comma is the decimal sign"
        ),
        Export("milliers.csv", text([micro, *thousands("\u202f", ",")], ";")),
        Export("schweiz.csv", text([micro, *thousands("'", ".")], ";")),
        Export(
            "whole.csv", text([["t (ms)", "d (um)", "F (mN)"], *cells(*whole)], ";"), noted="thousands separ"
        ),
        Export("three_commas.csv", text([micro, *commas], ";"), noted="a comma is the decimal sign"),
        Export(
            "two_signs.csv",
            text([HEADER, *cells(T, fixed(PULLED_MM, 3, ","), F)], ";"),
            "use the same decimal sign",
        ),
        Export("imperial.csv", text([["Time (min)", "Crosshead (in)", "Load (lbf)"], *cells(*inches)], ",")),
        Export("small.csv", text([["Time (h)", "Travel (m)", "Load (uN)"], *cells(*small)], ",")),
        Export(
            "comma_twice.csv",
            text([HEADER, *COMMAS], ","),
            refused="3 names stand above rows of 6 cells; the delimiter must not be the decimal sign",
        ),
        Export(
            "three_digits.csv",
            text(
                [HEADER, *cells(fixed(TIME_S + 5, 3), fixed(PULLED_MM + 30, 3), fixed(FORCE_N + 2, 3))], ";"
            ),
            refused="numbers such as '5.000' may be 5.000 or 5000",
        ),
    ]


def statements() -> list[Export]:
    """Files whose zero, sign or unit has to be stated."""
    strain = fixed(PULLED_MM / 0.36, 4)
    turned = [fixed(-PULLED_MM, 3), fixed(-FORCE_N, 5)]
    return [
        Export(
            "absolute.csv",
            text([HEADER, *cells(T, fixed(PULLED_MM + 41.25, 3), F)], ","),
            refused="starts at 41.25 mm; .*import with --zero",
            zero=True,
            noted="--zero subtracted the first displacement, 41.25 mm",
        ),
        Export(
            "negative.csv",
            text([["Time (s)", "Travel (mm)", "Load (N)"], *cells(T, *turned)], ","),
            refused="while the force falls; .*--unit displacement=-mm --unit force=-N",
            units={"displacement": "-mm", "force": "-N"},
            noted="stated by --unit., with its sign turned",
        ),
        Export(
            "turned_cell.csv",
            text([HEADER, *cells(T, D, turned[1])], ","),
            refused="falls while the other rises; .*--unit force=-N",
            units={"force": "-N"},
        ),
        Export(
            "minutes.csv",
            text([["Time", *HEADER[1:]], *cells(fixed(TIME_S / 60, 8), D, F)], ","),
            refused="the unit of 'Time' is not known; .*import with --unit time=UNIT",
            units={"time": "min"},
        ),
        Export("percent.csv", text([[*HEADER, "Extension (%)"], *cells(T, D, F, strain)], ",")),
        Export(
            "percent_alone.csv",
            text([["Time (s)", "Extension (%)", "Load (N)"], *cells(T, strain, F)], ","),
            refused="'Extension .%.' is in the unit '%'; .*--displacement COLUMN",
        ),
        Export(
            "percent_no_unit.csv",
            text([["Time (s)", "Extension", "Load (N)"], *cells(T, strain, F)], ","),
            refused="the unit of 'Extension' is not known; .*import with --unit displacement=UNIT",
        ),
    ]


def programs() -> list[Export]:
    down = cells(T, fixed(-PULLED_MM, 3), GRAMS)
    still = cells(T, fixed(0 * PULLED_MM, 3), GRAMS)
    functions = [("Find Contact", still[:30]), ("Wait", still), ("Move Relative", down)]
    lvm = [["LabVIEW Measurement"], ["Separator", "Tab"], ["***End_of_Header***"], ["Channels", "2"]]
    lvm += [["Samples", "480", "480"], ["***End_of_Header***"], ["X_Value", "Disp", "Load", "Comment"]]
    fields = np.rec.fromarrays([TIME_S, PULLED_MM, FORCE_N], names="time_s,disp_mm,force_N")
    return [
        Export(
            "mach1.txt",
            mach1(("Move Relative", down)),
            refused="goes to -4.5 mm while the force rises; .*--unit displacement=-mm",
            units={"displacement": "-mm"},
        ),
        Export(
            "mach1_functions.txt",
            mach1(*functions),
            refused="2 of its tables .*'Wait', 'Move Relative'",
            sheet="Move Relative",
            units={"displacement": "-mm"},
        ),
        Export(
            "labview.lvm",
            text([*lvm, *NUMBERS], "\t"),
            refused="a time column .*--time COLUMN",
            columns={"time": "X_Value"},
            units=UNITS,
        ),
        Export(
            "array.npy",
            npy(np.column_stack([TIME_S, PULLED_MM, FORCE_N])),
            refused="no names stand above",
            columns=NUMBERED,
            units=UNITS,
        ),
        Export("fields.npy", npy(fields)),
    ]


def workbooks() -> list[Export]:
    units = [["Time", "Standard force", "Standard travel"], ["s", "N", "mm"]]
    specimen = {"Arm 7": [*units, *cells(T, F, D)]}
    summary = {
        "Summary": [["Arm", "Date of the test", "Largest force", "d0"], ["7", "51200.5", "0.31", "3.5"]]
    }
    beside: list[Sequence[str]] = [["First arm", "", "", "", "Second arm"], [*HEADER, "", *HEADER]]
    beside += [[*row, "", *row] for row in NUMBERS]
    two = {"left": NAMED, "right": NAMED}
    of_two = "2 of its tables 'left', 'right' .*--sheet all"
    return [
        Export("stale.xlsx", workbook({"Data": NAMED}, "A1:C90")),
        Export("stale_a1.xlsx", workbook({"Data": NAMED}, "A1")),
        Export("summary.xlsx", workbook(summary | specimen), noted="tables left out: 'Summary'"),
        Export("texts.xlsx", workbook({"Data": [HEADER, *COMMAS]}), noted="a comma is the decimal sign"),
        Export("two.xlsx", workbook(two), refused=of_two, sheet="right"),
        Export("all.xlsx", workbook(summary | two), refused="2 of its tables", sheet="all", specimens=2),
        Export("beside.xlsx", workbook({"Data": beside}), refused="'Data Second arm'", sheet="Second arm"),
        Export(
            "beside.csv", text(beside, ";"), refused="'First arm', 'Second arm'", sheet="all", specimens=2
        ),
        Export("early.xls", xls(summary | specimen), noted="tables left out: 'Summary'"),
        Export("two.xls", xls(two), refused=of_two, sheet="left"),
        Export("really_text.xls", text(NAMED, "\t")),
        Export("really_xlsx.xls", workbook({"Data": NAMED})),
    ]


EXPORTS = [
    export
    for kind in (set_by_blanks, headings, languages, numbers, statements, programs, workbooks)
    for export in kind()
]
