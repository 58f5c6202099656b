"""Fourth stage: the most probable point, checked by the full model until the surrogate is right there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayeskin import inference, report, storage
from bayeskin.finite_element.gradients import logarithms
from bayeskin.finite_element.simulate import simulate
from bayeskin.hashing import sha256_of
from bayeskin.inference import MapCheck, RefinedMap
from bayeskin.types import Array, BinnedForce, PadMotion, Simulation
from bayeskin.workflow.calibration import log_posterior_of, rmse_table
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.refining import Refining


class _FullModel:
    """Full runs, with derivatives where the model has them, kept by their parameters, so that none is made
    twice."""

    def __init__(self, run: Run) -> None:
        self.run, self.spec = run, model_spec(run)
        self.motion = storage.load(run.at("recording", "motion.h5"), PadMotion)

    @property
    def differentiable(self) -> bool:
        """Whether its runs carry derivatives."""
        return self.spec.observation == "reaction"

    def __call__(self, theta: Mapping[str, float]) -> Simulation:
        kept = self.run.at("map", f"full-run-{sha256_of([self.spec.hash, dict(theta)])[:16]}.h5")
        if kept.is_file():
            return storage.load(kept, Simulation)
        said = ", ".join(f"{name} = {value:.4g}" for name, value in theta.items())
        self.run.reporter.log(f"map: full run at {said}")
        tell = self.run.reporter.progress
        simulation = simulate(
            self.spec, self.motion, theta, lambda share: tell("full run", share),
            gradients=logarithms(theta) if self.differentiable else None,
        )  # fmt: skip
        if simulation.status == "ok":  # what failed may be mended meanwhile
            storage.save(kept, simulation)
        return simulation


def _find(run: Run) -> Mapping[str, Any]:
    config = run.config
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    refining, full = Refining(run, binned, "design", "train"), _FullModel(run)
    refined = inference.refine_map(
        log_posterior_of(run, refining.surrogate, binned, full.motion), full, refining.retrain, config.seed,
        config.map.starts, config.map.evaluations,
    )  # fmt: skip
    refining.save("map")
    _draw_check(run, binned, refined)
    return {**_found(refined, binned), "polished": _polish(full, refined)}


def _polish(full: _FullModel, refined: RefinedMap) -> dict[str, Any] | None:
    """The maximum of the full model itself, where it has derivatives."""
    if not full.differentiable or not refined.passes:
        return None
    found = inference.polish_map(refined.log_posterior, full, refined.map.theta)
    return {
        "theta": dict(found.theta),
        "log_posterior": found.value,
        "gained": found.gained,
        "full_runs": len(found.runs),
        "message": found.message,
    }


def _found(refined: RefinedMap, binned: BinnedForce) -> dict[str, Any]:
    best, check = refined.map, refined.checks[-1]
    full = check.simulation.status == "ok"
    return {
        "ok": refined.passes,
        "theta": dict(best.theta),
        "log_posterior": best.value,
        "agreement": best.agreement,
        "by_search": best.by_search,
        "message": best.message,
        "checks": [_checked(one) for one in refined.checks],
        "rmse_of_full_model": rmse_table(refined.log_posterior, _full_n(check, binned)) if full else None,
    }


def _checked(check: MapCheck) -> dict[str, Any]:
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


def _full_n(check: MapCheck, binned: BinnedForce) -> Array:
    return check.simulation.bin_means(binned.edges_s)


def _draw_check(run: Run, binned: BinnedForce, refined: RefinedMap) -> None:
    check, surrogate = refined.checks[-1], refined.log_posterior.surrogate
    if check.simulation.status != "ok":
        return
    prediction = surrogate.predict(np.array([list(check.theta.values())]))
    figure = report.figure_map_check(binned, _full_n(check, binned), prediction.mean[0], prediction.sd()[0])
    report.save_figure(figure, run.at("map", "map_check"), caption(run))


STAGE = Stage(
    "map",
    "finds the most probable point and checks it by the full model",
    ("recording", "design", "train"),
    ("seed", "map", "fit", "noise", "parameters", "model", "surrogate", "design"),
    _find,
)
