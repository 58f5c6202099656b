"""Shows whether surrogates should learn from derivatives: their error against the cost of their runs.

The runs are those of the `reaction` on 80 bricks over the healthy-skin protocol (benchmarks/healthy_skin.py),
at the first points of a design of the default prior box. Each run has its derivatives by the four inputs of
the surrogate (bayeskin/surrogates/similarity.py). The CPU seconds of the derivatives count only where a
surrogate uses them. Four surrogates of the same latents are trained on 24, 48 and 96 runs, and compared at
the same held-out runs:

    chaos, GP                        are trained on forces, as by `bayeskin train`
    chaos with derivatives           uses matching pursuit over rows of values and of slopes
    GP with derivatives              adds rows at small steps from each run, predicted by its derivatives

    python benchmarks/gradient_surrogates.py

Finished runs are stored in benchmarks/results/gradient_surrogates, and a later start does not repeat them.
The program prints the table and draws docs/figures/gradient_surrogates.{png,svg}.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import healthy_skin
import numpy as np
import rows
from matplotlib.figure import Figure

from bayeskin.design import default_space, first_wave
from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.report import save_figure
from bayeskin.report.style import PAGE_IN, new_figure, plain_log, state_finding, styled
from bayeskin.surrogates.chaos import ChaosSettings, LatentChaos, fit_sparse, pursue
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import HyperparameterSettings, fit_latent
from bayeskin.surrogates.shapes import ShapeTransform, split
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.train import fit_latents
from bayeskin.types import Array

FOLDER = rows.RESULTS / "gradient_surrogates"
FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "gradient_surrogates"
SEED = 31
SIZES = (24, 48, 96)
HELD_OUT = 32
SPEC = ModelSpec(refinement=0)
EDGES_S = np.arange(9.5, 347.0, 0.5)
CHAOS = ChaosSettings()
STEERED = ("E_s", "k_c", "k_s", "p_init")  # the force is differentiated by one parameter for each input
P_INIT_CHANGE_PA = 100.0
SLOPE_WEIGHTS = (0.03, 0.1, 0.3)  # weight of a derivative over the box's width, relative to a value
STEP = 0.003  # distance from a run to a predicted row, over the box's width; the best of 0.001 to 0.06
KINDS = ("chaos", "GP", "chaos with derivatives", "GP with derivatives")
COLOURS = ("#E69F00", "#0072B2", "#D55E00", "#009E73")


@cache
def _compile() -> None:
    """Compiles the model once in each process, so that no run's time includes it."""
    simulate(SPEC, healthy_skin.first_cycle(healthy_skin.HEALTHY_SKIN), healthy_skin.POINTS["C"])


def _run(task: tuple[int, dict[str, float]]) -> str:
    """Stores one run and its derivatives in a file; returns an error message, or an empty text."""
    index, theta = task
    changes = {name: theta[name] for name in STEERED} | {"p_init": P_INIT_CHANGE_PA}
    _compile()
    started = time.process_time()
    plain = simulate(SPEC, healthy_skin.HEALTHY_SKIN, theta)
    between = time.process_time()
    with_slopes = simulate(SPEC, healthy_skin.HEALTHY_SKIN, theta, gradients=changes)
    ended = time.process_time()
    for simulation in (plain, with_slopes):
        if simulation.status != "ok":
            return f"{theta}: {simulation.message}"
    partial = FOLDER / f"{index}.part.npz"
    np.savez(
        partial, force_n=with_slopes.bin_means(EDGES_S), slopes_n=with_slopes.gradient_bin_means(EDGES_S),
        run_s=between - started, both_s=ended - between,
    )  # fmt: skip
    partial.rename(FOLDER / f"{index}.npz")
    return ""


def _jacobian(similarity: Similarity, theta: Array) -> Array:
    """Returns the derivatives (n, inputs, steered) of the surrogate's inputs by the steered parameters.

    The units are the changes by which the stored slopes are taken: the value itself, for p_init
    `P_INIT_CHANGE_PA`.
    """
    names = similarity.space.names
    columns = []
    for name in STEERED:
        j = names.index(name)
        change = np.full(len(theta), P_INIT_CHANGE_PA) if name == "p_init" else theta[:, j]
        up, down = theta.copy(), theta.copy()
        up[:, j] += 1e-5 * change
        down[:, j] -= 1e-5 * change
        columns.append((similarity.inputs(up) - similarity.inputs(down)) / 2e-5)
    return np.stack(columns, axis=2)


def _latent_slopes(transform: ShapeTransform, force_n: Array, slopes_n: Array) -> Array:
    """Returns the derivatives (n, q, inputs) of the latents from those of the force (n, m, inputs)."""
    shapes = split(force_n)[1]
    rms = np.sqrt(np.mean(force_n**2, axis=1))
    relative = slopes_n / rms[:, None, None]
    amplitude = np.mean(shapes[:, :, None] * relative, axis=1)
    turned = relative - shapes[:, :, None] * amplitude[:, None, :]
    scores = np.einsum("nmi,km->nki", turned, transform.components)
    return np.concatenate([amplitude[:, None, :], scores], axis=1)


def _slope_basis(unit: Array, indices: np.ndarray) -> Array:
    """Returns the derivatives (inputs, n, P) of the basis by each input."""
    step = 1e-5
    columns = []
    for j in range(unit.shape[1]):
        up, down = unit.copy(), unit.copy()
        up[:, j] += step
        down[:, j] -= step
        columns.append((legendre_basis(up, indices) - legendre_basis(down, indices)) / (2 * step))
    return np.stack(columns)


def _pursued(unit: Array, target: Array, slopes: Array) -> Callable[[Array], Array]:
    """Returns a sparse expansion of one latent (n,) with slopes (n, inputs).

    Cross-validation over folds chooses its terms and the weight of the slopes.
    """
    n, dim = unit.shape
    fold = np.arange(n) % CHAOS.folds
    best = (np.inf, 0.0, np.zeros((0, dim), dtype=np.int64), [0])
    for degree in range(1, 13):
        indices = multi_indices(dim, degree)
        if len(indices) > n * (1 + dim):
            break
        basis, slope_basis = legendre_basis(unit, indices), _slope_basis(unit, indices)
        term_limit = min(n * (1 + dim) // 3, CHAOS.most_terms, len(indices))
        for weight in SLOPE_WEIGHTS:
            stacked = np.concatenate([basis, *(weight * slope_basis)])
            aims = np.concatenate([target, *(weight * slopes.T)])
            residual = np.empty((n, term_limit))
            for k in range(CHAOS.folds):
                is_training = np.tile(fold != k, 1 + dim)
                residual[fold == k] = pursue(stacked, aims, is_training, term_limit)[1][
                    : int(np.sum(fold == k))
                ]
            errors = np.mean(residual**2, axis=0)
            if errors.min() < best[0]:
                chosen = pursue(stacked, aims, np.ones(len(aims), dtype=bool), int(np.argmin(errors)) + 1)[0]
                best = (float(errors.min()), weight, indices, chosen)
    _, weight, indices, chosen = best
    terms = indices[chosen]
    stacked = np.concatenate([legendre_basis(unit, terms), *(weight * _slope_basis(unit, terms))])
    coefficients = np.linalg.lstsq(stacked, np.concatenate([target, *(weight * slopes.T)]), rcond=None)[0]
    return lambda at: legendre_basis(at, terms) @ coefficients


def _predictions(kind: str, inputs: Array, targets: Array, slopes: Array, at: Array) -> Array:
    """Returns the latents (k, q) at inputs `at`, learnt from targets (n, q) and slopes (n, q, inputs)."""
    ones = np.ones(len(inputs))
    if kind == "chaos":
        fits = [fit_sparse(inputs, column, ones) for column in targets.T]
        return LatentChaos.assemble(inputs, targets, fits).predict(at)[0]
    if kind == "chaos with derivatives":
        columns = [_pursued(inputs, targets[:, q], slopes[:, q])(at) for q in range(targets.shape[1])]
        return np.stack(columns, axis=1)
    if kind == "GP with derivatives":
        steps = STEP * np.eye(inputs.shape[1])
        stepped = [(inputs + step, targets + slopes @ step) for step in steps]
        inputs = np.concatenate([inputs, *(at_step for at_step, _ in stepped)])
        targets = np.concatenate([targets, *(predicted for _, predicted in stepped)])
        ones = np.ones(len(inputs))
    # The fit uses all rows at once, because a subset could separate rows that belong to the same run.
    settings = HyperparameterSettings(first_rows=len(inputs))
    gps = [fit_latent(inputs, column, ones, settings) for column in targets.T]
    return LatentGPs.assemble(inputs, targets, gps).predict(at)[0]


def _rows(theta: Array) -> list[tuple[str, int, float, float, float]]:
    """Returns each surrogate's kind, runs, their CPU seconds, held-out error [%] and training seconds."""
    stored = [np.load(FOLDER / f"{index}.npz") for index in range(len(theta))]
    force_n, slopes_n, run_s, both_s = (
        np.stack([run[name] for run in stored]) for name in ("force_n", "slopes_n", "run_s", "both_s")
    )
    similarity = Similarity(default_space())
    inputs, log_scale = similarity.inputs(theta), similarity.log_scale(theta)
    slopes_n = np.einsum("nms,nsi->nmi", slopes_n, np.linalg.inv(_jacobian(similarity, theta)))
    test = np.arange(len(theta)) >= max(SIZES)
    truth = force_n[test] / np.sqrt(np.mean(force_n[test] ** 2, axis=1))[:, None]
    results = []
    for size in SIZES:
        train = np.arange(len(theta)) < size
        transform, targets, _ = fit_latents(
            fit_latent, inputs[train], log_scale[train], force_n[train], np.ones(size)
        )
        slopes = _latent_slopes(transform, force_n[train], slopes_n[train])
        for kind in KINDS:
            started = time.process_time()
            latents = _predictions(kind, inputs[train], targets, slopes, inputs[test])
            training_s = time.process_time() - started
            force = np.exp(log_scale[test])[:, None] * transform.decode_mean(latents)
            error = force / np.sqrt(np.mean(force_n[test] ** 2, axis=1))[:, None] - truth
            cost = (both_s if "derivatives" in kind else run_s)[train].sum()
            results.append((kind, size, float(cost), 100.0 * float(np.sqrt(np.mean(error**2))), training_s))
            rows.say(f"{kind}, {size} runs: {results[-1][3]:.3f} %")
    return results


@styled
def _draw(trained: Sequence[tuple[str, int, float, float, float]]) -> Figure:
    """Returns the figure of error against CPU time."""
    figure = new_figure(0.7 * PAGE_IN, 3.4)
    axes = figure.subplots()
    for kind, colour in zip(KINDS, COLOURS, strict=True):
        of_kind = [row for row in trained if row[0] == kind]
        axes.loglog(
            [row[2] / 60 for row in of_kind], [row[3] for row in of_kind], "o-", color=colour, label=kind
        )
    plain_log(axes.xaxis)
    plain_log(axes.yaxis)
    axes.set_xlabel("CPU time of the runs, with derivatives where used [min]")
    axes.set_ylabel("held-out error [% of RMS force]")
    axes.legend()
    state_finding(
        figure, "For its CPU time a GP gains nothing from derivatives",
        "Base model, 80 bricks, healthy-skin protocol; 24, 48 and 96 runs, the same 32 held out.",
    )  # fmt: skip
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Makes the runs that are missing, prints the table and draws the figure."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--workers", type=int, default=2)
    workers = parser.parse_args(arguments).workers
    FOLDER.mkdir(parents=True, exist_ok=True)
    space = default_space()
    wave = first_wave(space, max(SIZES), HELD_OUT, SEED)
    theta = np.concatenate([wave.theta[~wave.held_out], wave.theta[wave.held_out]])
    missing = [
        (index, dict(zip(space.names, map(float, point), strict=True)))
        for index, point in enumerate(theta)
        if not (FOLDER / f"{index}.npz").is_file()
    ]
    for done, (index, outcome) in enumerate(run_parallel(_run, missing, workers)):
        if isinstance(outcome, Lost) or outcome:
            raise SystemExit(f"run {missing[index][0]}: {outcome}")
        rows.say(f"{done + 1} of {len(missing)} runs")
    results = _rows(theta)
    header = ("surrogate", "runs", "CPU s of runs", "held-out error [%]", "training [CPU s]")
    cells = [
        (kind, str(size), f"{cost:.0f}", f"{error:.3f}", f"{training_s:.1f}")
        for kind, size, cost, error, training_s in results
    ]
    print(rows.markdown(header, cells))
    save_figure(_draw(results), FIGURE, "benchmarks/gradient_surrogates.py")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
