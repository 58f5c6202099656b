"""A set of mechanisms fitted by a forward model that solves all of them together.

Each run of the model carries its derivatives, so the posterior is known about it (`tangent`); what acts on
the force alone, and the noise, are exact there. A round maximises this posterior, as all runs so far tell it,
within a trust region of the parameters that the model solves, makes a run at the maximum, and goes on from
it if the posterior has risen there. A run that was no gain tells where not to go.

Conn, Gould & Toint, Trust-Region Methods (2000), chapter 6.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayeskin.forward.interface import ModelRun
from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import Top, gauss_newton, with_less_noise
from bayeskin.inference.reparametrisation import Shear, shear_at
from bayeskin.mismatch.fit import Fit, evidence, stored
from bayeskin.mismatch.tangent import POWER
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array


@dataclass(frozen=True)
class TrustSettings:
    """Half widths of the trust region, of the prior's width: at first, at most and at last.

    kept : share of the promised gain that a step has to reach for the region to stay as it is; more : from
        which on it grows; shrinks, grows : by what factors
    moved : share of its half width, from which on a parameter has moved far: the region shrinks and grows
        along those that have
    enough : nats still promised at which a fit is settled
    runs : at most
    climb, held : rounds of Gauss-Newton in a trust region, and with the model's parameters held
    """

    first: float = 0.2
    largest: float = 0.5
    smallest: float = 0.004
    kept: float = 0.3
    more: float = 0.8
    shrinks: float = 0.3
    moved: float = 0.5
    grows: float = 2.0
    enough: float = 0.3
    runs: int = 9
    climb: int = 15
    held: int = 6


# Names of a set and values by name to a run with derivatives, or why it failed.
Skin = Callable[[Sequence[str], Mapping[str, float]], ModelRun | str]
Local = Callable[[Sequence[str], Sequence[ModelRun]], LogPosterior]  # the posterior of a set about runs


@dataclass(frozen=True)
class SetFit:
    """A fit, the run it is about, how many runs it took, and whether little is left to be gained.

    correction_n (m,) : what was added to the force of each run, since the forward model is off by it near by
    """

    fit: Fit
    run: ModelRun
    runs: int
    settled: bool
    correction_n: Array


def as_json(found: SetFit) -> dict[str, Any]:
    """A joint fit, as a bench reads it."""
    assert found.run.slopes_n is not None
    run = {
        "theta": found.run.theta.tolist(), "force_n": found.run.force_n.tolist(),
        "slopes_n": found.run.slopes_n.tolist(),
    }  # fmt: skip
    return {
        "fit": stored(found.fit), "run": run, "runs": found.runs, "settled": found.settled,
        "off_n": found.correction_n.tolist(),
    }  # fmt: skip


def fit_set(
    names: Sequence[str], start: Mapping[str, float], skin: Skin, local: Local,
    settings: TrustSettings | None = None, correction_n: Array | None = None,
) -> SetFit | str:  # fmt: skip
    """Returns the maximum of a set that is reached from `start` (all parameters, SI).

    correction_n (m,) : added to the force of each run
    Returns the message of the first run where that fails.
    """
    settings = settings or TrustSettings()

    def made_at(theta: Mapping[str, float]) -> ModelRun | str:
        run = skin(names, theta)
        return (
            run
            if isinstance(run, str) or correction_n is None
            else replace(run, force_n=run.force_n + correction_n)
        )

    run = made_at(start)
    if isinstance(run, str):
        return run
    runs, about = [run], local(names, [run])
    vector, value = _at_run(about, np.clip(about.vector(start), *about.bounds), settings.held)
    (low, high), solved = about.bounds, solved_columns(about)
    reach = np.where(solved, settings.first, 1.0)
    settled, made = False, 1
    while made < settings.runs and reach.min() >= settings.smallest:
        ridge = shear_at(about, vector, POWER)
        ahead, promised = _highest(about, in_box(about, vector, reach), vector, settings.climb, ridge)
        moved = (np.abs(ahead - vector) / (high - low))[: len(reach)]
        far = np.logical_and(solved, moved >= settings.moved * reach)
        promised -= value
        if promised < settings.enough:
            settled = True
            break
        made += 1
        there = made_at(about.named(about.from_sampling(ahead)))
        gained = -np.inf
        if not isinstance(there, str):
            runs.append(there)
            about = local(names, runs)
            ahead, its_value = _at_run(about, ahead, settings.held)
            gained = its_value - value
        if gained > 0.0 and not isinstance(there, str):
            run, vector, value = there, ahead, its_value
        if gained < settings.kept * promised:
            reach[far if far.any() else solved] *= settings.shrinks
        elif gained > settings.more * promised:
            reach[far] = np.minimum(settings.grows * reach[far], settings.largest)
    correction_n = np.zeros_like(run.force_n) if correction_n is None else correction_n
    return SetFit(_fit(names, local(names, [run]), vector), run, made, settled, correction_n)


def _at_run(about: LogPosterior, vector: Array, rounds: int) -> tuple[Array, float]:
    """Returns the most probable point (D,) with the model's parameters held, and its log density."""
    return _highest(about, within(about, vector, 0.0), vector, rounds)


def _highest(
    about: LogPosterior, near: LogPosterior, vector: Array, rounds: int, ridge: Shear | None = None
) -> tuple[Array, float]:
    """Returns the most probable point (D,) of a part of the posterior, and its log density.

    ridge : of the moduli, which steps may follow

    Climbs set out from the noise as it is and from little: noise that took up another run's misfit stays.
    """
    starts = [vector, with_less_noise(about, vector)]
    tops = [gauss_newton(near, np.clip(start, *near.bounds), ridge, rounds) for start in starts]
    better = np.clip(max(tops, key=lambda top: top.value).vector, *about.bounds)
    return better, float(about.log_prob(better[None])[0])


def _fit(names: Sequence[str], about: LogPosterior, vector: Array) -> Fit:
    top: Top = gauss_newton(about, vector, None, 0)
    theta = about.named(about.from_sampling(top.vector))
    return Fit(tuple(names), about, theta, top.value, *evidence(about, top), top.latent)


def within(about: LogPosterior, vector: Array, reach: float) -> LogPosterior:
    """Returns the same posterior with the parameters that the model solves held near a point (D,).

    reach : of the prior's width, on either side
    """
    return in_box(about, vector, np.where(solved_columns(about), reach, 1.0))


def in_box(about: LogPosterior, vector: Array, reach: Array) -> LogPosterior:
    """Returns the same posterior in a smaller box about a point (D,).

    reach (d,) : of the prior's width, on either side, for each of the surrogate's parameters
    """
    space, (low, high) = about.surrogate.space, about.bounds
    low, high, line = low[: space.dim], high[: space.dim], vector[: space.dim]
    far = np.maximum(reach, 1e-9) * (high - low)
    lower, upper = (space.from_line(np.clip(line + sign * far, low, high)) for sign in (-1.0, 1.0))
    prior = about.material or space
    narrowed = tuple(
        replace(p, lower=float(max(a, p.lower)), upper=float(min(b, p.upper)))
        for p, a, b in zip(prior.parameters, lower, upper, strict=True)
    )
    return replace(about, material=replace(prior, parameters=narrowed))


def solved_columns(about: LogPosterior) -> Array:
    """Returns whether the forward model solves each of the surrogate's parameters, (d,)."""
    inner = set(innermost(about.surrogate).space.names)
    return np.array([name in inner for name in about.surrogate.space.names])
