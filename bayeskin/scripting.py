"""Functions for scripts, after ``import bayeskin as bk``; each of them calls what the commands call.

Settings have the names of a configuration's sections (docs/configuration.md) and are checked in the same way.
Wrong settings raise InputError with one line of text.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from bayeskin import inference, storage
from bayeskin.config import FEWEST_CHECKED, config_of, parameter_space, to_toml
from bayeskin.design_files import load_design
from bayeskin.errors import InputError
from bayeskin.finite_element import simulate as run_model
from bayeskin.inference import LogPosterior, Weighed
from bayeskin.json_files import plain
from bayeskin.recordings import Stated, idealised_motion, read_recording, segment, stated_unit
from bayeskin.surrogates import load_surrogate
from bayeskin.types import BinnedForce, PadMotion, Recording, Simulation
from bayeskin.workflow import diagnosing
from bayeskin.workflow.calibration import log_posterior_of
from bayeskin.workflow.engine import Run, Silent
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.posterior import PREDICTIVE_DRAWS, chains_folder, provenance_of, settings_of
from bayeskin.workflow.recording import pad_motion, prepared
from bayeskin.workflow.shipping import check_fits, shipped_files, shipped_for

if TYPE_CHECKING:
    import arviz

FILE, CONFIG = "recording.h5", "calibration.toml"


def load_recording(
    path: Path | str,
    sheet: str | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    zero: bool | None = None,
) -> Recording:
    """Returns a recording in SI units, from any file that ``bayeskin import`` reads (docs/how-to/import.md).

    Parameters
    ----------
    sheet : the name of one of several tables
    columns : the name or number of the column of ``time``, ``displacement`` and ``force``
    units : the unit of a quantity, such as ``{"force": "gf"}``; a minus, as in ``"-N"``, turns the sign
    zero : True subtracts the first displacement, False keeps it

    Raises InputError for a file that is no recording, and where the file alone does not decide.
    """
    stated_units = {quantity: stated_unit(quantity, unit) for quantity, unit in (units or {}).items()}
    return read_recording(path, sheet=sheet, stated=Stated(columns or {}, stated_units, zero))


def simulate(
    recording: Recording, /, theta: Mapping[str, float] | None = None, **settings: Any
) -> Simulation:
    """Returns one run of the full model on a recording's displacement, which takes some seconds.

    theta : SI values by parameter name; a missing parameter has the median of its prior
    settings : sections of a configuration, such as ``model={"refinement": 2}``

    Raises InputError for wrong settings or values.
    """
    with _run_on(recording, settings) as run:
        space = parameter_space(run.config)
        unknown = set(theta or {}) - set(space.names)
        if unknown:
            raise InputError(
                "simulate: theta",
                f"{min(unknown)} is not known",
                f"use some of {', '.join(space.names)}",
            )
        middle = dict(zip(space.names, map(float, space.from_unit(np.full(space.dim, 0.5))), strict=True))
        spec, protocol = model_spec(run), run.config.each_recording[0].protocol
        motion = pad_motion(spec, recording, segment(recording), protocol)
        return run_model(spec, motion, {**middle, **(theta or {})})


def calibrate(
    recording: Recording,
    /,
    surrogate: str | Path | None = None,
    folder: str | Path | None = None,
    **settings: Any,
) -> arviz.InferenceData:
    """Returns the posterior of a recording under a surrogate, with its verdict in the attributes.

    This function does not run the full model. `check` runs it at draws of the result, and `bayeskin run` also
    runs it at the most probable point.

    Parameters
    ----------
    surrogate : the name of a shipped surrogate, such as "demo.h5", or a file with its design beside it; by
        default the shipped surrogate that was trained on the recording's protocol
    folder : where chains are stored, so that a call with the same arguments continues them
    settings : ``seed`` and sections of a configuration, such as ``fit={"windows_s": [[0, 75]]}``,
        ``parameters={"E_c": {"upper": 1e6}}``, ``sample={"effective_samples": 1000}``

    Returns
    -------
    InferenceData : posterior, predictions, prior, data and the log-likelihood by phase, so that `az.plot_*`,
        `az.loo` (which leaves out one phase at a time) and `az.compare` work
    """
    with _run_on(recording, _with_surrogate(recording, settings, surrogate), folder) as run:
        inputs = _calibration_inputs(run, recording)
        log_posterior, config = inputs.log_posterior, run.config
        best = inference.find_map(log_posterior, config.seed, config.map.starts, config.map.evaluations).theta
        chains = chains_folder(run, log_posterior)
        posterior = inference.sample(
            log_posterior, chains, config.seed, best, settings_of(config), threads=config.design.workers
        )
        provenance = provenance_of(run, log_posterior, recording.sha256)
        rng = np.random.default_rng([config.seed, 1])
        idata = inference.to_inference_data(log_posterior, posterior, provenance, rng, PREDICTIVE_DRAWS)
        idata.attrs["map"] = json.dumps(dict(best))
        return idata


def check(recording: Recording, posterior: arviz.InferenceData, draws: int = 24) -> Weighed:
    """Runs the full model at regularly chosen draws of a posterior of `calibrate`, and returns their weights.

    Raises InputError for fewer than 8 draws, because their weights carry almost no information. Raises
    InputError also for a posterior under another surrogate than that in the file that it names. `bayeskin
    run` makes such posteriors where it trains the surrogate further.
    """
    if draws < FEWEST_CHECKED:
        raise InputError("draws", f"{draws} draws are too few", f"use at least {FEWEST_CHECKED}")
    settings = _settings_of(recording, posterior)
    with _run_on(recording, settings) as run:
        inputs = _calibration_inputs(run, recording)
        log_posterior, flat = inputs.log_posterior, inference.draws_of(posterior)[1]
        if json.loads(posterior.attrs["provenance"]).get("identity") != log_posterior.identity:
            problem = f"it was made with another surrogate than {run.config.surrogate.file}"
            raise InputError(
                "posterior", problem, "use a posterior of bk.calibrate (`bayeskin run` checks its own)"
            )
        chosen = inference.evenly(flat, draws)
        spec, names, edges = model_spec(run), log_posterior.surrogate.space.names, inputs.binned.edges_s
        force = np.full((len(chosen), len(edges) - 1), np.nan)
        for row, point in enumerate(log_posterior.split(chosen)[0]):
            simulation = run_model(spec, inputs.motion, dict(zip(names, map(float, point), strict=True)))
            if simulation.status == "ok":
                force[row] = simulation.bin_means(edges)
        return inference.weigh(log_posterior, chosen, force)


def diagnose(
    recording: Recording, posterior: arviz.InferenceData | None = None, folder: str | Path | None = None
) -> dict[str, Any]:
    """Returns the answer of ``bayeskin diagnose``: the physics that the model leaves out of a recording.

    Surrogate, seed and noise are those of `posterior`. The whole recording is fitted, which takes minutes on
    two processes. `folder` keeps the figures and the files that a later call needs to continue.
    """
    settings = {} if posterior is None else _settings_of(recording, posterior)
    with (
        _run_on(recording, _with_surrogate(recording, settings, None), folder) as run,
        _without_caller_script(),
    ):
        return diagnosing.diagnose([run.config_path], Silent())


@contextmanager
def _without_caller_script() -> Iterator[None]:
    """Keeps processes that are started inside the context from running the caller's script again.

    These processes need nothing of the script, so the script needs no guard by ``__name__``.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


@dataclass(frozen=True)
class _CalibrationInputs:
    """The bins, the protocol and the log-posterior of a run."""

    binned: BinnedForce
    motion: PadMotion
    log_posterior: LogPosterior


def _calibration_inputs(run: Run, recording: Recording) -> _CalibrationInputs:
    """Returns bins, protocol and log-posterior of a run whose surrogate exists already."""
    fitted = prepared(run, recording, run.config.each_recording[0].protocol)
    files = shipped_files(run)
    design = load_design(files.design)
    check_fits(run, files, design, fitted.binned, fitted.motion)
    surrogate = load_surrogate(files.surrogate)
    log_posterior = log_posterior_of(run, surrogate, fitted.binned, fitted.motion, design)
    return _CalibrationInputs(fitted.binned, fitted.motion, log_posterior)


def _with_surrogate(
    recording: Recording, settings: Mapping[str, Any], surrogate: str | Path | None
) -> dict[str, Any]:
    """Returns the settings with a surrogate that was trained on the recording's protocol.

    Raises InputError where the settings name no surrogate and no shipped one was trained on this protocol.
    """
    recording = _checked_recording(recording)
    if surrogate is None and settings.get("surrogate", {}).get("file") is not None:
        return dict(settings)
    if surrogate is None:
        fitting = shipped_for(idealised_motion(recording, segment(recording)))
        if fitting is None:
            raise InputError(
                f"calibrate {recording.name}", "no shipped surrogate was trained on its protocol",
                "give surrogate=FILE from `bayeskin train`, or use `bayeskin run` with a configuration",
            )  # fmt: skip
        surrogate = fitting.name
    file = Path(surrogate)
    return {**settings, "surrogate": {"file": str(file.resolve()) if file.is_file() else str(surrogate)}}


def _settings_of(recording: Recording, posterior: arviz.InferenceData) -> dict[str, Any]:
    """Returns the configuration that a posterior was made with.

    Raises InputError for a posterior of another recording, and for a posterior whose surrogate has no file.
    """
    recording = _checked_recording(recording)
    if "recording_sha256" not in posterior.attrs:
        raise InputError(
            "posterior", "this InferenceData has no provenance", "use InferenceData that bayeskin made"
        )
    if posterior.attrs["recording_sha256"] != recording.sha256:
        raise InputError(
            "posterior",
            f"it belongs to another recording than {recording.name}",
            "use the recording of this posterior",
        )
    settings = dict(json.loads(posterior.attrs["provenance"])["config"])
    if settings["surrogate"].get("file") is None:
        remedy = "use the posterior of a surrogate file, or `bayeskin run` or `bayeskin diagnose`"
        raise InputError("posterior", "it belongs to a run with its own design", remedy)
    return settings


def _checked_recording(given: object) -> Recording:
    """Returns the recording. Raises InputError for an object of another type."""
    if not isinstance(given, Recording):
        raise InputError(
            "recording",
            f"{given!r:.60} has the type {type(given).__name__}",
            "use a recording of bk.load_recording",
        )
    return given


@contextmanager
def _run_on(
    recording: Recording, settings: Mapping[str, Any], folder: str | Path | None = None
) -> Iterator[Run]:
    """Yields a run on a recording, with its files in `folder`, or in a temporary folder without one."""
    with tempfile.TemporaryDirectory() as temporary:
        recording = _checked_recording(recording)
        place = Path(folder or temporary)
        place.mkdir(parents=True, exist_ok=True)
        storage.save(place / FILE, recording)
        section = {**settings.get("recording", {}), "file": FILE}
        config = config_of(plain({"name": "calibration", **settings, "recording": section}), "settings")
        (place / CONFIG).write_text(to_toml(config), encoding="utf-8")
        yield Run(config, place / CONFIG, place / config.name, Silent())
