"""Checks that full model, reduced model, surrogate and posterior give stored numbers on this machine.

Together the checks call nearly all compiled functions. The first checks after an installation therefore
compile them, and numba keeps them on disk. The checks run side by side, which halves this time on two cores.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bayeskin.errors import InputError
from bayeskin.workflow.remedies import compile_anew, reinstall, restore

if TYPE_CHECKING:
    from bayeskin.types import PadMotion
    from bayeskin.workflow.engine import Reporter

# The stored numbers are at THETA. The full model on the default bricks and the reduced model of the article's
# device are pulled 2 mm in 2 s. The surrogate and the recording of the posterior are the demo's.
THETA = {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 0.0}
FULL_MODEL_N, FULL_MODEL_TOLERANCE = 0.089143, 1e-3  # solvers differ by Newton's residual
REDUCED_MODEL_N, REDUCED_MODEL_TOLERANCE = 0.089127, 1e-4  # of one solve that ends early
SURROGATE_N, SURROGATE_TOLERANCE = 0.363626, 1e-5  # the largest mean force of its prediction
POSTERIOR_NATS, POSTERIOR_TOLERANCE = 313.531255, 1e-5  # its log-likelihood with the noise below
NOISE_SD_N, NOISE_TAU_S, NOISE_NU = 1e-2, 1.0, 8.0
ALIVE = "a process that is not killed"
MEMORY = "free memory (2 GB are enough), and run bayeskin doctor again"
COMPLETE = "a complete installation"


@dataclass(frozen=True)
class Finding:
    """The result of one check: whether the part works, its state, what it needs, and what mends it."""

    name: str
    ok: bool
    state: str
    needed: str = ""
    remedy: str = ""


def finding_of(name: str, check: Callable[[], Finding]) -> Finding:
    """Returns the finding of a check; a check that raises any error is a finding too."""
    try:
        return check()
    except InputError as error:  # a shipped file is absent or damaged
        state, file = f"{error.where}: {error.problem}", error.where.partition(": ")[0]
        return Finding(name, False, state, COMPLETE, restore(file))
    except ImportError as error:
        return Finding(name, False, _in_a_line(error), COMPLETE, reinstall())
    except Exception as error:  # a broken installation can raise any error
        return Finding(name, False, _in_a_line(error), COMPLETE, anew_or_again())


def _in_a_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def anew_or_again() -> str:
    """Returns the remedy for a model that does not work: compiled code that is damaged, or packages."""
    return f"{compile_anew()}; if this does not help: {reinstall()}"


def findings_of_models(reporter: Reporter) -> list[Finding]:
    """Returns the findings of all models, each checked in a process of its own."""
    from bayeskin.execution.local import Lost, run_parallel

    reporter.log(
        "Checking the models. The first time after an installation, this compiles them, which takes about "
        "40 seconds on two cores."
    )
    findings: dict[int, Finding] = {}
    try:
        for index, result in run_parallel(_finding_of_model, list(CHECKS), min(cores(), len(CHECKS))):
            name = list(CHECKS)[index]
            lost = isinstance(result, Lost)
            findings[index] = Finding(name, False, result.reason, ALIVE, MEMORY) if lost else result
            reporter.progress("models", len(findings) / len(CHECKS), name)
    except InputError as error:  # the processes end before they begin
        return [Finding("models", False, f"{error.where}: {error.problem}", COMPLETE, reinstall())]
    return [findings[index] for index in sorted(findings)]


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _finding_of_model(name: str) -> Finding:
    return finding_of(name, CHECKS[name])


def _pull() -> PadMotion:
    """Returns the motion of both models."""
    import numpy as np

    from bayeskin.types import PadMotion

    return PadMotion(np.array([0.0, 2.0]), np.array([0.0, 2e-3]))


def reduced_model_finding() -> Finding:
    """Returns whether a short run of the shipped reduced model, with a derivative, gives the stored force."""
    from bayeskin.reduced.files import load_reduced
    from bayeskin.reduced.simulate import simulate_reduced
    from bayeskin.shipped import shipped
    from bayeskin.workflow.reducing import SHIPPED

    started, name = time.perf_counter(), "reduced model"
    run = simulate_reduced(load_reduced(shipped(SHIPPED)), _pull(), THETA, gradients={"E_c": THETA["E_c"]})
    if run.status != "ok":
        return Finding(name, False, run.message, "a run without an error", anew_or_again())
    return _compared(name, float(run.force_n[-1]), REDUCED_MODEL_N, REDUCED_MODEL_TOLERANCE, started)


def full_model_finding() -> Finding:
    """Returns whether a short run of the full model, with a derivative, gives the stored force."""
    from bayeskin.finite_element import ModelSpec, simulate

    started, name = time.perf_counter(), "full model"
    run = simulate(ModelSpec(), _pull(), THETA, gradients={"E_c": THETA["E_c"]})
    if run.status != "ok":
        return Finding(name, False, run.message, "a run without an error", anew_or_again())
    return _compared(name, float(run.force_n[-1]), FULL_MODEL_N, FULL_MODEL_TOLERANCE, started)


def surrogate_finding() -> Finding:
    """Returns whether the demo's surrogate predicts the stored force."""
    from bayeskin.shipped import shipped
    from bayeskin.surrogates import load_surrogate

    started = time.perf_counter()
    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    prediction = surrogate.predict([[THETA[name] for name in surrogate.space.names]])
    return _compared("surrogate", float(prediction.mean.max()), SURROGATE_N, SURROGATE_TOLERANCE, started)


def posterior_finding() -> Finding:
    """Returns whether the posterior of the demo's recording has the stored log-likelihood."""
    from bayeskin.finite_element import ModelSpec
    from bayeskin.forward.posterior import posterior_of
    from bayeskin.inference import NoisePriors, check_residuals
    from bayeskin.recordings import (
        analyse,
        bin_recording,
        covered_s,
        read_recording,
        recorded_motion,
        segment,
        uniform_edges,
    )  # fmt: skip
    from bayeskin.shipped import shipped
    from bayeskin.surrogates import load_surrogate

    started = time.perf_counter()
    recording = read_recording(shipped("data/demo.h5"))
    phases, surrogate = segment(recording), load_surrogate(shipped("surrogates/demo.h5"))
    motion = recorded_motion(recording, phases)
    edges_s = uniform_edges(covered_s(recording, motion), 0.5)
    binned = bin_recording(recording, phases, edges_s, analyse(recording, phases))
    posterior = posterior_of(surrogate, ModelSpec(), binned, motion, NoisePriors(), surrogate.space)
    sd_n = [NOISE_SD_N] * len(posterior.chain.kinds)
    theta = [[THETA[name] for name in surrogate.space.names] + sd_n + [NOISE_TAU_S, NOISE_NU]]
    check_residuals(posterior, posterior.to_sampling(theta)[0])  # calls the compiled noise model
    nats = float(posterior.log_likelihood(theta)[0])
    return _compared("posterior", nats, POSTERIOR_NATS, POSTERIOR_TOLERANCE, started, unit="nats")


def _compared(
    name: str, found: float, expected: float, tolerance: float, started: float, unit: str = "N"
) -> Finding:
    """Returns whether a number equals the stored number within a relative tolerance."""
    ok = math.isclose(found, expected, rel_tol=tolerance)
    return Finding(
        name, ok, f"{found:.6f} {unit} in {time.perf_counter() - started:.1f} s",
        f"{expected:.6f} {unit} within {100 * tolerance:g} %", anew_or_again(),
    )  # fmt: skip


# The check that takes longest to compile comes first, so that the processes end at about the same time.
CHECKS: dict[str, Callable[[], Finding]] = {
    "reduced model": reduced_model_finding,
    "full model": full_model_finding,
    "posterior": posterior_finding,
    "surrogate": surrogate_finding,
}
