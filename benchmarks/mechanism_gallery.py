"""What each mechanism does to the force: one small figure each, and a table with shortcuts checked.

One set of base parameters (point A of benchmarks/healthy_skin.py), the first two cycles of the healthy-skin
protocol, the default mesh. Tissue mechanisms and those that change the displacement that the skin sees are
solved in the full model; the shortcuts of the latter are shown beside, dashed, and their RMS distance from
the full model is in the table. Where a mechanism needs another one, that one is on in both curves.

    python benchmarks/mechanism_gallery.py

Writes docs/figures/mechanisms.{png,svg} and the table between the markers of docs/mechanisms.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import healthy_skin
import numpy as np
import rows

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
SHOWN = {  # values at which the effect is seen
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
    """Forces [N] at TIMES_S without and with a mechanism; by its shortcut, if it has one; wall seconds."""

    without: Array
    force: Array
    shortcut: Array | None
    seconds: float


def values_of(mechanism: Mechanism) -> dict[str, float]:
    """Neutral but for what is shown."""
    return dict(mechanism.neutral) | SHOWN[mechanism.name]


def shown(mechanism: Mechanism, known: Mapping[str, Mechanism]) -> Shown:
    """Runs a mechanism, and the base model without it."""
    values, further = values_of(mechanism), WITH.get(mechanism.name)
    others = [known[further]] if further else []
    values |= values_of(known[further]) if further else {}
    columns = {name: np.array([value]) for name, value in values.items()}
    bare = run({}, [])[0]

    def instrument(mechanisms: list[Mechanism], force: Array) -> Array:
        seen = observed(mechanisms, columns, MOTION, lambda t: np.atleast_2d(np.interp(t, *force)))
        return seen(TIMES_S)[0]

    without = instrument(others, bare)
    if mechanism.act.bind is None:
        return Shown(without, instrument([*others, mechanism], bare), None, 0.0)
    curve, seconds = run(values, solved([mechanism]))
    with_it = np.interp(TIMES_S, *curve)
    shortcut = instrument([mechanism], bare) if isinstance(mechanism.act, Instrument) else None
    return Shown(without, with_it, shortcut, seconds)


_RUNS: dict[str, tuple[Array, float]] = {}


def run(values: Mapping[str, float], mechanisms: list[Mechanism]) -> tuple[Array, float]:
    """Times and forces (2, n) of a full run, kept, and its seconds."""
    key = repr((sorted(values.items()), [m.name for m in mechanisms]))
    if key not in _RUNS:
        found = simulate(ModelSpec(), MOTION, {**BASE, **values}, laws=laws(mechanisms))
        if found.status != "ok":
            raise SystemExit(f"{[m.name for m in mechanisms]}: {found.message}")
        _RUNS[key] = np.stack([found.time_s, found.force_n]), found.stats["seconds"]
    return _RUNS[key]


@styled
def figure_mechanisms(found: Mapping[str, Shown]):
    """What each mechanism adds to the force, a panel each, over the force without it."""
    columns = 4
    high = -(-(len(found) + 1) // columns)
    figure = new_figure(PAGE_IN, 1.2 * high + 0.5)
    axes = figure.subplots(high, columns).ravel()
    for ax, (name, one) in zip(axes, found.items(), strict=False):
        behind = ax.twinx()
        behind.fill_between(TIMES_S, one.without, color=FAINT, alpha=0.6)
        behind.set_axis_off()
        ax.set_zorder(1)
        ax.patch.set_visible(False)
        ax.plot(TIMES_S, 1e3 * (one.force - one.without), color=MODEL)
        if one.shortcut is not None:
            ax.plot(TIMES_S, 1e3 * (one.shortcut - one.without), color=ACCENT, ls=(0, (3, 2)))
        ax.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        ax.margins(y=0.1)
        ax.set_title(name.replace("-dependent-", "-dependent\n"))
    for ax in axes[: len(found) : columns]:
        ax.set_ylabel("added force [mN]")
    for ax in axes[: len(found)][-columns:]:
        ax.set_xlabel("time [s]")
    for ax in axes[len(found) :]:
        ax.set_axis_off()
    last = axes[len(found)]
    last.plot([], [], color=MODEL, label="what it adds")
    last.plot([], [], color=ACCENT, ls=(0, (3, 2)), label="by its shortcut on\nthe force alone")
    last.fill_between([], [], color=FAINT, alpha=0.6, label="the force without,\nto another scale")
    last.legend(loc="center left")
    state_finding(
        figure,
        "Each mechanism leaves its own mark on the force",
        "First two cycles of the healthy-skin protocol, E_c = 60 kPa, E_s = 20 kPa; values in the table.",
    )
    return figure


def table(found: Mapping[str, Shown], known: Mapping[str, Mechanism]) -> str:
    """The mechanisms as Markdown: what they say, how large, how near a shortcut comes."""
    lines = [
        "| mechanism | effect, RMS [mN] | shortcut off by [mN] | run [s] | in words |",
        "|---|--:|--:|--:|---|",
    ]
    for name, one in found.items():
        effect = 1e3 * np.sqrt(np.mean((one.force - one.without) ** 2))
        off = "" if one.shortcut is None else f"{1e3 * np.sqrt(np.mean((one.shortcut - one.force) ** 2)):.2f}"
        seconds = f"{one.seconds:.1f}" if one.seconds else ""
        said = known[name].statement({**BASE, **values_of(known[name])})
        lines.append(f"| `{name}` | {effect:.1f} | {off} | {seconds} | {said} |")
    return "\n".join(lines)


def main() -> None:
    known = catalogue()
    found = {}
    for name, mechanism in known.items():
        found[name] = shown(mechanism, known)
        print(name, f"{found[name].seconds:.1f} s", flush=True)
    save_figure(figure_mechanisms(found), FIGURE, "benchmarks/mechanism_gallery.py")
    text = table(found, known)
    print(text)
    rows.into_docs(DOCUMENT, "gallery", text)


if __name__ == "__main__":
    main()
