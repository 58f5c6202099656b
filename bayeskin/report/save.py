"""Saves a figure as PNG and SVG files.

The same input gives the same bytes. A file is replaced as a whole or not at all.
"""

from __future__ import annotations

import io
import os
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayeskin.report.style import styled

DOTS_PER_INCH = 200


@styled
def save_figure(figure: Figure, path_stem: Path | str, provenance: str) -> tuple[Path, Path]:
    """Writes `path_stem`.png (200 dpi) and `path_stem`.svg, and returns both paths.

    `provenance` is stored in the metadata of both files (PNG text chunk, SVG ``dc:description``).
    Neither file contains a date, and a constant salts the identifiers of the SVG. Both formats are
    rendered before either file is replaced. From then on the figure keeps its layout.
    """
    stem = Path(path_stem)
    stem.parent.mkdir(parents=True, exist_ok=True)
    png, svg = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    # The layout is computed once, with text measured by Agg, so that both files show the same figure.
    FigureCanvasAgg(figure)
    if figure.get_layout_engine() is not None:
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
    rendered = {png: figure_bytes(figure, "png", provenance), svg: figure_bytes(figure, "svg", provenance)}
    for path, content in rendered.items():
        _replace(path, content)
    return png, svg


def figure_bytes(figure: Figure, form: str, provenance: str) -> bytes:
    """Returns the content of the figure's file; `form` is "png" or "svg"."""
    metadata: dict[str, str | None] = {"Description": provenance}
    metadata |= {"Software": "bayeskin"} if form == "png" else {"Creator": "bayeskin", "Date": None}
    buffer = io.BytesIO()
    figure.savefig(buffer, format=form, dpi=DOTS_PER_INCH, metadata=metadata)
    return buffer.getvalue()


def _replace(path: Path, content: bytes) -> None:
    """Writes a temporary file and renames it, so that an interruption leaves the old file intact."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as handle:
            handle.write(content)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
