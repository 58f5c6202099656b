"""Defines the interface of a formulation of the test: its equations, and the force that it observes.

`ModelSpec.formulation` chooses the formulation. All other code asks for the properties of this interface.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from bayeskin.finite_element.problem import ProblemAt
from bayeskin.finite_element.tissue import Bind
from bayeskin.types import Array, PadMotion, Simulation

OnState = Callable[[float, Array, float], None]  # time_s, x (dofs,), force_n


@dataclass(frozen=True)
class RunRequest:
    """One run that a formulation is asked for.

    problem_at : function that returns the problem at parameters
    model_hash : hash of the model, which the result carries

    The other fields are the arguments of `simulate`.
    """

    motion: PadMotion
    theta: Mapping[str, float]
    problem_at: ProblemAt
    model_hash: str
    on_progress: Callable[[float], None] | None = None
    on_state: OnState | None = None
    gradients: Mapping[str, float] | None = None
    laws: Sequence[Bind] = ()
    falls_too: bool = True


class Formulation(ABC):
    """A formulation of the test. By default it offers nothing beyond the force.

    any_parameters : True if parameters may have any names; otherwise they are those of the full model
    any_device : True for a formulation of any device and tissue; otherwise it knows only the article's
    fixed_discretisation : True for a formulation that is defined only on the article's gmsh mesh, and with
        samples of the recording as time steps
    differentiable : True if runs have derivatives of the force
    takes_laws : True if laws of mechanisms can be bound to it
    has_fields : True if the stresses of its states are those of `fields`
    reducible : True if a reduced model can be projected from it
    error_unknown : the reason why the error of its force cannot be estimated; empty if it can
    """

    any_parameters = False
    any_device = False
    fixed_discretisation = False
    differentiable = False
    takes_laws = False
    has_fields = False
    reducible = False
    error_unknown = ""

    @property
    @abstractmethod
    def steps(self) -> float:
        """Returns the tolerance of the time steps, or their length [s] if it is fixed."""

    @abstractmethod
    def run(self, request: RunRequest) -> Simulation:
        """Returns the force history of a run, with status "failed" and a message if it does not finish."""
