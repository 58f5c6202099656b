"""Shows what each mechanism does to the force: one small figure each, and a table that checks the shortcuts.

The runs have one set of base parameters (point A of benchmarks/healthy_skin.py), the first two cycles of the
healthy-skin protocol and the default mesh. Mechanisms of the tissue, and mechanisms that change the
displacement that the skin sees, are solved in the full model. The latter also have shortcuts that act on the
force alone. The figures show these as dashed lines, and the table has their RMS distance from the full model.
Where a mechanism needs another one, the other one is active in both curves.

    python benchmarks/mechanism_gallery.py

The program writes docs/figures/mechanisms.{png,svg} and the table between the markers of docs/mechanisms.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import healthy_skin
import numpy as np
import rows
from matplotlib.figure import Figure

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.mechanisms import Mechanism, catalogue, laws, observed, solved
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.report import save_figure
from bayeskin.report.style import ACCENT, FAINT, MODEL, PAGE_IN, new_figure, state_finding, styled
from bayeskin.types import Array, PadMotion

ROOT = Path(__file__).parents[1]
DOCUMENT, FIGURE = ROOT / "docs" / "mechanisms.md", ROOT / "docs" / "figures" / "mechanisms"
MOTION = PadMotion(healthy_skin.HEALTHY_SKIN.time_s[:8], healthy_skin.HEALTHY_SKIN.displacement_m[:8])
BASE = healthy_skin.POINTS["A"]
TIMES_S = np.arange(0.0, MOTION.time_s[-1], 0.25)
SHOWN = {  # parameter values at which the effect is visible
    "amplifier-lag": {"amplifier_time": 1.0},
    "backlash": {"gap": 3e-4, "frame_compliance": 1e-3},
    "bottom-adherence": {"adherence": 1e7},
    "cell-nonlinearity": {"cell_bend": 0.2},
    "clock-delay": {"delay": 1.0},
    "device-friction": {"Fc": 0.03, "presliding": 5e-5, "friction_start": 0.0},
    "fibre-anisotropy": {"langer_ratio": 2.0, "langer_angle": 0.0},
    "fluid-leakage": {"leakage": 1e-9},
    "force-offset": {"F0": -0.03},
    "friction-creep": {"friction_tau": 20.0},
    "pad-slip": {"slip_rate": 2e-4, "slip_threshold": 0.1},
    "periodic-motion": {"motion_amplitude": 5e-3, "motion_period": 4.0, "motion_share": 0.05},
    "position-ripple": {"ripple_period": 1e-3, "ripple_amplitude": 0.015, "ripple_phase": 0.0},
    "plastic-set": {"set_share": 0.3, "yield_stretch": 1.1},
    "pre-stretch": {"opening": 0.1},
    "preconditioning": {"damage": 0.5, "damage_energy": 1e3},
    "sensor-drift": {"drift": 2e-4},
    "sensor-events": {"event_1_at": 0.4, "event_1_step": 0.03},
    "skeleton-compressibility": {"nu_c": 0.3, "nu_s": 0.2},
    "slow-recovery": {"recovery_compliance": 2e-3, "recovery_time": 30.0},
    "solid-viscoelasticity": {"g_1": 0.3, "tau_1": 3.0, "g_2": 0.2, "tau_2": 50.0},
    "stiffness-drift": {"stiffness_rate": -1e-3, "stiffness_time": 300.0},
    "strain-dependent-permeability": {"M_k": 60.0},
    "strain-stiffening": {"fibre_stress": 3e4, "k2": 5.0, "dispersion": 0.0},
    "viscous-drag": {"drag": 30.0},
}
WITH = {"friction-creep": "device-friction"}


@dataclass(frozen=True)
class Shown:
    """Holds the forces of one mechanism at `TIMES_S`.

    without, force : forces without and with the mechanism [N]
    shortcut : force by the shortcut [N], or None where the mechanism has none
    seconds : wall seconds of the full run
    """

    without: Array
    force: Array
    shortcut: Array | None
    seconds: float


def values_of(mechanism: Mechanism) -> dict[str, float]:
    """Returns a mechanism's parameters: the values to show, and neutral values for the rest."""
    return dict(mechanism.neutral) | SHOWN[mechanism.name]


def shown(mechanism: Mechanism, known: Mapping[str, Mechanism]) -> Shown:
    """Runs a mechanism, and the base model without it; returns both forces."""
    values, required_name = values_of(mechanism), WITH.get(mechanism.name)
    required = [known[required_name]] if required_name else []
    values |= values_of(known[required_name]) if required_name else {}
    columns = {name: np.array([value]) for name, value in values.items()}
    base_force = run({}, [])[0]

    def instrument(mechanisms: list[Mechanism], force: Array) -> Array:
        observed_force = observed(mechanisms, columns, MOTION, lambda t: np.atleast_2d(np.interp(t, *force)))
        return observed_force(TIMES_S)[0]

    without = instrument(required, base_force)
    if mechanism.act.bind is None:
        return Shown(without, instrument([*required, mechanism], base_force), None, 0.0)
    curve, seconds = run(values, solved([mechanism]))
    force_with = np.interp(TIMES_S, *curve)
    shortcut = instrument([mechanism], base_force) if isinstance(mechanism.act, Instrument) else None
    return Shown(without, force_with, shortcut, seconds)


_RUNS: dict[str, tuple[Array, float]] = {}


def run(values: Mapping[str, float], mechanisms: list[Mechanism]) -> tuple[Array, float]:
    """Returns times and forces (2, n) of a full run, and its seconds.

    A run with the same values is made only once.
    """
    key = repr((sorted(values.items()), [m.name for m in mechanisms]))
    if key not in _RUNS:
        simulation = simulate(ModelSpec(), MOTION, {**BASE, **values}, laws=laws(mechanisms))
        if simulation.status != "ok":
            raise SystemExit(f"{[m.name for m in mechanisms]}: {simulation.message}")
        _RUNS[key] = np.stack([simulation.time_s, simulation.force_n]), simulation.stats["seconds"]
    return _RUNS[key]


@styled
def figure_mechanisms(by_mechanism: Mapping[str, Shown]) -> Figure:
    """Returns the figure: the force that each mechanism adds, in its own panel, over the force without it."""
    columns = 4
    row_count = -(-(len(by_mechanism) + 1) // columns)
    figure = new_figure(PAGE_IN, 1.2 * row_count + 0.5)
    axes = figure.subplots(row_count, columns).ravel()
    for ax, (name, forces) in zip(axes, by_mechanism.items(), strict=False):
        background = ax.twinx()
        background.fill_between(TIMES_S, forces.without, color=FAINT, alpha=0.6)
        background.set_axis_off()
        ax.set_zorder(1)
        ax.patch.set_visible(False)
        ax.plot(TIMES_S, 1e3 * (forces.force - forces.without), color=MODEL)
        if forces.shortcut is not None:
            ax.plot(TIMES_S, 1e3 * (forces.shortcut - forces.without), color=ACCENT, ls=(0, (3, 2)))
        ax.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        ax.margins(y=0.1)
        ax.set_title(name.replace("-dependent-", "-dependent\n"))
    for ax in axes[: len(by_mechanism) : columns]:
        ax.set_ylabel("added force [mN]")
    for ax in axes[: len(by_mechanism)][-columns:]:
        ax.set_xlabel("time [s]")
    for ax in axes[len(by_mechanism) :]:
        ax.set_axis_off()
    legend_panel = axes[len(by_mechanism)]
    legend_panel.plot([], [], color=MODEL, label="what it adds")
    legend_panel.plot([], [], color=ACCENT, ls=(0, (3, 2)), label="by its shortcut on\nthe force alone")
    legend_panel.fill_between([], [], color=FAINT, alpha=0.6, label="the force without,\nto another scale")
    legend_panel.legend(loc="center left")
    state_finding(
        figure,
        "Each mechanism leaves its own mark on the force",
        "First two cycles of the healthy-skin protocol, E_c = 60 kPa, E_s = 20 kPa; values in the table.",
    )
    return figure


def table(by_mechanism: Mapping[str, Shown], known: Mapping[str, Mechanism]) -> str:
    """Returns the mechanisms as a Markdown table: effect, error of the shortcut, seconds and description."""
    lines = [
        "| mechanism | effect, RMS [mN] | RMS error of the shortcut [mN] | run [s] | description |",
        "|---|--:|--:|--:|---|",
    ]
    for name, forces in by_mechanism.items():
        effect_mn = 1e3 * np.sqrt(np.mean((forces.force - forces.without) ** 2))
        shortcut_error = (
            ""
            if forces.shortcut is None
            else f"{1e3 * np.sqrt(np.mean((forces.shortcut - forces.force) ** 2)):.2f}"
        )
        seconds = f"{forces.seconds:.1f}" if forces.seconds else ""
        description = known[name].statement({**BASE, **values_of(known[name])})
        lines.append(f"| `{name}` | {effect_mn:.1f} | {shortcut_error} | {seconds} | {description} |")
    return "\n".join(lines)


def main() -> None:
    known = catalogue()
    forces = {}
    for name, mechanism in known.items():
        forces[name] = shown(mechanism, known)
        print(name, f"{forces[name].seconds:.1f} s", flush=True)
    save_figure(figure_mechanisms(forces), FIGURE, "benchmarks/mechanism_gallery.py")
    text = table(forces, known)
    print(text)
    rows.into_docs(DOCUMENT, "gallery", text)


if __name__ == "__main__":
    main()
