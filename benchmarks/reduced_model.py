"""Measures the error of the shipped reduced model on unseen skins and protocols, and its cost.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_model.py [--full]

Thirty-one skins are drawn from the priors: four of the base model, one with each of the eleven mechanisms of
the tissue, four each with two, three and four of these mechanisms, and four of the base model whose subcutis
is more than twice as stiff as the cutis. Each skin is run on the article's protocol and on four others. The
forces of the full model are stored in results/reduced_held_out.h5. With --full the missing ones are computed,
in some ten seconds each. reduced_error.py tests the error that the model itself estimates.
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
STIFF_SUBCUTIS = 2.0  # ratio to the cutis' modulus above which a subcutis counts as stiff


def motion(time_s: Sequence[float], height_mm: Sequence[float]) -> PadMotion:
    """Returns a protocol with the given corners."""
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
    """Holds the values of all parameters of a held-out skin, and the mechanisms that act in it."""

    theta: dict[str, float]
    mechanisms: tuple[str, ...]

    @property
    def group(self) -> str:
        """Returns the label of the table's row that the skin belongs to."""
        count = len(self.mechanisms)
        if count == 0:
            stiff = self.theta["E_s"] > STIFF_SUBCUTIS * self.theta["E_c"]
            return "base, stiff subcutis" if stiff else "base"
        return self.mechanisms[0] if count == 1 else f"sets of {count}"


def held_out() -> list[Skin]:
    """Returns the held-out skins, which are the same in every call because their seed is fixed."""
    rng, base = np.random.default_rng(SEED), default_space()
    spaces = {
        name: ParameterSpace(mechanism.parameters)
        for name, mechanism in catalogue().items()
        if isinstance(mechanism.act, Tissue)
    }
    tissue_mechanisms = list(spaces)
    mechanism_sets: list[tuple[str, ...]] = [()] * 4 + [(name,) for name in tissue_mechanisms]
    mechanism_sets += [
        tuple(sorted(rng.choice(tissue_mechanisms, n, replace=False).tolist()))
        for n in (2,) * 4 + (3,) * 4 + (4,) * 4
    ]
    skins = []
    for names in mechanism_sets:
        theta = where(base, rng, stiff_subcutis=False)
        for name in names:
            theta |= drawn(spaces[name], rng)
        skins.append(Skin(theta, names))
    return [*skins, *(Skin(where(base, rng, stiff_subcutis=True), ()) for _ in range(4))]


def where(base: ParameterSpace, rng: np.random.Generator, stiff_subcutis: bool) -> dict[str, float]:
    """Returns a draw of the priors whose subcutis is, or is not, more than twice as stiff as the cutis."""
    while True:
        theta = drawn(base, rng)
        if (theta["E_s"] > STIFF_SUBCUTIS * theta["E_c"]) == stiff_subcutis:
            return theta


def drawn(space: ParameterSpace, rng: np.random.Generator) -> dict[str, float]:
    """Returns one draw of a prior by the parameters' names."""
    return dict(zip(space.names, map(float, space.from_unit(rng.uniform(size=space.dim))), strict=True))


def keep_full_run(
    file: Path, key: str, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[str]
) -> None:
    """Runs the full model and stores its force in the file, unless the file has it already."""
    with h5py.File(file, "a") as handle:
        if key in handle:
            return
    active = [catalogue()[name] for name in mechanisms]
    run = simulate(ModelSpec(), motion, theta, laws=laws(active), falls_too=False)
    with h5py.File(file, "a") as handle:
        group = handle.create_group(key)
        group["time_s"], group["force_n"] = run.time_s, run.force_n.astype(np.float32)
        group.attrs["message"] = run.message
    print(key, *mechanisms, run.message or f"{run.stats['seconds']:.1f} s", file=sys.stderr, flush=True)


class Row(NamedTuple):
    """Holds true and estimated errors of a reduced run over the peak, or the message why it failed."""

    rms: float
    largest: float
    estimate: float
    message: str


def compared(
    model: ReducedModel, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[str],
    group: h5py.Group, estimate: bool = False,
) -> Row:  # fmt: skip
    """Runs the reduced model, and returns its errors at the time steps of the full run."""
    active = [catalogue()[name] for name in mechanisms]
    run = simulate_reduced(model, motion, theta, active, estimate=estimate)
    if run.status != "ok":
        return Row(np.nan, np.nan, np.nan, run.message)
    time_s, force_n = group["time_s"][()], group["force_n"][()].astype(float)
    error_n, peak_n = run.at(time_s) - force_n, np.abs(force_n).max()
    rms_n = float(np.sqrt(np.average(error_n**2, weights=np.gradient(time_s))))
    estimate_n = run.stats.get("error_estimate_n", np.nan)
    return Row(rms_n / peak_n, float(np.abs(error_n).max() / peak_n), estimate_n / peak_n, "")


def table(model: ReducedModel) -> list[str]:
    """Returns the lines of the Markdown table: medians of RMS and largest error in % of the peak.

    At a peak of 1 N, 0.1 % is 1 mN.
    """
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
    """Returns the table's cell of some runs: median errors, and the number of refused runs."""
    finished = [row for row in rows if not row.message]
    refused = f", {len(rows) - len(finished)} refused" if len(finished) < len(rows) else ""
    if not finished:
        return refused.lstrip(", ") or "–"
    rms, largest = (100 * np.median([getattr(row, name) for row in finished]) for name in ("rms", "largest"))
    return f"{rms:.3f}, {largest:.3f}{refused}"


def timed(model: ReducedModel, skin: Skin) -> str:
    """Returns a line with the CPU seconds of a reduced and of a full run of the article's protocol."""
    active = [catalogue()[name] for name in skin.mechanisms]
    changes = {name: max(abs(0.1 * value), 1e-12) for name, value in skin.theta.items()}
    spent_s = []
    for run in (
        lambda: simulate_reduced(model, MOTION, skin.theta, active),
        lambda: simulate_reduced(model, MOTION, skin.theta, active, gradients=changes),
        lambda: simulate(ModelSpec(), MOTION, skin.theta, laws=laws(active), falls_too=False),
    ):
        run()
        started = time.process_time()
        run()
        spent_s.append(time.process_time() - started)
    reduced_s, with_derivatives, full_s = spent_s
    return (
        f"{', '.join(skin.mechanisms) or 'base model'}: {reduced_s:.2f} CPU s, {with_derivatives:.2f} with "
        f"{len(changes)} derivatives; the full model {full_s:.1f}, {full_s / reduced_s:.0f} times as much."
    )


def main(arguments: Sequence[str]) -> None:
    """Prints the table and the costs."""
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
