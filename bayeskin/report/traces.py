"""Draws the traces of independent ensembles of walkers, and their convergence in the course of the run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from bayeskin.inference.convergence import Limits, Verdict, autocorrelation_steps, split_rhat
from bayeskin.report.style import (
    FAINT,
    GREY,
    INK,
    PAGE_IN,
    axis_values,
    new_figure,
    panel_title,
    parameter_label,
    state_finding,
    styled,
)
from bayeskin.types import Array, ParameterSpace

_ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#999933")


@dataclass(frozen=True)
class RunningConvergence:
    """Holds convergence diagnostics after step[0], step[1], ... steps.

    step (c,); tau_steps (c, e, d), autocorrelation times [steps] of each ensemble; rhat (c, d)
    """

    step: Array
    tau_steps: Array
    rhat: Array


def running_convergence(chains: ArrayLike, checkpoints: int = 8) -> RunningConvergence:
    """Returns each ensemble's autocorrelation time and the split R-hat across ensembles during the run.

    chains (e, n, w, d) : in sampling coordinates, without burn-in
    checkpoints : number of evenly spaced steps at which the run so far is judged

    The diagnostics are those of `inference.convergence`. They are NaN where a parameter does not move.
    """
    x = np.asarray(chains, dtype=float)
    e, n, _, d = x.shape
    steps = np.unique(np.linspace(n / checkpoints, n, checkpoints).astype(int))
    steps = steps[steps >= 4] if n >= 4 else np.array([n])
    tau = np.array([autocorrelation_steps(x[:, :k]) if k >= 4 else np.full((e, d), np.nan) for k in steps])
    longest = np.max(np.nan_to_num(tau, nan=1.0), axis=(1, 2))
    # The chains are thinned by the longest autocorrelation time, as they are for the verdict.
    thinned = [x[:, : k : max(1, int(np.ceil(t)))] for k, t in zip(steps, longest, strict=True)]
    rhat = np.array([[split_rhat(part[..., j].reshape(e, -1)) for j in range(d)] for part in thinned])
    return RunningConvergence(steps.astype(float), tau, rhat)


@styled
def figure_traces(space: ParameterSpace, chains: ArrayLike, verdict: Verdict, limits: Limits) -> Figure:
    """Returns a figure of each parameter over the run: median walkers, autocorrelation time and R-hat.

    chains (e, n, w, d) : ensembles, steps after burn-in, walkers, parameters of `space` in SI
    verdict : the title of the figure states it, with its first reason
    limits : those of the autocorrelation time and of R-hat are drawn as dashed lines
    """
    columns = enumerate(space.parameters)
    x = np.stack([axis_values(p, np.asarray(chains)[..., j]) for j, p in columns], axis=-1)
    running = running_convergence(x)
    e, n, w, d = x.shape
    figure = new_figure(PAGE_IN, 0.9 + 0.88 * d)
    grid = figure.add_gridspec(d, 3, width_ratios=(2.6, 1, 1))
    axes = [[figure.add_subplot(grid[j, k]) for k in range(3)] for j in range(d)]
    for j, (trace, tau, rhat) in enumerate(axes):
        _draw_trace(trace, np.arange(1, n + 1), x[..., j])
        trace.set_ylabel(parameter_label(space.parameters[j]))
        _draw_tau(tau, running, j, limits.lengths)
        _draw_rhat(rhat, running, j, limits.rhat)
        for ax in (trace, tau, rhat):
            ax.tick_params(labelbottom=j == d - 1)
    for k, title in enumerate(("median walker of ensemble", "autocorrelation time", "split R-hat")):
        panel_title(axes[0][k], "abc"[k], title)
        axes[-1][k].set_xlabel("step")
    axes[0][0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=min(e, 4), columnspacing=0.9)
    figure.align_ylabels()
    caption = (
        f"{e} independent ensemble{'s' * (e != 1)} of {w} walkers, {n} steps after burn-in. "
        f"Line: median walker; band: 5th to 95th percentile of all walkers. "
        f"Dashed: the limits, tau below steps / {limits.lengths:g} and R-hat below {limits.rhat:g}."
    )
    state_finding(figure, ("Trusted: " if verdict.trusted else "Not trusted: ") + verdict.reasons[0], caption)
    return figure


def _draw_trace(ax: Axes, step: Array, values: Array) -> None:
    stride = max(1, len(step) // 600)  # more points than the panel has pixels would only thicken the line
    values = values[:, ::stride]
    low, high = np.quantile(values, [0.05, 0.95], axis=(0, 2))
    ax.fill_between(step[::stride], low, high, color=FAINT, alpha=0.6, lw=0)
    for i, middle in enumerate(np.median(values, axis=-1)):
        ax.plot(step[::stride], middle, color=_ENSEMBLES[i % len(_ENSEMBLES)], lw=0.7, label=f"{i + 1}")
    ax.set_xlim(0, step[-1])
    ax.yaxis.set_major_locator(MaxNLocator(3))


def _draw_tau(ax: Axes, running: RunningConvergence, j: int, lengths_needed: float) -> None:
    for i in range(running.tau_steps.shape[1]):
        color = _ENSEMBLES[i % len(_ENSEMBLES)]
        ax.plot(running.step, running.tau_steps[:, i, j], ".-", color=color, lw=0.8, ms=3)
    ax.plot(running.step, running.step / lengths_needed, color=GREY, lw=0.9, ls=(0, (4, 2)))
    ax.set_xlim(left=0)
    last = running.tau_steps[-1, :, j]
    text = f"{np.nanmax(last):.0f} steps" if np.isfinite(last).any() else "does not move"
    _note(ax, text)
    ax.set_ylim(0, 1.6 * np.nanmax([np.nanmax(np.append(running.tau_steps[..., j], 0.0)),
                                    running.step[-1] / lengths_needed]))  # fmt: skip
    ax.yaxis.set_major_locator(MaxNLocator(3))


def _draw_rhat(ax: Axes, running: RunningConvergence, j: int, limit: float) -> None:
    values = running.rhat[:, j]
    ax.plot(running.step, values, ".-", color=INK, lw=0.8, ms=3)
    ax.axhline(limit, color=GREY, lw=0.9, ls=(0, (4, 2)))
    _note(ax, f"{values[-1]:.3f}" if np.isfinite(values[-1]) else "undefined")
    ax.set_ylim(1 - 0.3 * (limit - 1), 1 + 1.6 * max(np.nanmax(np.append(values, limit)) - 1, limit - 1))
    ax.yaxis.set_major_locator(MaxNLocator(3))


def _note(ax: Axes, text: str) -> None:
    ax.text(0.97, 0.96, text, transform=ax.transAxes, ha="right", va="top", color=INK, fontsize=7)
