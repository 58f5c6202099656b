"""A set of mechanisms fitted by a forward model that solves all of them together.

Each run of the model carries its derivatives, so the posterior is known about it (`tangent`); what acts on
the force alone, and the noise, are exact there. A round maximises this posterior within a trust region of
the parameters that the model solves, makes a run at the maximum, and goes on from it if the posterior has
risen there by a part of what was promised.

Conn, Gould & Toint, Trust-Region Methods (2000), chapter 6.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import Top, gauss_newton
from bayeskin.mismatch.corrected import FullRun
from bayeskin.mismatch.fit import Fit, evidence
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array


@dataclass(frozen=True)
class TrustSettings:
    """Half width of the trust region, of the prior's width: at first, at most and at last.

    kept : share of the promised gain that a step has to reach for the region to stay as it is
    enough : nats still promised at which a fit is settled
    runs : at most
    climb : rounds of Gauss-Newton in a trust region
    """

    first: float = 0.15
    largest: float = 0.5
    smallest: float = 0.004
    kept: float = 0.3
    enough: float = 0.3
    runs: int = 9
    climb: int = 15


# Names of a set and values by name to a run with derivatives, or why it failed.
Skin = Callable[[Sequence[str], Mapping[str, float]], FullRun | str]
Local = Callable[[Sequence[str], FullRun], LogPosterior]  # the posterior of a set about a run


@dataclass(frozen=True)
class JointFit:
    """A fit, the run it is about, how many runs it took, and whether little is left to be gained."""

    fit: Fit
    run: FullRun
    runs: int
    settled: bool


def fit_jointly(
    names: Sequence[str], start: Mapping[str, float], skin: Skin, local: Local,
    settings: TrustSettings | None = None,
) -> JointFit | str:  # fmt: skip
    """Returns the maximum of a set that is reached from `start` (all parameters, SI).

    Returns the message of the first run where that fails.
    """
    settings = settings or TrustSettings()
    run = skin(names, start)
    if isinstance(run, str):
        return run
    about = local(names, run)
    vector, value = _at_run(about, about.vector(start))
    trust, settled, made = settings.first, False, 1
    while made < settings.runs and trust >= settings.smallest:
        near = within(about, vector, trust)
        top = gauss_newton(near, np.clip(vector, *near.bounds), None, settings.climb)
        ahead = np.clip(top.vector, *about.bounds)
        promised = float(about.log_prob(ahead[None])[0]) - value
        if promised < settings.enough:
            settled = True
            break
        made += 1
        there = skin(names, about.named(about.from_sampling(ahead)))
        gained = -np.inf
        if not isinstance(there, str):
            other = local(names, there)
            moved, its_value = _at_run(other, ahead)
            gained = its_value - value
        if gained > 0.0 and not isinstance(there, str):
            run, about, vector, value = there, other, moved, its_value
        if gained < settings.kept * promised:
            trust *= 0.3
        elif gained > 0.8 * promised:
            trust = min(2.0 * trust, settings.largest)
    return JointFit(_fit(names, about, vector), run, made, settled)


def _at_run(about: LogPosterior, vector: Array) -> tuple[Array, float]:
    """The point (D,) with what is exact at the run as the recording asks for, and its log density."""
    held = within(about, vector, 0.0)
    top = gauss_newton(held, np.clip(vector, *held.bounds), None, 6)
    better = np.clip(top.vector, *about.bounds)
    return better, float(about.log_prob(better[None])[0])


def _fit(names: Sequence[str], about: LogPosterior, vector: Array) -> Fit:
    top: Top = gauss_newton(about, vector, None, 0)
    theta = about.named(about.from_sampling(top.vector))
    return Fit(tuple(names), about, theta, top.value, *evidence(about, top), top.latent)


def within(about: LogPosterior, vector: Array, reach: float) -> LogPosterior:
    """The same posterior in a smaller box: `reach` of the prior's width on either side of a point (D,), in
    the parameters that the model solves."""
    space, (low, high) = about.surrogate.space, about.bounds
    solved = solved_columns(about)
    width = (high - low)[: space.dim]
    far = np.where(solved, max(reach, 1e-9), 1.0) * width
    line = vector[: space.dim]
    lower, upper = (space.from_line(np.clip(line + sign * far, low[: space.dim], high[: space.dim]))
                    for sign in (-1.0, 1.0))  # fmt: skip
    prior = about.material or space
    narrowed = tuple(
        replace(p, lower=float(max(a, p.lower)), upper=float(min(b, p.upper)))
        for p, a, b in zip(prior.parameters, lower, upper, strict=True)
    )
    return replace(about, material=replace(prior, parameters=narrowed))


def solved_columns(about: LogPosterior) -> Array:
    """Which of the surrogate's parameters (d,) the forward model solves: those of its innermost surrogate."""
    inner = set(innermost(about.surrogate).space.names)
    return np.array([name in inner for name in about.surrogate.space.names])
