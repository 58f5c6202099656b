"""Shows how many principal components a surrogate's force shape needs for an unbiased posterior.

The surrogate treats the part of a shape that its components do not represent as independent noise of each
bin. In truth this part is the same over many bins. A millinewton of it that lasts over a whole recording
shifts a posterior by many of its sd. This benchmark takes the shipped surrogate of the healthy-skin protocol,
reduces it to fewer components, and compares it with held-out runs. Both are scaled to a peak force of 1 N.
The table has the held-out error and the part of it that counts as noise of the bins. It also has the loss of
log-likelihood [nats] at a run's own parameters that the surrogate's factor does not explain, beside a noise
of 2 mN.

    python benchmarks/components.py

The program writes the table between the markers of docs/surrogate.md.
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
HEADER = (
    "components", "held-out error [mN]", "sd treated as noise of bins [mN]", "median loss [nats]",
    "largest loss [nats]",
)  # fmt: skip


def cut(surrogate: ShapeSurrogate, count: int, shapes: Array) -> ShapeSurrogate:
    """Returns the surrogate with only its first `count` components.

    shapes (n, m) : force shapes of the runs that the surrogate was trained on
    """
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
    """Returns the loss of log-likelihood [nats] by the part of an error that the surrogate does not state.

    error_n (m,) : error of the surrogate [N]
    factor (m, r) : factor of the covariance that the surrogate states [N]
    diagonal (m,) : independent variance of each bin that the surrogate states [N^2]; the noise is added to it
    """
    precision = 1.0 / (diagonal + NOISE_N**2)
    normal_matrix = factor.T @ (precision[:, None] * factor) + np.eye(factor.shape[1])
    explained_n = factor @ np.linalg.solve(normal_matrix, factor.T @ (precision * error_n))
    return 0.5 * float(error_n @ (precision * (error_n - explained_n)))


def judged(surrogate: ShapeSurrogate, theta: Array, force_n: Array) -> tuple[float, float, float, float]:
    """Returns the table's columns after the first, for held-out runs at theta (n, d) with forces (n, m)."""
    prediction = surrogate.predict(theta)
    peak = np.abs(force_n).max(axis=1)
    error = (prediction.mean - force_n) / peak[:, None]
    diagonal = prediction.diagonal / peak[:, None] ** 2
    nats = [
        unexplained(e, f / p, d) for e, f, d, p in zip(error, prediction.factor, diagonal, peak, strict=True)
    ]
    rms_mn = 1e3 * np.sqrt(np.mean(error**2, axis=1))
    return (
        float(np.median(rms_mn)), 1e3 * float(np.sqrt(np.median(diagonal.mean(axis=1)))),
        float(np.median(nats)), float(np.max(nats)),
    )  # fmt: skip


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    surrogate = load_surrogate(shipped("surrogates/healthy-skin-reaction.h5"))
    design = storage.load(shipped("surrogates/healthy-skin-reaction-design.h5"), Design)
    shapes = split(design.force_n[design.training])[1]
    theta, force_n = design.theta[design.testing], design.force_n[design.testing]
    table = []
    for count in range(FEWEST, len(surrogate.transform.components) + 1):
        error, bins, typical, largest = judged(cut(surrogate, count, shapes), theta, force_n)
        table.append([str(count), f"{error:.2f}", f"{bins:.2f}", f"{typical:.1f}", f"{largest:.1f}"])
    text = rows.markdown(HEADER, table)
    print(text)
    rows.into_docs(DOCS / "surrogate.md", "components", text)


if __name__ == "__main__":
    main()
