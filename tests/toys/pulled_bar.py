"""A drained bar that is pulled with laws of mechanisms in it, and its elastic force in closed form."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.optimize import brentq
from toys.bar_models import LAM, MU, drained_bar
from toys.skin_with_mechanisms import SOLVED

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.stepping import advance

STRETCH_M = 0.3  # of the bar of unit length


def elastic_force(stretch):
    """Returns the first Piola-Kirchhoff stress and the transverse stretch of a drained, free bar."""
    across = brentq(lambda a: MU * (a - 1 / a) + LAM * np.log(stretch * a**2) / a, 0.3, 2.0)
    return MU * (stretch - 1 / stretch) + LAM * np.log(stretch * across**2) / stretch, across


BAR = drained_bar("bricks")


def bound(name, **values):
    """A mechanism's law at the points of the bar."""
    return SOLVED[name].act.bind(values, BAR.problem.sites)


def pulled(motion, *laws, steps=24):
    """Times and forces a unit area of a drained bar with laws, in equal steps of each phase."""
    held = LagrangianModel(BAR.problem, BAR.material, motion, laws)
    past = [held.initial_state(0.0)]
    points = [(0.0, 0.0)]
    for start, end in pairwise(held.motion.time_s):
        past = past[-1:]
        for _ in range(steps):
            step = advance(held, past[-3:], (end - start) / steps)
            past.append(step.state)
            points.append((step.state.time_s, step.force_n / 2.0))
    return np.array(points).T
