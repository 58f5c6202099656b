"""How far the shipped reduced model is from the full one on skins and protocols never seen, and its cost.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_model.py [--full]

Thirty-one skins drawn from the priors: four of the base model, one of each of the eleven mechanisms of the
tissue, four pairs, triples and quadruples of them, and four of the base model whose subcutis is more than
twice as stiff as the cutis; the article's protocol and four others. Forces of the full model
are in results/reduced_held_out.h5; with --full those that are missing there are made, some ten seconds each.
What the model says of its own error is tested by reduced_error.py.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from bayeskin.design import default_space
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.mechanisms import catalogue, laws
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.proof.protocol import MOTION
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, ParameterSpace
from bayeskin.workflow.reducing import SHIPPED

RESULTS = Path(__file__).with_name("results") / "reduced_held_out.h5"
SEED = 20261127
STIFF_SUBCUTIS = 2.0  # times the cutis' modulus


def motion(time_s: Sequence[float], height_mm: Sequence[float]) -> PadMotion:
    """A protocol from its corners."""
    return PadMotion(np.array(time_s, float), np.round(1e-3 * np.array(height_mm, float), 12))


PROTOCOLS = {
    "article": MOTION,
    "staircase": motion(
        (0, 3, 33, 36, 66, 69, 99, 102, 132, 138, 178), (0, 2.5, 2.5, 5, 5, 7.5, 7.5, 9.5, 9.5, 0, 0)
    ),
    "triangles": motion((0, 9, 18, 27, 36, 45, 54, 63, 72), (0, 9, 0, 9, 0, 9, 0, 9, 0)),
    "slow": motion((0, 90, 120, 210, 240), (0, 9, 9, 0, 0)),
    "fast": motion((0, 1.8, 61.8, 63.6, 93.6, 95.4, 125.4), (0, 9, 9, 0, 0, 9, 9)),
}


class Skin(NamedTuple):
    """A held-out skin: values of all parameters, and the mechanisms that act in it."""

    theta: dict[str, float]
    mechanisms: tuple[str, ...]

    @property
    def group(self) -> str:
        """A row of the table."""
        count = len(self.mechanisms)
        if count == 0:
            stiff = self.theta["E_s"] > STIFF_SUBCUTIS * self.theta["E_c"]
            return "base, stiff subcutis" if stiff else "base"
        return self.mechanisms[0] if count == 1 else f"sets of {count}"


def held_out() -> list[Skin]:
    """The skins, drawn anew from their seed."""
    rng, base = np.random.default_rng(SEED), default_space()
    spaces = {
        name: ParameterSpace(m.parameters) for name, m in catalogue().items() if isinstance(m.act, Tissue)
    }
    tissue = list(spaces)
    sets: list[tuple[str, ...]] = [()] * 4 + [(name,) for name in tissue]
    sets += [
        tuple(sorted(rng.choice(tissue, n, replace=False).tolist())) for n in (2,) * 4 + (3,) * 4 + (4,) * 4
    ]
    skins = []
    for names in sets:
        theta = where(base, rng, stiff_subcutis=False)
        for name in names:
            theta |= drawn(spaces[name], rng)
        skins.append(Skin(theta, names))
    return [*skins, *(Skin(where(base, rng, stiff_subcutis=True), ()) for _ in range(4))]


def where(base: ParameterSpace, rng: np.random.Generator, stiff_subcutis: bool) -> dict[str, float]:
    """A draw of the priors whose subcutis is more than twice as stiff as the cutis, or is not."""
    while True:
        theta = drawn(base, rng)
        if (theta["E_s"] > STIFF_SUBCUTIS * theta["E_c"]) == stiff_subcutis:
            return theta


def drawn(space: ParameterSpace, rng: np.random.Generator) -> dict[str, float]:
    """A draw of a prior by name."""
    return dict(zip(space.names, map(float, space.from_unit(rng.uniform(size=space.dim))), strict=True))


def keep_full_run(
    file: Path, key: str, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[str]
) -> None:
    """Runs the full model and keeps its force, where the file does not hold it yet."""
    with h5py.File(file, "a") as handle:
        if key in handle:
            return
    acting = [catalogue()[name] for name in mechanisms]
    run = simulate(ModelSpec(), motion, theta, laws=laws(acting), falls_too=False)
    with h5py.File(file, "a") as handle:
        group = handle.create_group(key)
        group["time_s"], group["force_n"] = run.time_s, run.force_n.astype(np.float32)
        group.attrs["message"] = run.message
    print(key, *mechanisms, run.message or f"{run.stats['seconds']:.1f} s", file=sys.stderr, flush=True)


class Row(NamedTuple):
    """A reduced run beside a full one: true and estimated errors over the peak, or why there are none."""

    rms: float
    largest: float
    estimate: float
    message: str


def compared(
    model: ReducedModel, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[str],
    group: h5py.Group, estimate: bool = False,
) -> Row:  # fmt: skip
    """Runs the reduced model and compares it at the full run's own steps."""
    acting = [catalogue()[name] for name in mechanisms]
    run = simulate_reduced(model, motion, theta, acting, estimate=estimate)
    if run.status != "ok":
        return Row(np.nan, np.nan, np.nan, run.message)
    time_s, force_n = group["time_s"][()], group["force_n"][()].astype(float)
    wrong_n, peak_n = run.at(time_s) - force_n, np.abs(force_n).max()
    rms_n = float(np.sqrt(np.average(wrong_n**2, weights=np.gradient(time_s))))
    estimate_n = run.stats.get("error_estimate_n", np.nan)
    return Row(rms_n / peak_n, float(np.abs(wrong_n).max() / peak_n), estimate_n / peak_n, "")


def table(model: ReducedModel) -> list[str]:
    """The table in Markdown: medians of RMS and largest error in % of the peak; 0.1 % is 1 mN at 1 N."""
    skins, rows = held_out(), dict[tuple[str, str], list[Row]]()
    with h5py.File(RESULTS) as handle:
        for number, skin in enumerate(skins):
            for name, protocol in PROTOCOLS.items():
                group = handle[f"{number:02d}/{name}"]
                if not group.attrs["message"]:
                    row = compared(model, protocol, skin.theta, skin.mechanisms, group)
                    rows.setdefault((skin.group, name), []).append(row)
                    print(number, name, skin.mechanisms, row, file=sys.stderr, flush=True)
    groups = sorted({group for group, _ in rows}, key=[skin.group for skin in skins].index)
    groups.sort(key=lambda group: not group.startswith("base"))
    lines = ["| skins | " + " | ".join(f"{name}: rms, max [% of peak]" for name in PROTOCOLS) + " |"]
    lines.append("| --- " * (1 + len(PROTOCOLS)) + "|")
    lines += [f"| {group} | " + " | ".join(_cell(rows.get((group, name), [])) for name in PROTOCOLS) + " |"
              for group in groups]  # fmt: skip
    return lines


def _cell(rows: Sequence[Row]) -> str:
    fine = [row for row in rows if not row.message]
    failed = f", {len(rows) - len(fine)} refused" if len(fine) < len(rows) else ""
    if not fine:
        return failed.lstrip(", ") or "–"
    rms, largest = (100 * np.median([getattr(row, name) for row in fine]) for name in ("rms", "largest"))
    return f"{rms:.3f}, {largest:.3f}{failed}"


def timed(model: ReducedModel, skin: Skin) -> str:
    """A reduced and a full run of the article's protocol in CPU seconds, side by side, as one line."""
    acting = [catalogue()[name] for name in skin.mechanisms]
    changes = {name: max(abs(0.1 * value), 1e-12) for name, value in skin.theta.items()}
    spent = []
    for run in (
        lambda: simulate_reduced(model, MOTION, skin.theta, acting),
        lambda: simulate_reduced(model, MOTION, skin.theta, acting, gradients=changes),
        lambda: simulate(ModelSpec(), MOTION, skin.theta, laws=laws(acting), falls_too=False),
    ):
        run()
        started = time.process_time()
        run()
        spent.append(time.process_time() - started)
    reduced, slopes, full = spent
    return (
        f"{', '.join(skin.mechanisms) or 'base model'}: {reduced:.2f} CPU s, {slopes:.2f} with "
        f"{len(changes)} derivatives; the full model {full:.1f}, {full / reduced:.0f} times as much."
    )


def main(arguments: Sequence[str]) -> None:
    """Prints the table."""
    if "--full" in arguments:
        for number, skin in enumerate(held_out()):
            for name, protocol in PROTOCOLS.items():
                keep_full_run(RESULTS, f"{number:02d}/{name}", protocol, skin.theta, skin.mechanisms)
    model = load_reduced(shipped(SHIPPED))
    print("\n".join(table(model)))
    for skin in (held_out()[0], held_out()[19]):
        print(timed(model, skin))


if __name__ == "__main__":
    main(sys.argv[1:])
