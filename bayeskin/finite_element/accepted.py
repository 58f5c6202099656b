"""Collects the accepted steps of a run, and makes the run's result from them."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from bayeskin.finite_element.formulation import RunRequest
from bayeskin.finite_element.gradients import ForceGradients
from bayeskin.finite_element.newton import NewtonSolver
from bayeskin.finite_element.problem import Problem
from bayeskin.types import Array, Simulation, frozen_array


class AcceptedSteps:
    """The accepted steps so far, starting with the state of rest. It reports each step to the callbacks."""

    def __init__(self, request: RunRequest) -> None:
        self.request, self._started = request, time.perf_counter()
        self._times_s, self._forces_n, self._errors_n, self._corners = [0.0], [0.0], [0.0], [True]

    def add(self, time_s: float, x: Array, force_n: float, corner: bool, error_n: float = 0.0) -> None:
        """Stores a step after the start, and calls the callbacks."""
        if time_s > 0.0:
            self._times_s.append(time_s)
            self._forces_n.append(force_n)
            self._corners.append(corner)
            self._errors_n.append(error_n)
        if self.request.on_state is not None:
            self.request.on_state(time_s, x, force_n)
        if self.request.on_progress is not None:
            self.request.on_progress(time_s / float(self.request.motion.time_s[-1]))

    def simulation(
        self, problem: Problem, solver: NewtonSolver, message: str, slopes: ForceGradients | None = None
    ) -> Simulation:
        """Frees the solver's memory and returns the result of the run.

        message : empty for a run that finished
        """
        seconds = time.perf_counter() - self._started
        solver.release()
        request, force = self.request, np.array(self._forces_n)
        stats = {
            "seconds": seconds,
            "steps": float(len(force) - 1),
            "dofs": float(problem.space.dofs),
            "time_error_n": float(np.linalg.norm(self._errors_n)),  # `accuracy` describes it
            "peak_force_n": float(np.abs(force).max()),
            "last_residual": float(solver.last_residual),
            **{name: float(count) for name, count in solver.counts.items()},
            **({"seconds_of_gradients": slopes.seconds} if slopes else {}),
        }
        return Simulation(
            theta={name: float(value) for name, value in request.theta.items()},
            time_s=np.array(self._times_s),
            displacement_m=request.motion.at(self._times_s),
            force_n=force,
            corner=frozen_array(self._corners, bool),
            status="failed" if message else "ok",
            message=message,
            stats=stats,
            model_hash=request.model_hash,
            gradient_names=slopes.names if slopes else (),
            gradient_n=_beyond_start(slopes.force_n[-len(force) :]) if slopes else np.zeros((0, 0)),
        )


def _beyond_start(rows: Sequence[Array]) -> Array:
    """Returns the rows relative to the first row, (n, r)."""
    return np.array(rows) - rows[0]
