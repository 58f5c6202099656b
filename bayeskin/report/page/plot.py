"""Draws a plot over time as part of the page: axes, phases, lines, bands, dots, and a cross-hair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bayeskin.report.timeline import runs_of
from bayeskin.types import Array

Phases = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Frame:
    """The size of a drawing, and the edges of a plot in it, in units of the drawing.

    ticks : largest numbers of intervals on the axis of time and on the other axis
    """

    width: int = 760
    height: int = 320
    left: int = 54
    right: int = 750
    top: int = 24
    bottom: int = 280
    ticks: tuple[int, int] = (8, 6)


class Plot:
    """Draws a plot piece by piece, as SVG.

    It holds the scales that turn seconds and values into units of the drawing.
    """

    def __init__(self, time_s: Array, values: Sequence[Array], frame: Frame = Frame()) -> None:
        """Chooses scales that show all `values`, (m,) each, at the times (m,) [s]. NaN is not drawn."""
        self.time_s, self.frame = time_s, frame
        self.t0, self.t1 = float(time_s[0]), float(time_s[-1])
        all_values = np.concatenate(values)
        low, high = float(np.nanmin(all_values)), float(np.nanmax(all_values))
        margin = 0.04 * ((high - low) or 1.0)
        self.low, self.high = low - margin, high + margin

    def x(self, time_s: Any) -> Any:
        """Returns the horizontal positions of times [s], same shape."""
        left, right = self.frame.left, self.frame.right
        return left + (np.asarray(time_s) - self.t0) / ((self.t1 - self.t0) or 1.0) * (right - left)

    def y(self, values: Any) -> Any:
        """Returns the vertical positions of values, same shape."""
        share = (np.asarray(values) - self.low) / (self.high - self.low)
        return self.frame.bottom - share * (self.frame.bottom - self.frame.top)

    def svg(self, key: str, label: str, phases: Phases, parts: Sequence[str], dots: int) -> str:
        """Returns the whole drawing: phases, axes, `parts` over them, and a cross-hair with `dots` dots."""
        return drawing(key, self.frame, "".join((self._phases(phases), self.axes(label), *parts)), dots)

    def numbers(self, marked: Sequence[Array], says: Sequence[str]) -> dict[str, Any]:
        """Returns the data of the cross-hair at each time: its position, its dots, and its text.

        marked : values (m,) of each dot; says : text at each time
        """
        dots = [[None if np.isnan(v) else round(float(v), 1) for v in self.y(values)] for values in marked]
        return {
            "x": np.round(self.x(self.time_s), 1).tolist(), "dots": dots, "says": list(says),
            "top": self.frame.top, "bottom": self.frame.bottom, "width": self.frame.width,
        }  # fmt: skip

    def line(self, values: Array, name: str, color: str = "") -> str:
        """Returns a line over time, interrupted where there is no value."""
        colored = f' style="--own: {color}"' if color else ""
        return f'<path class="{name}" d="{self._path(self.time_s, values)}"{colored}/>'

    def band(self, low: Array, high: Array, name: str) -> str:
        """Returns a band between two values (m,) over time."""
        around = np.concatenate([self.time_s, self.time_s[::-1]]), np.concatenate([high, low[::-1]])
        return f'<path class="band {name}" d="{self._path(*around)}Z"/>'

    def span(self, start_s: float, end_s: float, name: str, strength: float = 1.0) -> str:
        """Returns a rectangle between two times, as high as the plot; `strength` is a share of its colour."""
        x0, x1 = np.clip(self.x([start_s, end_s]), self.frame.left, self.frame.right)
        top, bottom = self.frame.top, self.frame.bottom
        size = f'width="{max(x1 - x0, 0.0):.1f}" height="{bottom - top}"'
        size += f' fill-opacity="{0.25 + 0.75 * strength:.2f}"' if strength < 1.0 else ""
        return f'<rect class="{escape(name)}" x="{x0:.1f}" y="{top}" {size}/>'

    def dots(self, values: Array, chosen: NDArray[np.bool_], name: str) -> str:
        """Returns the chosen points as a path of lines without length, which round line caps make visible."""
        kept = chosen & np.isfinite(values)
        points = zip(self.x(self.time_s[kept]), self.y(values[kept]), strict=True)
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
        return f'<path class="{name}" d="{path}"/>' if path else ""

    def _path(self, time_s: Array, values: Array) -> str:
        pieces = []
        for start, end in runs_of(np.isfinite(values)):
            points = zip(self.x(time_s[start:end]), self.y(values[start:end]), strict=True)
            pieces.append("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points))
        return "".join(pieces)

    def _phases(self, phases: Phases) -> str:
        shown = [phase for phase in phases if phase["kind"] != "rest"]
        return "".join(self.span(p["start_s"], p["end_s"], f"phase {p['kind']}") for p in shown)

    def axes(self, label: str, timed: bool = True) -> str:
        """Returns the axes; the axis of time has its numbers and its name if it is `timed`."""
        frame = self.frame
        left, right, bottom = frame.left, frame.right, frame.bottom
        parts = [f'<line class="axis" x1="{left}" y1="{bottom}" x2="{right}" y2="{bottom}"/>']
        for tick in _ticks(self.t0, self.t1, frame.ticks[0]) if timed else ():
            x = self.x(tick)
            parts.append(f'<line class="axis" x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 4}"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{tick:g}</text>')
        for tick in _ticks(self.low, self.high, frame.ticks[1]):
            y = self.y(tick)
            parts.append(f'<line class="grid" x1="{left}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}"/>')
            tick_label = f"{tick:g}".replace("-", "−")
            parts.append(f'<text x="{left - 7}" y="{y + 4:.1f}" text-anchor="end">{tick_label}</text>')
        if timed:
            middle = 0.5 * (left + right)
            parts.append(f'<text x="{middle}" y="{frame.height - 4}" text-anchor="middle">time [s]</text>')
        parts.append(f'<text x="4" y="{frame.top - 9}">{label}</text>')
        return "".join(parts)


def drawing(key: str, frame: Frame, inner: str, dots: int) -> str:
    """Returns an SVG of the size of a frame with drawn parts, and with a cross-hair of `dots` dots."""
    circles = '<circle r="4"/>' * dots
    cross = f'<g class="cross"><line class="hair"/>{circles}</g>'
    return (
        f'<svg id="{key}" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {frame.width} {frame.height}" '
        f'role="img" aria-labelledby="{key}-alt">{inner}{cross}</svg>'
    )


def moments(time_s: Array, phases: Phases) -> Iterator[str]:
    """Yields each time with the phase in which it lies, such as "1.25 s, load of cycle 1"."""
    for t in time_s:
        inside = [p for p in phases if p["start_s"] <= t < p["end_s"]]
        yield f"{t:.2f} s" + "".join(f", {p['kind']} of cycle {p['cycle']}" for p in inside[:1])


def _ticks(low: float, high: float, most: int) -> list[float]:
    ticks = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return [float(f"{tick:.9g}") for tick in ticks if low <= tick <= high]
