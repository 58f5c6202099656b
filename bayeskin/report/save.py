"""A figure to PNG and SVG, whole or not at all, the same bytes from the same input."""

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
    """Writes `path_stem`.png (200 dpi) and `path_stem`.svg; returns both paths.

    `provenance` stands in the metadata of both files (PNG text chunk, SVG ``dc:description``).
    Neither file carries a date, and SVG identifiers are salted with a constant. Both formats are
    rendered before either file is replaced. The figure's layout is final from then on.
    """
    stem = Path(path_stem)
    stem.parent.mkdir(parents=True, exist_ok=True)
    png, svg = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    # Laid out once, with Agg measuring the text, so that both files show the same figure.
    FigureCanvasAgg(figure)
    if figure.get_layout_engine() is not None:
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
    rendered = {png: _render(figure, "png", provenance), svg: _render(figure, "svg", provenance)}
    for path, content in rendered.items():
        _replace(path, content)
    return png, svg


def _render(figure: Figure, form: str, provenance: str) -> bytes:
    metadata: dict[str, str | None] = {"Description": provenance}
    metadata |= {"Software": "bayeskin"} if form == "png" else {"Creator": "bayeskin", "Date": None}
    buffer = io.BytesIO()
    figure.savefig(buffer, format=form, dpi=DOTS_PER_INCH, metadata=metadata)
    return buffer.getvalue()


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as handle:
            handle.write(content)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
