"""How far the derivatives of the 80 coarsest bricks are off from those of the model's own mesh.

    python benchmarks/coarse_slopes.py

A diagnosis fits the full model with the former (bayeskin/mismatch/full_fit.py). Both are exact on their mesh;
the force is the `reaction` over the healthy-skin protocol, alone and with mechanisms of the tissue, and the
coarse ones are scaled by the factor that brings the coarse force nearest. Prints RMS over bins by one
coordinate of the prior's box, and writes the table into docs/verification.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rows
from healthy_skin import HEALTHY_SKIN, POINTS

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.full_fit import change
from bayeskin.model import ModelSpec
from bayeskin.pipeline.reported import FullForce
from bayeskin.pipeline.taking_up import nearest_factor
from bayeskin.proof.protocol import EDGES_S, SURROGATE
from bayeskin.proof.remains import rms
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import ParameterSpace

PAGE = Path(__file__).parents[1] / "docs" / "verification.md"
CASES = {
    "A": ("A", {}),
    "C": ("C", {}),
    "soft": ("soft", {}),
    "A, preconditioning": ("A", {"damage": 0.3, "damage_energy": 3e3}),
    "A, solid-viscoelasticity": ("A", {"g_1": 0.4, "tau_1": 2.0, "g_2": 0.6, "tau_2": 60.0}),
}


def relative(case: str) -> dict[str, tuple[float, float]]:
    """By each parameter the own mesh's derivative [N], RMS over bins, and over it the coarse one's error."""
    point, values = CASES[case]
    names = [name for name, one in catalogue().items() if {p.name for p in one.parameters} & set(values)]
    base = load_surrogate(shipped(SURROGATE)).space
    space = ParameterSpace((*base.parameters, *(p for n in names for p in catalogue()[n].parameters)))
    theta = {**POINTS[point], **values}
    by_coordinate = change(space, np.array([theta[name] for name in space.names]))
    changes = dict(zip(space.names, by_coordinate, strict=True))
    own = ModelSpec()
    found = [
        FullForce(spec, HEALTHY_SKIN, EDGES_S).with_slopes((names, theta), changes)
        for spec in (own, own.coarsest)
    ]
    if any(isinstance(one, str) for one in found):
        raise SystemExit(f"{case}: {found}")
    (own_n, own_slopes), (coarse_n, coarse_slopes) = found  # type: ignore[misc]
    coarse_slopes = nearest_factor(coarse_n, own_n) * coarse_slopes
    return {
        name: (float(size), float(rms(coarse_slopes[:, i] - own_slopes[:, i]) / size))
        for i, name in enumerate(space.names)
        if (size := rms(own_slopes[:, i])) > 1e-4  # the initial pressure moves no force
    }


def main() -> None:
    table, errors = [], []
    for case in CASES:
        for name, (slope_n, error) in relative(case).items():
            table.append([case, name, f"{1e3 * slope_n:.1f} mN", f"{100 * error:.1f} %"])
            errors.append(error)
    table.append(["all", "RMS", "", f"{100 * rms(np.array(errors)):.0f} %"])
    text = rows.markdown(("skin", "by", "derivative, RMS", "the coarse one's error"), table)
    print(text)
    rows.into_docs(PAGE, "coarse-slopes", text)


if __name__ == "__main__":
    main()
