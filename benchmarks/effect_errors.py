"""By how much shipped surrogates miss held-out full runs with a tissue mechanism, by size of its effect.

The surrogates of the base and of the effect together (of a pair also those of its parts) against runs that
neither was learnt from, as RMS over the recording, of forces brought to a peak of 1 N. The size of an effect
is what a run differs by from the base's surrogate. Beside them what the surrogates say of each bin by itself,
which a likelihood takes for noise.

    python benchmarks/effect_errors.py

Writes the table of each protocol between its markers of surrogates/README.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import healthy_skin
import numpy as np
import rows

from bayeskin import storage
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.binned import estimates_by_name
from bayeskin.recordings import idealised_motion, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.surrogates import effects_beside, effects_in, load_effect, load_surrogate, with_effects
from bayeskin.types import Array, Design, PadMotion

SURROGATES = Path(__file__).parents[1] / "surrogates"
SIZES_MN = (0.0, 50.0, 150.0, 300.0, np.inf)
RANGES = tuple(f"below {high:g} mN" if low == 0.0 else f"from {low:g} mN" if np.isinf(high)
               else f"{low:g} to {high:g} mN" for low, high in pairwise(SIZES_MN))  # fmt: skip
HEADER = ("part", *RANGES, "all", "runs", "noise of bins")


def motions() -> dict[str, PadMotion]:
    """The protocol of each shipped surrogate that has effects, by its name."""
    demo = read_recording(shipped("data/demo.h5"))
    return {
        "healthy-skin-reaction": healthy_skin.HEALTHY_SKIN,
        "demo": idealised_motion(demo, segment(demo)),
    }


def errors(base: Path, motion: PadMotion) -> dict[str, tuple[Array, Array, Array]]:
    """Of each part's held-out runs sizes, errors and noise of bins (n,), in mN at a peak of 1 N."""
    files = effects_in(effects_beside(base))
    estimates = estimates_by_name(catalogue(), motion)
    effects, alone = [load_effect(path, estimates) for path in files], load_surrogate(base)
    found = {}
    for path, effect in zip(files, effects, strict=True):
        design = storage.load(path.with_name(f"{path.stem}-design.h5"), Design)
        parts = [one for one in effects if set(one.own) < set(effect.own)]
        whole = with_effects(alone, [*parts, effect])
        truth = design.force_n[design.testing]
        theta = design.theta[design.testing]

        def at(names: Sequence[str], theta: Array = theta, design: Design = design) -> Array:
            return theta[:, [design.space.names.index(name) for name in names]]

        to_skin = 1e3 / np.maximum(np.abs(truth).max(axis=1), 1e-12)
        size, error = (
            to_skin * np.sqrt(np.mean((truth - made.predict_mean(at(made.space.names))) ** 2, axis=1))
            for made in (alone, whole)
        )
        bins = to_skin * np.sqrt(np.mean(whole.predict(at(whole.space.names)).diagonal, axis=1))
        found[effect.part] = size, error, bins
    return found


def table(found: dict[str, tuple[Array, Array, Array]]) -> str:
    """Medians by size, with the number of runs in brackets."""
    lines = []
    for part, (size, error, bins) in found.items():
        among = [error[(size >= low) & (size < high)] for low, high in pairwise(SIZES_MN)]
        cells = [f"{np.median(some):.2g} ({len(some)})" if len(some) else "-" for some in among]
        lines.append(
            [f"`{part}`", *cells, f"{np.median(error):.2g}", str(len(error)), f"{np.median(bins):.2g}"]
        )
    return rows.markdown(HEADER, lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surrogates", type=Path, default=SURROGATES, help="folder that holds them")
    folder = parser.parse_args().surrogates
    for name, motion in motions().items():
        block = table(errors(folder / f"{name}.h5", motion))
        print(f"{name}\n{block}")
        rows.into_docs(folder / "README.md", f"{name}-errors", block)


if __name__ == "__main__":
    main()
