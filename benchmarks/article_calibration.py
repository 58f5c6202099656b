"""Repeats the article's calibration with its cost function, optimiser, bounds and smoothing.

The optimiser is NLopt's controlled random search with local mutation. It uses 15 points and 250 evaluations,
and searches for the parameters divided by their initial guess. The cost is the RMSE [N] of the article's
force against its smoothed recording over its two holds. The article's text and its script disagree on bounds
and windows, so both versions are presets.

    python benchmarks/article_calibration.py            # uses the shipped surrogate; takes some minutes
    python benchmarks/article_calibration.py --check    # also runs the full model where the best search ends
    python benchmarks/article_calibration.py --full     # uses the full model: 250 runs of 150 s a search

The environment variable BAYESKIN_SUPPLEMENT must name the supplement's folder. The surrogate was trained on a
part of the article's bounds, and its searches stay within that part. Outside of it the article's formulation
is mostly unstable. For comparison the table also has the lowest cost that differential evolution finds within
the same bounds, and the cost at the article's own point.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import nlopt
import numpy as np
import rows
from scipy.optimize import differential_evolution

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.recordings import motion_of, read_recording
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, Recording

POPULATION, EVALUATIONS = 15, 250
NAMES = ("E_c", "E_s", "k_c", "k_s")
START = np.array([150e3, 50e3, 4e-14, 3e-13])
FOUND = np.array([684250.48, 47789.13, 9.428584e-15, 5.0299945e-13])  # the article's result
REPORTED_N = 8.84e-3
P_INIT = 700.0  # the initial pressure has no visible effect on the force
EVERY = 50  # one step of the article's script has 50 samples of 10 ms
UNSTABLE_N = 1e3  # cost of a point at which the model gives no force
Cost = Callable[[Array], float]


@dataclass(frozen=True)
class Preset:
    """Bounds (4,) of E_c, E_s [Pa], k_c, k_s [m^2], and the time windows [s] that the cost covers."""

    lower: tuple[float, float, float, float]
    upper: tuple[float, float, float, float]
    windows_s: tuple[tuple[float, float], tuple[float, float]]

    def within(self, box: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
        """Returns the bounds (4,), (4,), restricted to a surrogate's box."""
        box_low, box_high = np.array([box[name] for name in NAMES]).T
        return np.maximum(self.lower, box_low), np.minimum(self.upper, box_high)


PRESETS = {
    "script": Preset((15e3, 5e3, 1e-15, 1e-15), (15e6, 5e6, 1e-11, 1e-11), ((18.8, 75.0), (97.8, 145.0))),
    "text": Preset((10e3, 10e3, 1e-16, 1e-16), (500e6, 500e6, 1e-10, 1e-10), ((20.0, 75.0), (98.0, 140.0))),
}


def smoothed(recording: Recording) -> tuple[Array, Array]:
    """Returns time [s] and force [N] at every 50th sample up to 145 s, smoothed as in the article's script.

    The script replaces each force by a mean. Up to 30 s the mean is over the sample and the preceding 50, up
    to 75 s over the 1000 samples around the sample without the sample itself, up to 90 s over the sample and
    the following 50, up to 105 s over the sample and the preceding 50, and up to 145 s again over the 1000
    around. No mean includes samples from both sides of these times. The first 19 values are zero.
    """
    time_s, force = recording.time_s, recording.force_n
    smooth = np.zeros_like(force)
    sections = ((0, 30, 50, 0), (30, 75, 500, 500), (75, 90, 0, 50), (90, 105, 50, 0), (105, 145, 500, 500))
    for start_s, end_s, before, after in sections:
        first, last = np.searchsorted(time_s, [start_s - 1e-9, end_s - 1e-9])
        for i in range(first, last):
            low, high = max(i - before, first), min(i + after, last - 1)
            neighbours = np.arange(low, high + 1)
            neighbours = neighbours[neighbours != i] if before and after else neighbours
            smooth[i] = force[neighbours].mean()
    smooth[:19] = 0.0
    kept = slice(0, int(np.searchsorted(time_s, 145.0)), EVERY)
    return time_s[kept], smooth[kept]


def cost_of(preset: Preset, time_s: Array, target_n: Array, force_of: Callable[[Array], Array]) -> Cost:
    """Returns the cost function: the RMSE [N] over the preset's windows.

    `force_of` gives the force at `time_s`, or NaN where the model fails. The cost is then `UNSTABLE_N`.
    """
    inside = np.any([(time_s >= a - 1e-9) & (time_s <= b + 1e-9) for a, b in preset.windows_s], axis=0)

    def cost(theta: Array) -> float:
        value = np.sqrt(np.mean((force_of(theta)[inside] - target_n[inside]) ** 2))
        return float(value) if np.isfinite(value) else UNSTABLE_N

    return cost


def search(cost: Cost, lower: Array, upper: Array, seed: int, evaluations: int = EVALUATIONS) -> Array:
    """Returns the end point (4,) of the article's optimiser in SI units."""
    best: tuple[float, Array] = (np.inf, START)

    def scaled(x: Array, _: Array) -> float:
        nonlocal best
        value = cost(x * START)
        if value < best[0]:
            best = (value, x * START)
        return value

    nlopt.srand(seed)
    optimiser = nlopt.opt(nlopt.GN_CRS2_LM, len(START))
    optimiser.set_lower_bounds(lower / START)
    optimiser.set_upper_bounds(upper / START)
    optimiser.set_population(POPULATION)
    optimiser.set_maxeval(evaluations)
    optimiser.set_min_objective(scaled)
    optimiser.optimize(np.clip(START, lower, upper) / START)
    return best[1]


def least(cost: Cost, lower: Array, upper: Array) -> Array:
    """Returns the point (4,) of lowest cost within the bounds, in SI units.

    The method is differential evolution in the logarithms of the parameters.
    """
    bounds = list(zip(np.log(lower), np.log(upper), strict=True))
    optimum = differential_evolution(lambda x: cost(np.exp(x)), bounds, seed=1, tol=1e-6)
    return np.asarray(np.exp(optimum.x))


def surrogate_force(time_s: Array) -> tuple[Callable[[Array], Array], dict[str, tuple[float, float]]]:
    """Returns the article's force at `time_s` as a function of the parameters, and the box of the parameters.

    Both come from the shipped surrogate of the article's force.
    """
    surrogate = load_surrogate(shipped("surrogates/healthy-skin-article.h5"))
    centre = 0.5 * (surrogate.edges_s[1:] + surrogate.edges_s[:-1])
    box = {p.name: (p.lower, p.upper) for p in surrogate.space.parameters}

    def force_of(theta: Array) -> Array:
        point = np.append(np.clip(theta, *np.array([box[name] for name in NAMES]).T), P_INIT)
        return np.interp(time_s, centre, surrogate.predict(point[None]).mean[0])

    return force_of, box


def full_force(folder: Path, recording: Recording, time_s: Array) -> Callable[[Array], Array]:
    """Returns the force at `time_s` as a function of the parameters, by the article's full model.

    The force is NaN where a run fails.
    """
    spec, motion = ModelSpec("article", str(folder / "data" / "Mesh_SKIN.msh")), motion_of(recording)

    def force_of(theta: Array) -> Array:
        run = simulate(spec, motion, dict(zip((*NAMES, "p_init"), (*map(float, theta), P_INIT), strict=True)))
        return run.at(time_s) if run.status == "ok" else np.full(len(time_s), np.nan)

    return force_of


def line(label: str, theta: Array, cost_n: float, spread: str = "") -> list[str]:
    """Returns a row of the table: label, parameters, cost [mN] and a remark on the spread."""
    return [label, *(f"{value:.3g}" for value in theta), f"{1e3 * cost_n:.2f}", spread]


def report(
    name: str, cost: Cost, bounds: tuple[Array, Array], searches: int
) -> tuple[list[list[str]], Array]:
    """Returns the table's rows of one preset, and the end point (4,) of its best search."""
    end_points = [search(cost, *bounds, seed) for seed in range(1, searches + 1)]
    costs = np.array([cost(theta) for theta in end_points])
    best = end_points[int(np.argmin(costs))]
    spread = f"median {1e3 * np.median(costs):.2f}, worst {1e3 * costs.max():.2f} of {searches} seeds"
    lines = [line(f"{name}: best of the article's searches", best, costs.min(), spread)]
    if searches > 1:
        optimum = least(cost, *bounds)
        lines.append(line(f"{name}: lowest cost in the same bounds", optimum, cost(optimum)))
    return lines, best


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, default=20, help="number of searches for each preset (default 20)"
    )
    parser.add_argument(
        "--check", action="store_true", help="also run the full model at the end point of the best search"
    )
    parser.add_argument("--full", action="store_true", help="search with the full model and a single seed")
    options = parser.parse_args()
    folder = os.environ.get("BAYESKIN_SUPPLEMENT")
    if not folder:
        rows.say("BAYESKIN_SUPPLEMENT is not set; set it to the folder of the article's supplement")
        return 2
    recording = read_recording(Path(folder) / "data" / "Healthy_skin.xlsx")
    time_s, target_n = smoothed(recording)
    by_surrogate, box = surrogate_force(time_s)
    by_model = full_force(Path(folder), recording, time_s)
    script = np.loadtxt(Path(folder) / "reference" / "article_forward.csv", delimiter=",", skiprows=1)
    table = []
    for name, preset in PRESETS.items():
        script_cost = cost_of(
            preset, time_s, target_n, lambda theta: np.interp(time_s, script[:, 0], script[:, 2])
        )
        table.append(line(f"{name}: the article's point, force of its script", FOUND, script_cost(FOUND)))
        cost = cost_of(preset, time_s, target_n, by_model if options.full else by_surrogate)
        table.append(line(f"{name}: the article's point", FOUND, cost(FOUND)))
        bounds = (np.array(preset.lower), np.array(preset.upper)) if options.full else preset.within(box)
        lines, best = report(name, cost, bounds, searches=1 if options.full else options.seeds)
        table += lines
        if options.check:
            full_cost = cost_of(preset, time_s, target_n, by_model)
            table.append(line(f"{name}: best of the searches, full model", best, full_cost(best)))
    print(rows.markdown(["", *NAMES, "RMSE [mN]", ""], table))
    print(f"\nThe article reports {1e3 * REPORTED_N:.2f} mN.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
