"""Chooses the tissues from which fits start: those whose force is nearest to the recorded force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayeskin.mismatch.search_context import SearchContext
from bayeskin.mismatch.search_record import Names
from bayeskin.mismatch.tasks import RunTask


def nearest_tissues(
    context: SearchContext, names: Names, tissues: Sequence[Mapping[str, float]], values: Mapping[str, float]
) -> list[dict[str, float]]:
    """Returns the tissues, each scaled to the stiffness that suits the recording best, the nearest first.

    If all moduli of a tissue are multiplied by c, and its permeabilities by 1/c, its force is multiplied by
    c. A tissue for which the model's run fails is left out.

    names, values : the set of mechanisms with which the model runs, and the values of all other parameters
    tissues : values of the base model's parameters
    """
    usable = np.isfinite(context.binned.force_n)
    recorded, rows = context.binned.force_n[usable], []
    answers = context.ask([RunTask(names, {**values, **tissue}) for tissue in tissues])
    powers = {p.name: p.stress_power for p in context.base.parameters if p.stress_power}
    for tissue, force_n in zip(tissues, answers, strict=True):
        if isinstance(force_n, str):
            continue
        force = np.asarray(force_n)[usable]
        lowest, highest = _allowed_factors(context, tissue, powers)
        factor = float(np.clip(force @ recorded / (force @ force), lowest, highest))
        scaled = {name: value * factor ** powers.get(name, 0) for name, value in tissue.items()}
        rows.append((float(np.sum((recorded - factor * force) ** 2)), scaled))
    return [tissue for _, tissue in sorted(rows, key=lambda row: row[0])]


def _allowed_factors(
    context: SearchContext, tissue: Mapping[str, float], powers: Mapping[str, int]
) -> tuple[float, float]:
    """Returns the smallest and the largest factor with which all scaled parameters stay within their priors.

    powers : the powers of the factor by which the parameters are multiplied
    """
    lowest, highest = 0.0, np.inf
    for p in context.base.parameters:
        if power := powers.get(p.name, 0):
            ends = sorted((end / tissue[p.name]) ** (1.0 / power) for end in (p.lower, p.upper))
            lowest, highest = max(lowest, ends[0] * 1.001), min(highest, ends[1] / 1.001)
    return min(lowest, 1.0), max(highest, 1.0)
