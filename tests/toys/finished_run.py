"""The summaries and figures of the stages of a finished run."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bayeskin.report.page import RunFacts, StageFacts
from bayeskin.report.page.figures import FIGURES
from bayeskin.report.save import figure_bytes
from bayeskin.sensitivity.result import SobolResult

PARAMETERS = {"E_c": "Young's modulus of the cutis", "p_init": "initial interstitial pressure"}
HISTORY = {
    "time_s": [0.25, 0.75, 1.25, 1.75],
    "recorded_n": [0.0, 0.1, None, 0.3],
    "fitted": [True, True, False, False],
    "median_n": [0.0, 0.11, 0.2, 0.29],
    "low_50_n": [-0.01, 0.1, 0.19, 0.28],
    "high_50_n": [0.01, 0.12, 0.21, 0.3],
    "low_90_n": [-0.02, 0.09, 0.18, 0.27],
    "high_90_n": [0.02, 0.13, 0.22, 0.31],
}
FORCES = [
    {
        "name": "",
        "time_s": [0.25, 0.75, 1.25, 1.75],
        "recorded_n": [0.0, 0.1, None, 0.3],
        "before_n": [0.01, 0.18, 0.25, 0.3],
        "after_n": [0.0, 0.11, 0.2, 0.29],
        "low_90_n": [-0.02, 0.09, 0.18, 0.27],
        "high_90_n": [0.02, 0.13, 0.22, 0.31],
        "windows": [{"start_s": 0.5, "end_s": 1.5, "mean_n": -0.08}],
    }
]
_NONE = np.full((2, 2, 4), np.nan)
INDICES = SobolResult(
    names=("E_c", "p_init"), edges_s=np.arange(0.0, 2.5, 0.5),
    first=np.array([[np.nan, 0.8, 0.7, 0.6], [np.nan, 0.1, 0.2, -0.001]]),
    total=np.array([[np.nan, 0.85, 0.75, 0.65], [np.nan, 0.15, 0.25, 0.05]]),
    first_interval=_NONE, total_interval=_NONE, first_aggregated=np.ones(2), total_aggregated=np.ones(2),
    first_aggregated_interval=np.ones((2, 2)), total_aggregated_interval=np.ones((2, 2)),
    second=np.ones((1, 4)), second_aggregated=np.ones(1), second_aggregated_interval=np.ones((2, 1)),
    variance_n2=np.ones(4), unexplained=0.0, samples=2048, method="pick-freeze", distribution="independent",
)  # fmt: skip
_RMSE = {
    "whole_n": 0.00365, "by_kind_n": {"rest": 0.0035, "load": 0.0039}, "fitted_n": 0.0036,
    "not_fitted_n": None, "article_holds_n": None,
}  # fmt: skip
_PHASE = {
    "kind": "load", "cycle": 1, "start_s": 0.0, "end_s": 2.0, "start_m": 0.0, "end_m": 0.0094,
    "noise_sd_n": 0.0045, "noise_correlation_time_s": 0.15, "spikes": 3, "steps": [],
}  # fmt: skip
_INDEX = {"first": 0.8, "first_90": [0.7, 0.9], "total": 0.85, "total_90": [0.8, -0.0001]}


def _parameter(prior: str, low: float, median: float, high: float, unit: str = "Pa") -> dict[str, Any]:
    return {
        "meaning": "", "unit": unit, "mean": median, "sd": 1.0, "median": median, "low_90": low,
        "high_90": high, "ess": 3000.0, "rhat": 1.0007,
        "prior": {"kind": prior, "lower": 0.5 * low, "upper": 2.0 * high, "source": "an earlier study"},
    }  # fmt: skip


ON_SKIN = {
    "points": 25, "images": 31, "sd_m": 1.98e-5, "significant": 2, "rms_m": 1.2e-4,
    "widens": {"E_c": 4.5, "p_init": 1.0},
    "largest": [{"point": "c3", "place_m": [0.006, -0.012], "residual_m": [-0.0003, 0.0001]}],
}  # fmt: skip


def summaries() -> dict[str, dict[str, Any]]:
    """Returns the summaries by stage: a trusted posterior, and a diagnosis that has named a mechanism."""
    return {
        "recording": {
            "name": "forearm", "sha256": "a" * 64, "notes": ["column 'F' read as force in N"],
            "samples": 6501, "duration_s": 130.0, "sampling_hz": 50.0,
            "displacement_m": {"min": 0.0, "max": 0.0094},
            "force_n": {"min": -0.0253, "max": 0.4095}, "cycles": 2,
            "phases": [_PHASE, {**_PHASE, "kind": "hold", "spikes": 20}],
        },
        "design": {
            "runs": 120, "failed": 1, "failures": {"Newton stalled": 1}, "seconds_of_runs": 1160.0,
            "median_seconds_a_run": 8.9, "model_hash": "b" * 64,
            "waves": [{"wave": 0, "training": 96, "held_out": 24, "kept_fraction": 1.0, "rule": "whole box"}],
        },
        "train": {
            "kind": "gp", "training_rows": 96, "error_source": "held-out", "relative_error": 0.042,
            "median_point_relative_error": 0.0016, "worst_point_relative_error": 0.0046, "coverage_90": 0.963,
        },
        "map": {
            "ok": True, "theta": {"E_c": 62e3, "p_init": 1600.0}, "message": "2 of 4 starts reached it",
            "rmse_of_full_model": _RMSE,
            "polished": {"gained": 0.42, "message": "converged after 6 full runs"},
            "checks": [
                {"passes": True, "message": "surrogate off by 0.43 mN", "rms_n": 4.3e-4, "max_n": 8.4e-4,
                 "rms_z": 0.66, "seconds_of_full_run": 5.98},
            ],
        },
        "sample": {
            "ok": True, "verdict": "trusted", "reasons": ["3554 effective samples of E_c; 2000 needed"],
            "remarks": ["The residual is hardly noise."],
            "steps": 16000, "draws": 3776,
            "parameters": {
                "E_c": _parameter("log-uniform", 13.9e3, 50.8e3, 87e3),
                "p_init": _parameter("uniform", -522.0, 842.0, 2021.0),
                "sd_rest": _parameter("log-uniform", 0.0019, 0.0028, 0.0045, "N"),
            },
            "identifiability": ["E_c: the data informs it: median 50.8 kPa"],
            "ridges": ["E_c and E_s form a ridge (correlation -0.87): one makes up for the other"],
            "residuals": {
                "passes": True,
                "sentence": "The residual looks like the assumed noise: in its distribution and all else.",
                "p_law": 0.43, "p_correlation": 0.3, "autocorrelation": [0.1, -0.05],
                "by_kind": {
                    "rest": {"bins": 40, "sd": 0.97, "p_sd": 0.8, "correlation": 0.06, "p_correlation": 0.7},
                    "load": {"bins": 4, "sd": None, "p_sd": None, "correlation": None, "p_correlation": None},
                },
            },
            "learned": {
                name: {
                    "contraction": 0.6, "gain_nats": 0.9, "informed": informed, "leans_on": leans_on,
                    "ranges": [], "outcome": outcome, "sentence": f"This test taught of {name}.",
                }
                for name, informed, leans_on, outcome in (
                    ("E_c", "informed", ["lower"], "the data informs it; leans on the prior's lower bound"),
                    ("p_init", "not informed", [], "the data does not inform it (posterior = prior)"),
                    ("sd_rest", "weakly informed", [], "the data informs it weakly"),
                )
            },
            "lengths": {},
            "profiles": {
                "E_c": {"low_90": 33e3, "high_90": 95e3, "flat": False},
                "p_init": {"low_90": -670.0, "high_90": 2144.0, "flat": True},
            },
            "full_model": [
                {"draws": 24, "failed": 0, "effective": 20.1, "largest_weight": 0.07, "khat": None,
                 "sd_of_log_ratio": 0.4, "trusted": True, "message": "full model at 24 posterior draws"},
            ],
            "corrected": {
                name: {"median": median, "low_90": 0.5 * median, "high_90": 2.0 * median, "shift_sd": 0.11,
                       "shift_error_sd": 0.08}
                for name, median in (("E_c", 51e3), ("p_init", 840.0), ("sd_rest", 0.0029))
            },
            "on_skin": ON_SKIN, "rmse": _RMSE, "coverage_90": 0.9462, "coverage_90_fitted": 0.9512,
            "rms_sd_n": {"model": 0.0013, "surrogate": 0.0009, "noise": 0.0042},
        },
        "sobol": {
            name: {
                "sentence": "The force does not inform p_init.", "method": "pick-freeze", "samples": 2048,
                "distribution": "independent", "aggregated": {"E_c": _INDEX, "p_init": _INDEX},
                "pairs": {"E_c, p_init": {"second": 0.01, "second_90": [None, 0.02]}},
            }
            for name in ("prior_gp", "prior_chaos", "near_map")
        } | {
            "posterior": {
                "sentence": "Shared by E_c 90 %.", "method": "Shapley effects", "samples": 2000,
                "distribution": "the posterior", "shares": {"E_c": {"share": 0.9, "share_90": [0.8, 1.0]}},
            }
        },
        "diagnose": {
            "verdict": "named",
            "recordings": [],
            "located": [{"t0": 0.0, "t1": 9.5, "phase": "rest", "cycle": 0, "mean_residual": -0.0586,
                         "significance": 0.001}],
            "remaining": [], "smooth_probability": 0.07, "nothing_probability": 0.0,
            "best_set": ["device-friction"], "held_out_set": None,
            "sets": [{"mechanisms": ["device-friction"], "probability": 0.98}],
            "full_model": {"rmse": 0.0213, "fit_off_by": 0.0004},
            "mechanisms": [
                {"name": "device-friction", "probability": 0.98, "group": ["device-friction", "viscous-drag"],
                 "group_probability": 1.0, "contribution_n": 0.03, "statement": "The slide rubs: 60 mN.",
                 "parameters": {"Fc": {"mean": 0.0601, "sd": 0.0007, "unit": "N"}}},
            ],
            "candidates": [{"name": "device-friction", "delta_score": 8596.9, "standard_error": 3918.4},
                           {"name": "backlash", "delta_score": -1.5, "standard_error": 0.2}],
            "fit": {
                when: {"rmse": rmse, "rmse_by_phase": {"rest": rmse}, "rmse_held_out": None,
                       "coverage90": 0.9, "rmse_of_mean": rmse, "on_skin": ON_SKIN,
                       "emulator": {"settled": True}, "sampled": {"settled": True},
                       "theta": {"E_c": {"mean": 6e4, "sd": 1e4, "interval90": [4e4, 8e4]}}}
                for when, rmse in (("before", 0.08), ("after", 0.0247))
            },
            "unexplained": {
                "size_n": 0.0123, "share": {"displacement": 0.75, "phase": 0.25}, "gain_nats": 41.0,
                "noticeable": True, "features": ["it grows while loading"],
                "form": {
                    "terms": [{"name": "u^3 while loading", "coefficient": -0.011, "standard_error": 0.002,
                               "unit": "N", "alike": ["u^2 while loading"]}],
                    "r2_left_out": 0.7, "sentence": "0.7 of it follows u^3 while loading",
                },
            },
        },
        "experiment": {
            "sets": [["device-friction"], ["viscous-drag"]],
            "experiments": [
                {"protocol": "quarter speed", "sentence": "The same at a quarter of the speed.",
                 "seconds": 187.0, "gain_bits": 0.95, "standard_error": 0.01, "named": 0.97,
                 "possible_bits": 1.0, "failed": 0},
                {"protocol": "no holds", "sentence": "Cycles without holds.", "seconds": 85.0,
                 "gain_bits": None, "standard_error": None, "named": None, "possible_bits": 1.0,
                 "failed": 12},
            ],
        },
    }  # fmt: skip


def drawing(name: str) -> str:
    """A small figure as the stages save them, with clipped parts and markers that it refers to by id."""
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1, 2], [0, 2, 1], "o-", label=name)
    return figure_bytes(figure, "svg", f"bayeskin 0, {name}").decode()


@cache
def _drawn_before(name: str) -> str:
    return drawing(name)


def facts(**changed: Any) -> RunFacts:
    """A run whose stages are all done."""
    said = summaries()
    stages = {
        name: StageFacts(
            name,
            "done",
            1.5,
            summary,
            {figure: _drawn_before(figure) for of, figure in FIGURES if of == name},
        )
        for name, summary in said.items()
    }
    given: dict[str, Any] = {
        "name": "forearm", "config_path": "runs/forearm.toml", "config_text": 'name = "forearm"\n',
        "config_sha256": "c" * 64, "version": "0.1.0", "seed": 7, "observation": "reaction", "mesh": "bricks",
        "parameters": PARAMETERS, "stages": stages,
        "history": HISTORY, "indices": {"prior_gp": INDICES}, "forces": FORCES,
    }  # fmt: skip
    return RunFacts(**{**given, **changed})
