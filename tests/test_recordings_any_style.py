"""A table in any style of writing is read back right, or refused: never wrong, never another error."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from bayeskin.errors import InputError
from bayeskin.recordings import read_recording

TIME_S = np.arange(0.0, 30.0, 0.25)
PULLED_MM = np.interp(TIME_S, [0, 2, 7, 20, 25, 30], [0, 0, 5.25, 5.25, 0, 0])
FORCE_N = 0.06 * PULLED_MM + 0.012 * np.sin(0.7 * TIME_S)

NAMES = {
    "English": ("Time", "Displacement", "Force"),
    "English machine": ("Elapsed Time", "Crosshead travel", "Axial Load"),
    "French": ("Temps d'essai", "Déplacement traverse", "Effort"),
    "German": ("Prüfzeit", "Standardweg", "Standardkraft"),
    "Spanish": ("Tiempo", "Desplazamiento", "Fuerza"),
    "Italian": ("Tempo", "Spostamento", "Forza"),
    "Japanese": ("時間", "変位", "荷重"),
    "symbols": ("t", "d", "F"),
}
UNITS = ({"s": 1.0, "ms": 1e3, "min": 1 / 60, "sec": 1.0}, {"mm": 1.0, "µm": 1e3, "in": 1 / 25.4, "cm": 0.1},
         {"N": 1.0, "mN": 1e3, "gf": 1 / 9.80665e-3, "lbf": 1 / 4.4482216152605, "kN": 1e-3})  # fmt: skip
EXTRA = {
    "Temperature (°C)": lambda i: 31 + 0.01 * i,
    "Displacement setpoint (mm)": lambda i: 1.1 * PULLED_MM[i],
    "Load step": lambda i: 1 + i // 20,
    "Force limit (N)": lambda i: 5.0,
    "Consigne de force (N)": lambda i: 0.2,
    "Displacement rate (mm/s)": lambda i: 0.7,
    "Extension (%)": lambda i: PULLED_MM[i] / 0.36,
    "n": lambda i: i,
    "Peak load (N)": lambda i: 0.4,
    "変位速度 (mm/s)": lambda i: 0.5,
    "Time of day (s)": lambda i: 36000 + 0.25 * i,
    "Remark": lambda i: "slipped" if i == 7 else "",
    "Phase": lambda i: "pull 1" if i % 40 < 20 else "hold",
}
PREAMBLES = (
    [],
    [["Operator", "B"], ["Gauge length", "36", "mm"]],
    [["Control: displacement", "Limit: force 5 N"], []],
    [["Range", "0", "10", "mm"], ["Date", "03.04.2031"], []],
    [["Specimen", "Maximum force (N)", "Time (s)"], ["1", "0.31", "7.0"], []],
)


@dataclass(frozen=True)
class Style:
    delimiter: str
    decimal: str
    thousands: str
    encoding: str
    language: str
    units: tuple[str, str, str]
    unit_place: str  # "bracket", "comma", "underscore", "row", or "none"
    order: tuple[int, ...]
    extra: tuple[str, ...]
    preamble: int
    digits: int
    offset: tuple[float, float, float]  # of the time [s], of the displacement [mm] and of the force [N]
    quoted: bool
    comment: str
    end: str


STYLES = st.builds(
    Style,
    delimiter=st.sampled_from([",", ";", "\t", "|", "  ", " "]),
    decimal=st.sampled_from(".,"),
    thousands=st.sampled_from(["", "", "", ",", ".", "'", " ", "\u202f"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252", "cp932"]),
    language=st.sampled_from(list(NAMES)),
    units=st.tuples(*(st.sampled_from(list(units)) for units in UNITS)),
    unit_place=st.sampled_from(["bracket", "square", "comma", "underscore", "row", "none"]),
    order=st.permutations(range(3)).map(tuple),
    extra=st.lists(st.sampled_from(list(EXTRA)), max_size=3, unique=True).map(tuple),
    preamble=st.integers(0, len(PREAMBLES) - 1),
    digits=st.integers(2, 8),
    offset=st.sampled_from(
        [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 38.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 1.3)]
    ),
    quoted=st.booleans(),
    comment=st.sampled_from(["", "", "# ", "% "]),
    end=st.sampled_from(["\n", "\r\n"]),
)


def number(value: float, style: Style) -> str:
    digits = f"{value:{',' if style.thousands else ''}.{style.digits}f}"
    return digits.translate(str.maketrans({",": style.thousands, ".": style.decimal}))


def named(name: str, unit: str, place: str) -> str:
    brackets = {"bracket": " ({})", "square": " [{}]", "comma": ", {}", "underscore": "_{}"}
    return name + brackets.get(place, "").format(unit)


def written(style: Style) -> bytes:
    columns = []
    quantities = (TIME_S + style.offset[0], PULLED_MM + style.offset[1], FORCE_N + style.offset[2])
    for which, values in enumerate(quantities):
        unit = style.units[which]
        header = named(NAMES[style.language][which], unit, style.unit_place)
        columns.append([header, unit, *(number(UNITS[which][unit] * v, style) for v in values)])
    columns = [columns[which] for which in style.order]
    for place, name in enumerate(style.extra):
        values = [EXTRA[name](i) for i in range(len(TIME_S))]
        cells = [name, "", *(v if isinstance(v, str) else number(float(v), style) for v in values)]
        columns.insert(2 * place, cells)
    rows = [list(row) for row in zip(*columns, strict=True)]
    if style.unit_place != "row":
        del rows[1]
    rows[0][0] = style.comment + rows[0][0]
    if style.quoted:
        rows = [[f'"{cell}"' for cell in row] for row in rows]
    lines = [style.delimiter.join(row) for row in (*PREAMBLES[style.preamble], *rows)]
    return "".join(line + style.end for line in lines).encode(style.encoding, "replace")


def plain_style(**changes: object) -> Style:
    usual: dict[str, object] = {
        "delimiter": ";", "decimal": ",", "thousands": "", "encoding": "utf-8", "language": "French",
        "units": ("s", "mm", "N"), "unit_place": "bracket", "order": (0, 1, 2), "extra": (), "preamble": 0,
        "digits": 5, "offset": (0.0, 0.0, 0.0), "quoted": False, "comment": "", "end": "\n",
    }  # fmt: skip
    return Style(**{**usual, **changes})  # type: ignore[arg-type]


@given(STYLES.filter(lambda style: style.thousands != style.decimal))
@example(plain_style(thousands=".", units=("ms", "µm", "mN")))
@example(plain_style(delimiter=",", decimal=".", thousands=",", quoted=True, units=("ms", "µm", "mN")))
@example(plain_style(delimiter="  ", decimal=".", extra=tuple(EXTRA)[:3]))
@example(
    plain_style(
        delimiter="  ",
        decimal=".",
        thousands=" ",
        language="English machine",
        units=("s", "mm", "mN"),
        offset=(0.0, 0.0, 1.3),
    )
)
@example(plain_style(decimal=",", digits=3, offset=(1.0, 1.0, 1.0), units=("s", "µm", "mN")))
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_table_in_any_style_is_read_right_or_refused(tmp_path: Path, style: Style) -> None:
    path = tmp_path / "any.csv"
    path.write_bytes(written(style))
    try:
        recording = read_recording(path)
    except InputError:
        return
    rounding = [0.51 * 10.0**-style.digits / UNITS[q][unit] for q, unit in enumerate(style.units)]
    np.testing.assert_allclose(recording.time_s, TIME_S, atol=2 * rounding[0])
    np.testing.assert_allclose(1e3 * recording.displacement_m, PULLED_MM + style.offset[1], atol=rounding[1])
    np.testing.assert_allclose(recording.force_n, FORCE_N + style.offset[2], atol=rounding[2])


def test_usual_styles_are_read_and_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "usual.csv"
    for language in NAMES:
        for delimiter, decimal, thousands in (
            (",", ".", ""),
            (";", ",", ""),
            ("\t", ",", "."),
            ("  ", ".", ""),
        ):
            for place in ("bracket", "square", "comma", "underscore", "row"):
                for extra in ((), tuple(EXTRA)[:4]):
                    style = plain_style(
                        delimiter=delimiter, decimal=decimal, thousands=thousands, language=language,
                        unit_place=place, extra=extra, preamble=1, units=("s", "mm", "mN"), order=(2, 0, 1),
                    )  # fmt: skip
                    if delimiter in (",", "  ") and (place in ("comma", "row") or extra):
                        continue  # the header itself holds the delimiter, or the cells of a row are empty
                    path.write_bytes(written(style))
                    np.testing.assert_allclose(
                        1e3 * read_recording(path).displacement_m, PULLED_MM, atol=1e-5
                    )
