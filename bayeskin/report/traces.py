"""Traces of independent ensembles, with how far they have converged as the run went on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

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
    symbol,
)
from bayeskin.types import Array, ParameterSpace

_ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#999933")


@dataclass(frozen=True)
class RunningConvergence:
    """Diagnostics after step[0], step[1], ... steps: step (c,); tau_steps (c, e, d); rhat (c, d)."""

    step: Array
    tau_steps: Array
    rhat: Array


def running_convergence(chains: ArrayLike, checkpoints: int = 8) -> RunningConvergence:
    """Autocorrelation time of each ensemble and split R-hat across ensembles, as the run grew.

    chains (e, n, w, d). tau: Sokal's windowed estimate (window 5 tau) of the autocorrelation averaged
    over an ensemble's walkers (Goodman & Weare 2010, as in emcee). R-hat: Gelman et al. (2013), eq.
    11.4, of each half of each ensemble as one chain, all its walkers pooled: walkers of one ensemble
    are coupled and never count as chains of their own. NaN where a parameter does not move.
    """
    x = np.asarray(chains, dtype=float)
    e, n, _, d = x.shape
    steps = np.unique(np.linspace(n / checkpoints, n, checkpoints).astype(int))
    steps = steps[steps >= 4] if n >= 4 else np.array([n])
    tau = np.array([[[_tau(x[i, :k, :, j]) for j in range(d)] for i in range(e)] for k in steps])
    return RunningConvergence(steps.astype(float), tau, np.array([_split_rhat(x[:, :k]) for k in steps]))


@styled
def figure_traces(
    space: ParameterSpace, chains: ArrayLike, *, lengths_needed: float = 50.0, rhat_limit: float = 1.01
) -> Figure:
    """Each parameter over the run: walkers' median and 90 % by ensemble, running tau, running R-hat.

    chains (e, n, w, d): ensembles, steps, walkers, parameters. `lengths_needed` autocorrelation times
    must fit in the run, and R-hat must fall below `rhat_limit`: the limits of the verdict.
    """
    x = np.asarray(chains, dtype=float)
    running = running_convergence(x)
    e, n, w, d = x.shape
    figure = new_figure(PAGE_IN, 0.9 + 0.88 * d)
    grid = figure.add_gridspec(d, 3, width_ratios=(2.6, 1, 1))
    step = np.arange(1, n + 1)
    for j, parameter in enumerate(space.parameters):
        trace, tau, rhat = (figure.add_subplot(grid[j, k]) for k in range(3))
        _draw_trace(trace, step, axis_values(parameter, x[..., j]))
        trace.set_ylabel(parameter_label(parameter))
        _draw_tau(tau, running, j, lengths_needed)
        _draw_rhat(rhat, running, j, rhat_limit)
        if j == 0:
            for ax, letter, title in zip(
                (trace, tau, rhat), "abc",
                ("median walker of ensemble", "autocorrelation time", "split R-hat"), strict=True,
            ):  # fmt: skip
                panel_title(ax, letter, title)
            trace.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=min(e, 4), columnspacing=0.9)
        for ax in (trace, tau, rhat):
            ax.tick_params(labelbottom=j == d - 1)
            if j == d - 1:
                ax.set_xlabel("step")
    figure.align_ylabels()
    caption = (
        f"{e} independent ensemble{'s' * (e != 1)} of {w} walkers, {n} steps after burn-in. "
        f"Line: median walker; band: 5th to 95th percentile of all walkers. "
        f"Dashed: the limits, tau below steps / {lengths_needed:g} and R-hat below {rhat_limit:g}."
    )
    state_finding(figure, _finding(space, running, lengths_needed, rhat_limit), caption)
    return figure


def _draw_trace(ax: Axes, step: Array, values: Array) -> None:
    stride = max(1, len(step) // 600)  # more points than the panel has pixels only thicken the line
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


def _tau(series: Array) -> float:
    """Integrated autocorrelation time of (n, w), in steps; NaN if too short or constant."""
    n = len(series)
    if n < 4 or np.ptp(series) == 0:
        return float("nan")
    # About the ensemble's mean, not each walker's own: a walker that is stuck then counts as correlation.
    spectrum = np.abs(np.fft.rfft(series - series.mean(), 2 ** int(np.ceil(np.log2(2 * n))), axis=0)) ** 2
    covariance = np.fft.irfft(spectrum.mean(axis=1))[:n]
    taus = 2.0 * np.cumsum(covariance / covariance[0]) - 1.0
    beyond = np.arange(n) >= 5.0 * taus
    return float(taus[np.argmax(beyond) if beyond.any() else n - 1])


def _split_rhat(x: Array) -> Array:
    """Split R-hat (d,) of (e, n, w, d); NaN for a parameter without variance."""
    e, n, w, d = x.shape
    half = n // 2
    if half < 2:
        return np.full(d, np.nan)
    halves = np.concatenate([x[:, :half], x[:, n - half :]]).reshape(2 * e, half * w, d)
    within = halves.var(axis=1, ddof=1).mean(axis=0)
    between = halves.mean(axis=1).var(axis=0, ddof=1)
    moves = np.ptp(halves, axis=(0, 1)) > 0  # not `within > 0`, which rounding can make of a constant
    return np.where(moves, np.sqrt(1.0 + between / np.where(within > 0, within, np.inf)), np.nan)


def _finding(space: ParameterSpace, running: RunningConvergence, lengths: float, limit: float) -> str:
    tau, rhat = running.tau_steps[-1], running.rhat[-1]
    if not np.isfinite(rhat).any():
        return "No parameter moves: the chains say nothing about convergence"
    worst = int(np.nanargmax(rhat))
    longest = np.nanmax(np.append(tau, 0.0))
    done = np.nanmax(rhat) < limit and longest * lengths <= running.step[-1]
    return (
        f"{'Converged' if done else 'Not converged'}: the run is {running.step[-1] / max(longest, 1e-9):.0f} "
        f"autocorrelation times long; largest R-hat {rhat[worst]:.3f}, of {symbol(space.names[worst])}"
    )
