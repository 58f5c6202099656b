"""The sixth stage: Sobol' indices of the force over the prior and near the maximum, and Shapley effects.

The Shapley effects are shares of the force's variance over the posterior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayeskin import inference, report, storage
from bayeskin.config import parameter_space
from bayeskin.number_format import quantity
from bayeskin.sensitivity.result import SobolResult, sentence, uninformed
from bayeskin.sensitivity.shapley import shapley
from bayeskin.sensitivity.sobol import sobol
from bayeskin.surrogates import correct, load_surrogate, train
from bayeskin.types import Design, PadMotion, Parameter, ParameterSpace
from bayeskin.types.joint import bins_of, edges_of, figure_name
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.training import fine_design

MOST_DRAWS, CHUNK = 2000, 256
NEARBY = 0.1  # the article varies each parameter by 10 % of its calibrated value, up and down


def _compute_indices(run: Run) -> Mapping[str, Any]:
    """Computes the indices, writes them with their figures, and returns the stage's summary."""
    design, fine = storage.load(run.at("map", "design.h5"), Design), fine_design(run, "map")
    space, samples = parameter_space(run.config, run.config_path), run.config.sobol.samples
    near = nearby(space, run.summary("map")["theta"])
    rng = np.random.default_rng([run.config.seed, 2])
    # For indices over the whole prior, all its parts count equally, so these two are trained without weights.
    gp, chaos = (train(design, kind, run.config.seed)[0] for kind in ("gp", "chaos"))
    if fine is not None:
        gp, chaos = (correct(surrogate, fine)[0] for surrogate in (gp, chaos))
    local = load_surrogate(run.at("map", "surrogate.h5"))
    results = {
        "prior_gp": sobol(gp, rng, samples, space),
        "prior_chaos": sobol(chaos, rng, samples, space, "projection"),
        "near_map": sobol(local, rng, samples, near),
    }
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    for name, result in results.items():
        storage.save(run.at("sobol", f"{name}.h5"), result)
        for number in range(len(motion.parts)):
            file = run.at("sobol", figure_name(f"sobol_{name}", number))
            report.save_figure(_indices_figure(result, motion, number), file, caption(run))
    tables = {name: _table(result) for name, result in results.items()}
    return {**tables, "posterior": _over_posterior(run, rng)}


def _over_posterior(run: Run, rng: np.random.Generator) -> dict[str, Any]:
    """Returns Shapley effects over posterior draws, whose parameters are correlated."""
    space, draws = inference.draws_of(inference.load_inference_data(run.at("sample", "posterior.nc")))
    refined = run.at("sample", "surrogate.h5")
    surrogate = load_surrogate(refined if refined.is_file() else run.at("map", "surrogate.h5"))
    material = ParameterSpace(space.parameters[: surrogate.space.dim])
    chosen = inference.evenly(draws, MOST_DRAWS)[:, : material.dim]
    force = np.concatenate(
        [surrogate.predict_mean(chosen[i : i + CHUNK]) for i in range(0, len(chosen), CHUNK)]
    )
    result = shapley(
        material, chosen, force, surrogate.edges_s, rng, "the posterior, its correlations included"
    )
    order = np.argsort(-np.nan_to_num(result.effects))
    shares = [f"{result.names[j]} {100 * result.effects[j]:.0f} %" for j in order[:3]]
    return {
        "sentence": (
            f"The posterior's uncertainty of the force, {quantity(np.sqrt(result.variance_n2), 'N', 2)} sd "
            f"over time, comes from {', '.join(shares)}."
        ),
        "method": "Shapley effects by polynomial regression",
        "distribution": result.distribution,
        "samples": result.draws,
        "shares": {
            name: {"share": result.effects[j], "share_90": result.interval[:, j]}
            for j, name in enumerate(result.names)
        },
    }


def nearby(space: ParameterSpace, theta: Mapping[str, float]) -> ParameterSpace:
    """Returns uniform priors within 10 % of the values `theta` (SI by name), limited to the prior's box."""

    def around(p: Parameter) -> Parameter:
        """Returns a parameter with a uniform prior near its value."""
        reach = NEARBY * abs(theta[p.name]) or 1e-6 * (p.upper - p.lower)
        lower, upper = max(theta[p.name] - reach, p.lower), min(theta[p.name] + reach, p.upper)
        return replace(p, lower=lower, upper=upper, prior="uniform")

    return ParameterSpace(tuple(around(p) for p in space.parameters))


def _table(result: SobolResult) -> dict[str, Any]:
    """Returns the indices of one distribution as plain values for the summary."""
    return {
        "sentence": sentence(result),
        "uninformed": list(uninformed(result)),
        "method": result.method,
        "distribution": result.distribution,
        "samples": result.samples,
        "unexplained": result.unexplained,
        "aggregated": {
            name: {
                "first": result.first_aggregated[i],
                "first_90": result.first_aggregated_interval[:, i],
                "total": result.total_aggregated[i],
                "total_90": result.total_aggregated_interval[:, i],
            }
            for i, name in enumerate(result.names)
        },
        "pairs": {
            f"{first}, {second}": {
                "second": result.second_aggregated[i],
                "second_90": result.second_aggregated_interval[:, i],
            }
            for i, (first, second) in enumerate(result.pairs)
        },
    }


def _indices_figure(result: SobolResult, motion: PadMotion, number: int) -> Any:
    """Returns the figure of the indices over time in one of the recordings."""
    edges_s = edges_of(motion.spans, result.edges_s)[number]
    bins = bins_of(motion.spans, result.edges_s)[number]
    time_s = 0.5 * (edges_s[1:] + edges_s[:-1])

    def with_limits(interval: Any, estimate: Any) -> Any:
        """Returns lower limit, estimate and upper limit, (3, m, d), or (3, d) for aggregated indices."""
        return np.moveaxis(np.stack([interval[0], estimate, interval[1]]), 1, -1)

    return report.figure_sobol(
        result.names, time_s, motion.parts[number].at(time_s),
        with_limits(result.first_interval, result.first)[:, bins],
        with_limits(result.total_interval, result.total)[:, bins],
        with_limits(result.first_aggregated_interval, result.first_aggregated),
        with_limits(result.total_aggregated_interval, result.total_aggregated),
        result.distribution,
    )  # fmt: skip


STAGE = Stage(
    "sobol",
    "Sobol' indices of the force over time",
    ("recording", "map", "sample"),
    ("seed", "sobol", "parameters", "design"),
    _compute_indices,
)
