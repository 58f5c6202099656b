"""The fourth stage: finds the most probable point, and checks it with the full model.

The surrogate is trained further until it is accurate at this point.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayeskin import inference, report, storage
from bayeskin.finite_element.gradients import logarithms
from bayeskin.finite_element.simulate import simulate
from bayeskin.forward.joint import on_each_recording
from bayeskin.inference import MapCheck, RefinedMap
from bayeskin.types import Array, BinnedForce, PadMotion, Simulation
from bayeskin.types.joint import figure_name
from bayeskin.workflow.calibration import log_posterior_of, rmse_table
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.refining import Refining


class _FullModel:
    """Runs the full model, with derivatives where the model has them.

    Runs are stored by their parameters, so no run is made twice.
    """

    def __init__(self, run: Run) -> None:
        self.run, self.spec = run, model_spec(run)
        self.motion = storage.load(run.at("recording", "motion.h5"), PadMotion)

    @property
    def differentiable(self) -> bool:
        """Returns whether the runs have derivatives."""
        return self.spec.formulation.differentiable

    def __call__(self, theta: Mapping[str, float]) -> Simulation:
        """Returns the run at parameters theta; of several recordings, each is run on its own protocol."""
        by = logarithms(theta) if self.differentiable else None
        return on_each_recording(self._simulated, self.motion, theta, by)

    def _simulated(
        self, motion: PadMotion, theta: Mapping[str, float], by: Mapping[str, float] | None
    ) -> Simulation:
        """Returns a run on one protocol, from the store where it was made before.

        by : the parameters to differentiate by, with their changes
        """
        with self.run.store("simulations", [self.spec.hash, vars(motion)]) as store:
            if theta in store:
                return store.read(theta, Simulation)
            tell = self.run.reporter
            values = ", ".join(f"{name} = {value:.4g}" for name, value in theta.items())
            tell.log(f"map: full run at {values}")
            simulation = simulate(
                self.spec, motion, theta, lambda share: tell.progress("full run", share), gradients=by
            )
            if simulation.status == "ok":  # the cause of a failed run may be corrected later
                store.add(theta, simulation)
            return simulation


def _find_maximum(run: Run) -> Mapping[str, Any]:
    """Finds the most probable point, writes the refined surrogate, and returns the stage's summary."""
    config = run.config
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    refining, full = Refining(run, binned, "design", "train"), _FullModel(run)
    log_posterior = log_posterior_of(run, refining.surrogate, binned, full.motion, refining.design)
    refined = inference.refine_map(
        log_posterior, full, refining.retrain, config.seed, config.map.starts, config.map.evaluations
    )
    refining.save("map")
    _draw_check(run, binned, refined)
    return {**_search_summary(refined, binned), "polished": _polish(full, refined)}


def _polish(full: _FullModel, refined: RefinedMap) -> dict[str, Any] | None:
    """Returns the maximum of the full model itself; None without derivatives, or where the check failed."""
    if not full.differentiable or not refined.passes:
        return None
    polished = inference.polish_map(refined.log_posterior, full, refined.map.theta)
    return {
        "theta": dict(polished.theta),
        "log_posterior": polished.value,
        "gained": polished.gained,
        "full_runs": len(polished.runs),
        "message": polished.message,
    }


def _search_summary(refined: RefinedMap, binned: BinnedForce) -> dict[str, Any]:
    """Returns the result of the search as plain values for the summary."""
    best, check = refined.map, refined.checks[-1]
    succeeded = check.simulation.status == "ok"
    return {
        "ok": refined.passes,
        "theta": dict(best.theta),
        "log_posterior": best.value,
        "agreement": best.agreement,
        "by_search": best.by_search,
        "message": best.message,
        "checks": [_check_summary(map_check) for map_check in refined.checks],
        "rmse_of_full_model": rmse_table(refined.log_posterior, _full_model_means(check, binned))
        if succeeded
        else None,
    }


def _check_summary(check: MapCheck) -> dict[str, Any]:
    """Returns one check with the full model as plain values for the summary."""
    return {
        "passes": check.passes,
        "message": check.message,
        "theta": dict(check.theta),
        "rms_n": check.rms_n,
        "max_n": check.max_n,
        "rms_z": check.rms_z,
        "mahalanobis": check.mahalanobis,
        "seconds_of_full_run": check.simulation.stats["seconds"],
    }


def _full_model_means(check: MapCheck, binned: BinnedForce) -> Array:
    """Returns the full model's bin means [N] (m,)."""
    return check.simulation.bin_means(binned.edges_s)


def _draw_check(run: Run, binned: BinnedForce, refined: RefinedMap) -> None:
    """Draws the figure that compares surrogate and full model at the most probable point."""
    check, surrogate = refined.checks[-1], refined.log_posterior.surrogate
    if check.simulation.status != "ok":
        return
    prediction = surrogate.predict(np.array([list(check.theta.values())]))
    forces = _full_model_means(check, binned), prediction.mean[0], prediction.sd()[0]
    for number, (bins, part) in enumerate(zip(binned.slices, binned.parts, strict=True)):
        figure = report.figure_map_check(part, *(force[bins] for force in forces))
        report.save_figure(figure, run.at("map", figure_name("map_check", number)), caption(run))


STAGE = Stage(
    "map",
    "finds the most probable point and checks it with the full model",
    ("recording", "design", "train"),
    ("seed", "map", "fit", "noise", "parameters", "model", "surrogate", "design"),
    _find_maximum,
)
