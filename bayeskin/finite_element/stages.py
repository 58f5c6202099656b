"""The values that time integration passes on: the state at one time, the solved stages, and a whole step."""

from __future__ import annotations

from dataclasses import dataclass

from bayeskin.finite_element.series import Memories
from bayeskin.types import Array


@dataclass(frozen=True)
class State:
    """The state at one time, with everything that the next step needs.

    x (dofs,) : unknowns
    volume, pressure (e, q) : J and p at the quadrature points
    memory : memory (e q, m) of each law
    lost : memory (k,) of each element in series with the skin
    """

    time_s: float
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...] = ()
    lost: Memories = ()


@dataclass(frozen=True)
class Stage:
    """One solved implicit equation J - J* ... = h* div(...).

    state : state at the end of the stage
    length_s : h*
    elapsed_s : time since the last of `sources`
    history : state with J* and p*, which are weighted sums over `sources`
    sources : pairs of a weight and an earlier state
    residual (dofs,) : residual at the end; within the solver's tolerance it is zero except for the reactions
    """

    state: State
    length_s: float
    elapsed_s: float
    history: State
    sources: tuple[tuple[float, State], ...]
    residual: Array


@dataclass(frozen=True)
class Step:
    """One accepted step: its end state, the force there [N], the estimated local error [N], and its stages.

    corner : True if the step ends at a corner of the protocol
    """

    state: State
    force_n: float
    error_n: float
    corner: bool
    stages: tuple[Stage, ...] = ()
