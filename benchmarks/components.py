"""How many components of a force's shape a surrogate needs, so that a posterior does not take them for skin.

What the components leave out of a shape counts as noise of each bin by itself. It is none: it is the same
over many bins, and a millinewton of it, kept up over a recording, moves a posterior by many of its sd. The
shipped surrogate of the healthy-skin protocol, cut to fewer components than it has, against held-out runs,
both brought to a peak of 1 N: the error, what of it counts as noise of bins, and by how many nats a run's own
parameters are the less likely, beside a noise of 2 mN, for what the surrogate's factor does not explain.

    python benchmarks/components.py

Writes the table between the markers of docs/surrogate.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import rows

from bayeskin import storage
from bayeskin.shipped import shipped
from bayeskin.surrogates import ShapeSurrogate, load_surrogate
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.shapes import split
from bayeskin.types import Array, Design

NOISE_N = 2e-3
FEWEST = 2
DOCS = Path(__file__).parents[1] / "docs"
HEADER = ("components", "held-out error [mN]", "of it noise of bins [mN]", "median [nats]", "largest [nats]")


def cut(surrogate: ShapeSurrogate, count: int, shapes: Array) -> ShapeSurrogate:
    """The same with its first `count` components alone; shapes (n, m) of the runs that it has learnt from."""
    latents, kept = surrogate.latents, count + 1
    assert isinstance(latents, LatentGPs)
    fewer = LatentGPs(
        latents.inputs, latents.targets[:, :kept], latents.linear_maps[:kept], latents.nuggets[:kept],
        latents.inflation[:kept], latents.kernels[:kept],
    )  # fmt: skip
    return replace(
        surrogate,
        transform=surrogate.transform.keep(count, shapes, np.ones(len(shapes)), fitted=count + 1),
        latents=fewer,
    )


def unexplained(error_n: Array, factor: Array, diagonal: Array) -> float:
    """Nats of an error (m,) [N] that a factor (m, r) leaves, beside the noise and diagonal (m,)."""
    precision = 1.0 / (diagonal + NOISE_N**2)
    normal = factor.T @ (precision[:, None] * factor) + np.eye(factor.shape[1])
    taken = factor @ np.linalg.solve(normal, factor.T @ (precision * error_n))
    return 0.5 * float(error_n @ (precision * (error_n - taken)))


def judged(surrogate: ShapeSurrogate, theta: Array, force_n: Array) -> tuple[float, float, float, float]:
    """Of held-out runs theta (n, d) with forces (n, m): the columns of the table."""
    found = surrogate.predict(theta)
    peak = np.abs(force_n).max(axis=1)
    error = (found.mean - force_n) / peak[:, None]
    diagonal = found.diagonal / peak[:, None] ** 2
    nats = [unexplained(e, f / p, d) for e, f, d, p in zip(error, found.factor, diagonal, peak, strict=True)]
    rms = 1e3 * np.sqrt(np.mean(error**2, axis=1))
    return (
        float(np.median(rms)), 1e3 * float(np.sqrt(np.median(diagonal.mean(axis=1)))),
        float(np.median(nats)), float(np.max(nats)),
    )  # fmt: skip


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    surrogate = load_surrogate(shipped("surrogates/healthy-skin-reaction.h5"))
    design = storage.load(shipped("surrogates/healthy-skin-reaction-design.h5"), Design)
    shapes = split(design.force_n[design.training])[1]
    theta, force_n = design.theta[design.testing], design.force_n[design.testing]
    lines = []
    for count in range(FEWEST, len(surrogate.transform.components) + 1):
        error, bins, typical, most = judged(cut(surrogate, count, shapes), theta, force_n)
        lines.append([str(count), f"{error:.2f}", f"{bins:.2f}", f"{typical:.1f}", f"{most:.1f}"])
    text = rows.markdown(HEADER, lines)
    print(text)
    rows.into_docs(DOCS / "surrogate.md", "components", text)


if __name__ == "__main__":
    main()
