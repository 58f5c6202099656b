"""The article's calibration rerun: its cost, its optimiser, its bounds, its smoothing.

NLopt's controlled random search with local mutation, 15 points and 250 evaluations, on the parameters
divided by their initial guess; the cost is the RMSE [N] of the article's force against its smoothed
recording over its two holds. Text and script disagree on bounds and windows: both are presets.

    python benchmarks/article_calibration.py            # on the shipped surrogate, some minutes
    python benchmarks/article_calibration.py --check    # and one full run where the best search ended
    python benchmarks/article_calibration.py --full     # on the full model: 250 runs of 150 s a search

Needs the supplement's folder in BAYESKIN_SUPPLEMENT. The surrogate knows a part of the article's bounds, and
the search on it stays there; beyond, the article's formulation is mostly unstable. Beside each search stands
the least cost that differential evolution finds in the same bounds, and the cost at the article's own point.
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
FOUND = np.array([684250.48, 47789.13, 9.428584e-15, 5.0299945e-13])  # by the article
REPORTED_N = 8.84e-3
P_INIT = 700.0  # leaves no trace in the force
EVERY = 50  # samples of 10 ms to a step of its script
UNSTABLE_N = 1e3  # cost of a point without a force
Cost = Callable[[Array], float]


@dataclass(frozen=True)
class Preset:
    """Bounds (4,) of E_c, E_s [Pa], k_c, k_s [m^2] and the windows [s] of the cost."""

    lower: tuple[float, float, float, float]
    upper: tuple[float, float, float, float]
    windows_s: tuple[tuple[float, float], tuple[float, float]]

    def within(self, box: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
        """The bounds, cut to a surrogate's box."""
        low, high = np.array([box[name] for name in NAMES]).T
        return np.maximum(self.lower, low), np.minimum(self.upper, high)


PRESETS = {
    "script": Preset((15e3, 5e3, 1e-15, 1e-15), (15e6, 5e6, 1e-11, 1e-11), ((18.8, 75.0), (97.8, 145.0))),
    "text": Preset((10e3, 10e3, 1e-16, 1e-16), (500e6, 500e6, 1e-10, 1e-10), ((20.0, 75.0), (98.0, 140.0))),
}


def smoothed(recording: Recording) -> tuple[Array, Array]:
    """Time [s] and force [N] at every 50th sample, as the article's script smooths them to 145 s.

    Means of the preceding 50 samples to 30 s, of the 1000 around (itself excluded) to 75, of the following
    50 to 90, of the preceding 50 to 105, of the 1000 around to 145, none across these times; the first 19
    are zero.
    """
    time_s, force = recording.time_s, recording.force_n
    out = np.zeros_like(force)
    parts = ((0, 30, 50, 0), (30, 75, 500, 500), (75, 90, 0, 50), (90, 105, 50, 0), (105, 145, 500, 500))
    for start_s, end_s, before, after in parts:
        first, last = np.searchsorted(time_s, [start_s - 1e-9, end_s - 1e-9])
        for i in range(first, last):
            low, high = max(i - before, first), min(i + after, last - 1)
            around = np.arange(low, high + 1)
            around = around[around != i] if before and after else around
            out[i] = force[around].mean()
    out[:19] = 0.0
    kept = slice(0, int(np.searchsorted(time_s, 145.0)), EVERY)
    return time_s[kept], out[kept]


def cost_of(preset: Preset, time_s: Array, target_n: Array, force_of: Callable[[Array], Array]) -> Cost:
    """RMSE [N] over the preset's windows; `force_of` gives the force at `time_s`, NaN where it fails."""
    inside = np.any([(time_s >= a - 1e-9) & (time_s <= b + 1e-9) for a, b in preset.windows_s], axis=0)

    def cost(theta: Array) -> float:
        value = np.sqrt(np.mean((force_of(theta)[inside] - target_n[inside]) ** 2))
        return float(value) if np.isfinite(value) else UNSTABLE_N

    return cost


def search(cost: Cost, lower: Array, upper: Array, seed: int, evaluations: int = EVALUATIONS) -> Array:
    """Where the article's optimiser ends, (4,) in SI."""
    best = [np.inf, START]

    def scaled(x: Array, _: Array) -> float:
        value = cost(x * START)
        if value < best[0]:
            best[:] = [value, x * START]
        return value

    nlopt.srand(seed)
    opt = nlopt.opt(nlopt.GN_CRS2_LM, len(START))
    opt.set_lower_bounds(lower / START)
    opt.set_upper_bounds(upper / START)
    opt.set_population(POPULATION)
    opt.set_maxeval(evaluations)
    opt.set_min_objective(scaled)
    opt.optimize(np.clip(START, lower, upper) / START)
    return np.asarray(best[1])


def least(cost: Cost, lower: Array, upper: Array) -> Array:
    """The least cost within the bounds, by differential evolution in logarithms, (4,) in SI."""
    bounds = list(zip(np.log(lower), np.log(upper), strict=True))
    found = differential_evolution(lambda x: cost(np.exp(x)), bounds, seed=1, tol=1e-6)
    return np.asarray(np.exp(found.x))


def surrogate_force(time_s: Array) -> tuple[Callable[[Array], Array], dict[str, tuple[float, float]]]:
    """The shipped surrogate of the article's force at `time_s`, and its box."""
    surrogate = load_surrogate(shipped("surrogates/healthy-skin-article.h5"))
    centre = 0.5 * (surrogate.edges_s[1:] + surrogate.edges_s[:-1])
    box = {p.name: (p.lower, p.upper) for p in surrogate.space.parameters}

    def force_of(theta: Array) -> Array:
        point = np.append(np.clip(theta, *np.array([box[name] for name in NAMES]).T), P_INIT)
        return np.interp(time_s, centre, surrogate.predict(point[None]).mean[0])

    return force_of, box


def full_force(folder: Path, recording: Recording, time_s: Array) -> Callable[[Array], Array]:
    """The article's formulation itself at `time_s`; NaN where a run fails."""
    spec, motion = ModelSpec("article", str(folder / "data" / "Mesh_SKIN.msh")), motion_of(recording)

    def force_of(theta: Array) -> Array:
        run = simulate(spec, motion, dict(zip((*NAMES, "p_init"), (*map(float, theta), P_INIT), strict=True)))
        return run.at(time_s) if run.status == "ok" else np.full(len(time_s), np.nan)

    return force_of


def line(label: str, theta: Array, cost_n: float, spread: str = "") -> list[str]:
    return [label, *(f"{value:.3g}" for value in theta), f"{1e3 * cost_n:.2f}", spread]


def report(name: str, cost: Cost, lower: Array, upper: Array, searches: int) -> tuple[list[list[str]], Array]:
    """The table's lines of one preset, and where its best search ended."""
    ended = [search(cost, lower, upper, seed) for seed in range(1, searches + 1)]
    costs = np.array([cost(theta) for theta in ended])
    best = ended[int(np.argmin(costs))]
    spread = f"median {1e3 * np.median(costs):.2f}, worst {1e3 * costs.max():.2f} of {searches} seeds"
    lines = [line(f"{name}: its search, best", best, costs.min(), spread)]
    if searches > 1:
        lowest = least(cost, lower, upper)
        lines.append(line(f"{name}: least in the same bounds", lowest, cost(lowest)))
    return lines, best


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20, help="searches of each preset (default 20)")
    parser.add_argument("--check", action="store_true", help="run the full model where the best search ended")
    parser.add_argument("--full", action="store_true", help="search on the full model, one seed")
    asked = parser.parse_args()
    folder = os.environ.get("BAYESKIN_SUPPLEMENT")
    if not folder:
        rows.say("BAYESKIN_SUPPLEMENT: found nothing; expected the supplement's folder")
        return 2
    recording = read_recording(Path(folder) / "data" / "Healthy_skin.xlsx")
    time_s, target_n = smoothed(recording)
    by_surrogate, box = surrogate_force(time_s)
    by_model = full_force(Path(folder), recording, time_s)
    script = np.loadtxt(Path(folder) / "reference" / "article_forward.csv", delimiter=",", skiprows=1)
    table = []
    for name, preset in PRESETS.items():
        own = cost_of(preset, time_s, target_n, lambda theta: np.interp(time_s, script[:, 0], script[:, 2]))
        table.append(line(f"{name}: the article's point, its script's force", FOUND, own(FOUND)))
        cost = cost_of(preset, time_s, target_n, by_model if asked.full else by_surrogate)
        table.append(line(f"{name}: the article's point", FOUND, cost(FOUND)))
        bounds = (np.array(preset.lower), np.array(preset.upper)) if asked.full else preset.within(box)
        lines, best = report(name, cost, *bounds, searches=1 if asked.full else asked.seeds)
        table += lines
        if asked.check:
            full = cost_of(preset, time_s, target_n, by_model)
            table.append(line(f"{name}: its search, best, by the full model", best, full(best)))
    print(rows.markdown(["", *NAMES, "RMSE [mN]", ""], table))
    print(f"\nThe article reports {1e3 * REPORTED_N:.2f} mN.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
