"""Writes tables as test machines, spreadsheets and numpy write them."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import openpyxl

Rows = Sequence[Sequence[str]]


def cells(*columns: Iterable[object]) -> list[list[str]]:
    return [[str(cell) for cell in row] for row in zip(*columns, strict=True)]


def fixed(values: np.ndarray, digits: int, decimal: str = ".", thousands: str = "") -> list[str]:
    swap = str.maketrans({",": thousands, ".": decimal})
    return [f"{v:{',' if thousands else ''}.{digits}f}".translate(swap) for v in values]


def text(rows: Iterable[Sequence[str]], delimiter: str, encoding: str = "utf-8", end: str = "\n") -> bytes:
    return "".join(delimiter.join(row) + end for row in rows).encode(encoding)


def quoted(rows: Iterable[Sequence[str]]) -> list[list[str]]:
    return [[f'"{cell}"' for cell in row] for row in rows]


def aligned(header: str, rows: Rows, width: int = 14) -> bytes:
    return "\n".join([header, *("".join(f"{cell:>{width}}" for cell in row) for row in rows)]).encode()


def workbook(sheets: Mapping[str, Sequence[Sequence[object]]], dimension: str = "") -> bytes:
    """An xlsx file; `dimension` is the range that its sheets state, whatever they hold."""
    book, out = openpyxl.Workbook(), io.BytesIO()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append([float(c) if re.fullmatch(r"-?\d+\.\d+", str(c)) else c for c in row])
    book.save(out)
    if not dimension:
        return out.getvalue()
    stale = io.BytesIO()
    with zipfile.ZipFile(out) as whole, zipfile.ZipFile(stale, "w") as part:
        for name in whole.namelist():
            xml = whole.read(name).decode("utf-8", "surrogateescape")
            xml = re.sub(r'(<dimension ref=")[^"]*', rf"\g<1>{dimension}", xml)
            part.writestr(name, xml.encode("utf-8", "surrogateescape"))
    return stale.getvalue()


def xls(sheets: Mapping[str, Sequence[Sequence[object]]]) -> bytes:
    """An xls file (BIFF 8 in a compound document), with the records that a reader needs and no others."""

    def record(kind: int, body: bytes) -> bytes:
        return struct.pack("<HH", kind, len(body)) + body

    def cell(row: int, column: int, value: object) -> bytes:
        at = struct.pack("<HHH", row, column, 0)
        if isinstance(value, str) and not re.fullmatch(r"-?\d+\.\d+", value):
            label = value.encode("utf-16-le")
            return record(0x0204, at + struct.pack("<HB", len(value), 1) + label)
        return record(0x0203, at + struct.pack("<d", float(value)))  # type: ignore[arg-type]

    begin = lambda kind: record(0x0809, struct.pack("<HHHHII", 0x0600, kind, 0x0DBB, 0x07CC, 0, 6))  # noqa: E731
    end = record(0x000A, b"")
    parts = [
        begin(0x0010) + b"".join(cell(i, j, v) for i, row in enumerate(rows) for j, v in enumerate(row)) + end
        for rows in sheets.values()
    ]
    names = [struct.pack("<HBB", 0, len(name), 1) + name.encode("utf-16-le") for name in sheets]
    at = len(begin(5)) + sum(8 + len(name) for name in names) + len(end)
    head = begin(5)
    for name, part in zip(names, parts, strict=True):
        head += record(0x0085, struct.pack("<I", at) + name)
        at += len(part)
    return _compound("Workbook", head + end + b"".join(parts))


def _compound(name: str, stream: bytes) -> bytes:
    """A compound document that holds one stream, which is long enough to need no small sectors."""
    stream = stream.ljust(max(4096, -(-len(stream) // 512) * 512), b"\0")
    sectors = len(stream) // 512
    tables = -(-(sectors + 2) // 127)  # sectors of the allocation table, which lists itself too
    chain = [0xFFFFFFFD] * tables + [0xFFFFFFFE] + [*range(tables + 2, tables + 1 + sectors), 0xFFFFFFFE]
    chain += [0xFFFFFFFF] * (128 * tables - len(chain))
    assert tables <= 109

    def entry(title: str, kind: int, child: int, start: int, size: int) -> bytes:
        coded = title.encode("utf-16-le").ljust(64, b"\0")
        head = struct.pack("<HBBIII", 2 * len(title) + 2 if title else 0, kind, 1, *(0xFFFFFFFF,) * 2, child)
        return coded + head + bytes(36) + struct.pack("<II", start, size) + bytes(4)

    directory = entry("Root Entry", 5, 1, 0xFFFFFFFE, 0) + entry(name, 2, 0xFFFFFFFF, tables + 1, len(stream))
    directory += 2 * entry("", 0, 0xFFFFFFFF, 0, 0)
    header = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16) + struct.pack("<HHHHH", 0x3E, 3, 0xFFFE, 9, 6)
    header += bytes(6) + struct.pack("<IIIIIIIII", 0, tables, tables, 0, 4096, 0xFFFFFFFE, 0, 0xFFFFFFFE, 0)
    header += struct.pack("<109I", *range(tables), *(0xFFFFFFFF,) * (109 - tables))
    return header + struct.pack(f"<{128 * tables}I", *chain) + directory + stream


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def mach1(*functions: tuple[str, Rows]) -> bytes:
    """A file of a Mach-1: each function has a section and a clock of its own."""
    lines = ["<Mach-1 File>", "<INFO>", "Machine ID:\t7", "<END INFO>", ""]
    for name, rows in functions:
        lines += [f"<{name}>", "Axis:\tPosition (z)", "Velocity, mm/s:\t0.9", "<DATA>"]
        lines += ["Time, s\tPosition (z), mm\tFz, gf", *("\t".join(row) for row in rows[:20]), "<divider>"]
        lines += [*("\t".join(row) for row in rows[20:]), "<divider>", "<END DATA>", ""]
    return "\r\n".join(lines).encode()
