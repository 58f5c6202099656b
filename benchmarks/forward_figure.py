"""Draws the figure of benchmarks/forward_benchmark.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from bayeskin.report.style import INK, PAGE_IN, new_figure, state_finding, styled

COLOURS = ("#56B4E9", "#0072B2", "#009E73", "#E69F00", "#882255", "#D55E00", "#CC79A7", "#B0B0B0")


@styled
def figure_forward(by_mesh: Mapping[str, Mapping[str, float]], stages: Sequence[str]) -> Figure:
    """Returns the figure: each stage as a share of the run on each mesh, with the floor."""
    figure = new_figure(PAGE_IN, 0.75 + 0.55 * len(by_mesh) + 0.6)
    ax = figure.subplots()
    for y, run in enumerate(by_mesh.values()):
        left = 0.0
        for stage, colour in zip(stages, COLOURS, strict=True):
            share = 100 * run[f"{stage}_s"] / run["cpu_s"]
            ax.barh(y, share, 0.55, left, color=colour, label=stage if y == 0 else None)
            left += share
        floor = 100 * run["floor_s"] / run["cpu_s"]
        ax.plot([floor, floor], [y - 0.38, y + 0.38], color=INK, lw=1.4, label="floor" if y == 0 else None)
    names = [f"{mesh.removesuffix('.msh')}\n{run['cpu_s']:.1f} s" for mesh, run in by_mesh.items()]
    ax.set(
        yticks=range(len(by_mesh)), yticklabels=names, xlabel="share of the run's CPU time [%]", xlim=(0, 100)
    )
    ax.invert_yaxis()
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.05))
    state_finding(
        figure, _finding(by_mesh),
        "One run at point C over the healthy-skin protocol, one thread; analysis: the first factorisation. "
        "Floor: the time of the factorisations and solves alone.",
    )  # fmt: skip
    return figure


def _finding(by_mesh: Mapping[str, Mapping[str, float]]) -> str:
    """Returns the figure's headline, on the run with the last mesh."""
    mesh, run = list(by_mesh.items())[-1]
    return (
        f"On {mesh.removesuffix('.msh')} ({run['dofs']:,.0f} unknowns) a run takes {run['cpu_s']:.0f} CPU s, "
        f"{run['cpu_s'] / run['floor_s']:.1f} times its factorisations and solves alone"
    )
