"""Defines the numeric settings of Gauss-Newton climbs and of the regression that gives their steps."""

from __future__ import annotations

from dataclasses import dataclass

from bayeskin.inference.problem import FORCE_STEP


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings of a Gauss-Newton climb. Where a quick climb has a setting of its own, its name says so.

    Steps
    damped : multiples of the information's diagonal that are added to it, in groups; a further group is tried
        only where the groups before it gain too little
    enough : gain of a round [nats] below which it counts as small; a climb ends after two small rounds, and a
        quick climb after one
    step : step of finite differences, as a share of the box

    Regression
    reweighted, quick_reweighted : number of steps with the weights of the t-distribution
    sides : largest number of steps in which it is settled which errors of the surrogate are beyond three sd
    rounding : share of a precision matrix's trace that is added to its diagonal against rounding

    Noise, in a quick climb
    noise_steps : multiples of a Newton step of the noise that are tried
    farthest_noise : largest step of the noise, as a share of the box
    error_draws : number of draws of the surrogate's error over which a step of the noise averages; it is
        even, since each draw comes with its opposite
    """

    damped: tuple[tuple[float, ...], ...] = ((0.0, 1e-2, 1.0), (1e2, 1e4))
    enough: float = 0.02
    step: float = FORCE_STEP
    reweighted: int = 4
    quick_reweighted: int = 2
    sides: int = 6
    rounding: float = 1e-12
    noise_steps: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0)
    farthest_noise: float = 0.5
    error_draws: int = 8
