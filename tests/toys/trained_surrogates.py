"""Designs of the closed-form model, and surrogates that are trained on them once a process."""

from functools import cache

import numpy as np
from scipy.stats import qmc
from toys.closed_form_model import EDGES_S, SPACE, toy_bin_means

from bayeskin.surrogates import train
from bayeskin.types import Design


@cache
def toy_design(rows, held_out=48, seed=1):
    """Sobol' points to learn from and uniform ones held out."""
    learnt = qmc.Sobol(SPACE.dim, seed=seed).random_base2(int(np.log2(rows)))
    unit = np.vstack([learnt, np.random.default_rng(seed + 100).random((held_out, SPACE.dim))])
    theta = SPACE.from_unit(unit)
    n = len(unit)
    return Design(
        space=SPACE, edges_s=EDGES_S, theta=theta, force_n=toy_bin_means(theta), wave=np.zeros(n, int),
        held_out=np.arange(n) >= rows, ok=np.ones(n, bool), messages=("",) * n, seconds=np.ones(n),
        seed=seed, model_hash="toy",
    )  # fmt: skip


DESIGN = toy_design(128)


@cache
def trained_on(kind, rows=128):
    return train(toy_design(rows), kind, seed=0)
