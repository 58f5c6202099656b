"""Runs the full model: it computes a force history from a specification, a motion and parameters."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.external.model import identity
from bayeskin.finite_element.accepted import AcceptedSteps
from bayeskin.finite_element.article import Article
from bayeskin.finite_element.formulation import Formulation, OnState, RunRequest
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.linear import SOLVER_NAME
from bayeskin.finite_element.mesh import SkinMesh, brick_mesh
from bayeskin.finite_element.own import Own
from bayeskin.finite_element.problem import (
    PARAMETERS,
    Constants,
    Material,
    Problem,
    build_problem,
    moved_problem,
)
from bayeskin.finite_element.reaction import Reaction
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.types import Observation, PadMotion, Simulation

PHYSICS_VERSION = 2  # increase it when a change of the code changes a force by more than its tolerance


@dataclass(frozen=True)
class ModelSpec:
    """Specification of a model: device and tissue, the observed force, the mesh and the tolerance.

    observation : "reaction" (the force that the load cell measures), "article" (the force of the article's
        released code), or "own" (the force of a user's own model)
    mesh : "bricks" (bayeskin's graded bricks) or the path of a gmsh file with the article's names
    refinement : refinement of the bricks toward the edges of the pads; 1 gives 448 bricks, 0 gives 80
    tolerance : limit of the estimated local error of the reaction in a step, relative to the nominal force;
        the observation "article" has fixed steps
    forward : location of the user's own model, with observation "own", as `bayeskin.external.model`
        describes; mesh, refinement and tolerance then have no effect
    geometry : device and tissue; the observations "article" and "own" allow only the article's
    """

    observation: Observation = "reaction"
    mesh: str = "bricks"
    refinement: int = 1
    tolerance: float = 1e-3
    forward: str | None = None
    geometry: Geometry = Geometry()

    def __post_init__(self) -> None:
        if (self.observation == "own") != (self.forward is not None):
            raise InputError(
                "model.forward",
                f"it is {self.forward!r} with observation {self.observation!r}",
                "the observation 'own' needs a forward model, and no other has any",
            )
        if self.formulation.fixed_discretisation and self.mesh == "bricks":
            raise InputError(
                "model.mesh",
                "it is 'bricks'",
                f"observation {self.observation!r} needs the article's gmsh mesh",
            )
        if not self.formulation.any_device and self.geometry != Geometry():
            raise InputError(
                "geometry",
                f"it is not the article's, which observation {self.observation!r} needs",
                "use observation 'reaction', or the article's device and tissue",
            )

    @property
    def formulation(self) -> Formulation:
        """Returns the formulation that the observation names."""
        if self.forward is not None:
            return Own(self.forward)
        return Article() if self.observation == "article" else Reaction(self.tolerance)

    @property
    def mesh_hash(self) -> str:
        """Returns the hash of the mesh, which `accuracy.mesh_error` takes."""
        return mesh_of(self.mesh, self.refinement, self.geometry).hash

    @property
    def hash(self) -> str:
        """Returns the sha256 of all that the force depends on besides the motion and the parameters."""
        if self.forward is not None:
            return identity(self.forward)
        steps, constants = self.formulation.steps, asdict(Constants())
        known = [PHYSICS_VERSION, self.observation, self.mesh_hash, steps, constants]
        if self.geometry != Geometry():  # older hashes of the article's device stay valid
            known.append(self.geometry.hash)
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=2)
def mesh_of(mesh: str, refinement: int, geometry: Geometry) -> SkinMesh:
    """Returns the mesh of a specification."""
    return brick_mesh(refinement, geometry) if mesh == "bricks" else read_gmsh(Path(mesh), geometry)


@lru_cache(maxsize=2)
def problem_of(mesh: str, refinement: int, geometry: Geometry = Geometry()) -> Problem:
    """Returns the boundary-value problem of a mesh, which is built once in each process."""
    return build_problem(mesh_of(mesh, refinement, geometry))


def problem_at(spec: ModelSpec, theta: Mapping[str, float]) -> Problem:
    """Returns the problem of a specification, with its nodes moved to the lengths of the tissue in theta.

    Raises InputError for impossible lengths, and for a gmsh mesh, whose nodes cannot be moved.
    """
    nominal, geometry = problem_of(spec.mesh, spec.refinement, spec.geometry), moved(spec.geometry, theta)
    if geometry == spec.geometry:
        return nominal
    if spec.mesh != "bricks":
        raise InputError(
            "model.mesh",
            f"the nodes of {spec.mesh!r} cannot be moved to changed lengths of the tissue",
            "use 'bricks'",
        )
    return moved_problem(nominal, brick_mesh(spec.refinement, geometry, spec.geometry))


def simulate(
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
    on_progress: Callable[[float], None] | None = None,
    on_state: OnState | None = None,
    gradients: Mapping[str, float] | None = None,
    laws: Sequence[Bind] = (),
    falls_too: bool = True,
) -> Simulation:
    """Runs the full model over the whole motion, and returns the force history.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa], the parameters of `laws`, and optionally lengths of
        the tissue [m], which replace those of the specification
    on_progress : function that is called with the completed fraction of the motion
    on_state : function that is called with time [s], all unknowns (dofs,) and force [N] of each accepted step
    gradients : parameters for which derivatives of the force are also computed, each with the change to which
        the derivative refers; only for the observation "reaction". `gradients.logarithms` gives the changes
        for derivatives with respect to the logarithms of the base model's four parameters and of lengths
    laws : physics beyond the base model; only for the observation "reaction". If the pads were opened before
        the test, the force is relative to the force at the start of the test, where everything is at rest
    falls_too : True to follow a skin that folds across the fold, which takes minutes; otherwise such a run
        fails

    A run that does not converge returns a Simulation with status "failed", the steps so far, and a message
    with the step, the time and a remedy. Raises InputError for a parameter that is missing, unknown, not
    finite, or not positive where it must be. For the observation "own", `simulate_own` describes the errors.
    """
    formulation = spec.formulation
    if not formulation.any_parameters:
        _check_parameters(theta, bool(laws))
    if gradients and not formulation.differentiable:
        raise InputError(
            "gradients", f"observation {spec.observation!r} has no derivatives", "use observation 'reaction'"
        )
    if laws and not formulation.takes_laws:
        raise InputError(
            "tissue mechanisms",
            f"observation {spec.observation!r} takes no mechanisms",
            "use observation 'reaction'",
        )
    return formulation.run(
        RunRequest(
            motion, theta, partial(problem_at, spec), spec.hash, on_progress, on_state, gradients, laws,
            falls_too,
        )
    )  # fmt: skip


def simulate_on(
    problem: Problem,
    solid: Material,
    tolerance: float,
    motion: PadMotion,
    theta: Mapping[str, float],
    laws: Sequence[Bind] = (),
) -> Simulation:
    """Runs the model on any mesh with any constants of its cells, and returns the history of the reaction.

    solid : constants of each cell, which replace those computed from theta

    The other arguments and the errors are those of `simulate`. The result's model_hash is that of the mesh.
    """
    _check_parameters(theta, bool(laws))
    request = RunRequest(motion, theta, lambda _: problem, problem.mesh.hash, laws=laws)
    return Reaction(tolerance).run_on(problem, solid, AcceptedSteps(request))


def _check_parameters(theta: Mapping[str, float], more: bool) -> None:
    """Raises InputError for a parameter that is missing, unknown, not finite or wrongly not positive.

    more : True if there are laws, whose parameters only the laws know, so that other names are allowed
    """
    for name in PARAMETERS:
        if name not in theta:
            raise InputError("parameters", f"{name} is missing", f"all of {', '.join(PARAMETERS)} are needed")
        value = theta[name]
        if not np.isfinite(value) or (name != "p_init" and value <= 0):
            raise InputError(f"parameters: {name}", f"it is {value}", "it must be a finite positive number")
    for name, value in theta.items():
        if not np.isfinite(value):
            raise InputError(f"parameters: {name}", f"it is {value}", "it must be a finite number")
        if name not in (*PARAMETERS, *LENGTHS) and not more:
            raise InputError("parameters", f"{name} is not known", f"use only {', '.join(PARAMETERS)}")


__all__ = ["SOLVER_NAME", "ModelSpec", "OnState", "problem_at", "problem_of", "simulate", "simulate_on"]
