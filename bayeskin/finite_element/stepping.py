"""Integrates the model in time: second order, with adaptive steps that end on every corner of the protocol.

The pressure's rate jumps at a corner of the protocol. Each phase therefore starts with steps of Alexander's
two-stage singly diagonally implicit Runge-Kutta method (SIAM J. Numer. Anal. 14, 1977; gamma = 1 - 1/sqrt(2),
stiffly accurate, L-stable), which needs no history. The phase continues with the variable-step backward
differentiation formula of second order (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
section III.5), which needs half as many solves. Each stage of either method is one solve of J - J* ... = h*
div(...) with its own history J*, p* and length h*. The local error of the fluid mass, filtered through the
tangent (Hosea & Shampine 1996), gives an error of the force in newtons. This error controls the length of the
steps.

A soft cutis on a stiff subcutis folds: it snaps from one equilibrium to another. A step that fails at the
smallest length is treated as such a fall (`relaxation`), and the integration restarts after it. On
fine meshes wrinkles may follow each other without end. A run whose falls take too many steps is therefore
stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from bayeskin.finite_element.extrapolation import EXTRAPOLATION_POINTS, extrapolate, extrapolation_weights
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.types import Array, PadMotion

GAMMA = 1.0 - np.sqrt(0.5)


@dataclass(frozen=True)
class StepSettings:
    """Settings of the control of time steps.

    first_s : length of the first step of a phase [s]; in a phase shorter than twice this, half the phase
    shortest : relative to the phase; a step that would have to be shorter is a fall, or fails
    growth, shrink : largest and smallest ratio of a step to the step before; the method is zero-stable while
        steps grow less than 2.41-fold
    steps_per_phase : smallest number of steps in a phase. Fewer and longer steps would cost as much, because
        their guesses are worse and their tangents differ more
    most_crawls : largest number of relaxation steps in a run; a fall takes about 150
    """

    first_s: float = 1.0
    shortest: float = 1e-3
    growth: float = 2.0
    shrink: float = 0.25
    steps_per_phase: int = 5
    most_crawls: int = 3000


STEPPING = StepSettings()


class Solver(Protocol):
    """The solver of a model.

    counts : counts of the work done, among them "crawls" and "falls"
    """

    @property
    def counts(self) -> Mapping[str, int]: ...


class Equations(Protocol):
    """The full or reduced model that is integrated in time. `LagrangianModel` describes each member."""

    @property
    def starts_s(self) -> float: ...

    @property
    def motion(self) -> PadMotion: ...

    @property
    def solver(self) -> Solver: ...

    def initial_state(self, p_init: float) -> State: ...

    def nominal_force(self) -> float: ...

    def remember_travel(self, past: list[State]) -> None: ...

    def solve_stage(
        self,
        time_s: float,
        length_s: float,
        sources: tuple[tuple[float, State], ...],
        guess: Array,
        jump: bool,
        fall: bool = False,
    ) -> Stage | None: ...

    def finish(self, stages: tuple[Stage, ...], mass: Array) -> Step: ...


def advance(model: Equations, past: list[State], h: float) -> Step | None:
    """Returns the step of length h [s] from the last state in `past`, or None without convergence.

    past : the last states of this phase
    """
    if len(past) < EXTRAPOLATION_POINTS:
        return _runge_kutta(model, past, h)
    return _backward_difference(model, past, h)


def _runge_kutta(model: Equations, past: list[State], h: float) -> Step | None:
    """Returns a step of Alexander's two-stage Runge-Kutta method, or None if a stage does not converge."""
    stage_length = GAMMA * h
    state = past[-1]
    t1, t2 = state.time_s + stage_length, state.time_s + h
    stage1 = model.solve_stage(t1, stage_length, ((1.0, state),), _guess(past, t1), len(past) == 1)
    if stage1 is None:
        return None
    ahead = (1.0 - GAMMA) / GAMMA
    sources = ((1.0 - ahead, state), (ahead, stage1.state))
    stage2 = model.solve_stage(t2, stage_length, sources, _guess([*past, stage1.state], t2), False)
    if stage2 is None:
        return None
    mass = (stage2.state.volume - stage2.history.volume) - (stage1.state.volume - state.volume)
    return model.finish((stage1, stage2), mass)


def _backward_difference(model: Equations, past: list[State], h: float) -> Step | None:
    """Returns a step of the backward differentiation formula, or None if it does not converge."""
    older, old, state = past[-3:]
    before, earlier = state.time_s - old.time_s, old.time_s - older.time_s
    ratio = h / before
    spread = 1.0 + 2.0 * ratio
    sources = ((-(ratio**2) / spread, old), ((1.0 + ratio) ** 2 / spread, state))
    time_s = state.time_s + h
    stage = model.solve_stage(time_s, h * (1.0 + ratio) / spread, sources, _guess(past, time_s), False)
    if stage is None:
        return None
    # the errors of the quadratic extrapolation and of the formula are both multiples of the third derivative
    corrector = (1.0 + ratio) ** 2 * h**3 / (6.0 * ratio * spread)
    predictor = h * (h + before) * (h + before + earlier) / 6.0
    weights = extrapolation_weights([s.time_s for s in past[-3:]], time_s)
    extrapolated = sum(w * s.volume for w, s in zip(weights, past[-3:], strict=True))
    mass = (stage.state.volume - extrapolated) * corrector / (corrector + predictor)
    return model.finish((stage,), mass)


def _fall(model: Equations, state: State, h: float) -> Step | None:
    """Returns a step across a fold of the equilibria, or None if the body does not come to rest.

    The step is one of backward Euler, which does not extrapolate across the jump. Nothing tells how accurate
    the change of volume is, so that all of it counts as error of the fluid mass.
    """
    sources = ((1.0, state),)
    stage = model.solve_stage(state.time_s + h, h, sources, state.x, jump=False, fall=True)
    return None if stage is None else model.finish((stage,), stage.state.volume - state.volume)


def _guess(past: list[State], time_s: float) -> Array:
    """Returns the unknowns (dofs,) at a later time, extrapolated from past states."""
    return extrapolate([(state.time_s, state.x) for state in past], time_s)


def integrate(
    model: Equations,
    p_init: float,
    tolerance: float,
    on_step: Callable[[Step], None],
    falls_too: bool = True,
) -> str:
    """Integrates over the whole motion, and calls `on_step` for the start and for each accepted step.

    p_init : initial interstitial pressure [Pa]
    tolerance : limit of the estimated local error of the force in a step, relative to the nominal force
    falls_too : True to follow a skin that folds to where it comes to rest; otherwise such a run fails
    Returns an empty string, or for a run that failed one line with the step, the time and a remedy.
    """
    state = model.initial_state(p_init)
    on_step(Step(state, 0.0, 0.0, corner=True))
    allowed_n, count = tolerance * model.nominal_force(), 0
    for start, end in zip(model.motion.time_s[:-1], model.motion.time_s[1:], strict=True):
        past, h = [state], min(STEPPING.first_s, 0.5 * (end - start))
        longest, shortest = (end - start) / STEPPING.steps_per_phase, STEPPING.shortest * (end - start)
        while state.time_s < end - 1e-9:
            spent, at_s = model.solver.counts, state.time_s - model.starts_s
            if spent["crawls"] > STEPPING.most_crawls:
                return (
                    f"step {count + 1} at t = {at_s:.3f} s: the skin has folded and snapped "
                    f"{spent['falls']} times; try layers of more similar stiffness, or a coarser mesh"
                )
            h = _next_length(max(h, shortest), end - state.time_s, longest)
            step = advance(model, past, h)
            falls = step is None and h <= shortest
            if falls and not falls_too:
                return (
                    f"step {count + 1} at t = {at_s:.3f} s: the skin folds, or the run does not converge; "
                    "try layers of more similar stiffness, or a coarser mesh"
                )
            if falls:
                step = _fall(model, state, h)
                if step is None:
                    return (
                        f"step {count + 1} at t = {at_s:.3f} s did not converge with steps down "
                        f"to {shortest:.2g} s; try a finer mesh, or parameters closer to those of skin"
                    )
            excess = step.error_n / allowed_n if step else np.inf
            if step is None or (excess > 1.0 and h > shortest):
                h *= 0.5 if step is None else max(STEPPING.shrink, 0.9 / np.sqrt(excess))
                past = past if step else [state]
                continue
            state, count = step.state, count + 1
            past = [state] if falls else [*past, state][-EXTRAPOLATION_POINTS:]
            on_step(replace(step, corner=abs(state.time_s - end) < 1e-9))
            h *= min(STEPPING.growth, 0.9 / np.sqrt(max(excess, 1e-6)))
        model.remember_travel(past)
    return ""


def _next_length(h: float, left: float, longest: float) -> float:
    """Returns the length of the next step [s], at most `longest`.

    Near the corner, `left` seconds away, it makes the last steps equal, so that no very short step remains.
    """
    h = min(h, longest)
    return left / np.ceil(left / h - 1e-9) if left < 2.0 * h else h
