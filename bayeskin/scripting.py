"""bayeskin from a script: ``import bayeskin as bk``. Each function is a thin call of what a run does.

Settings have the names and checks of a configuration's sections (README); InputError in one line where
they are wrong.
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
from bayeskin.errors import InputError
from bayeskin.finite_element import simulate as run_model
from bayeskin.inference import LogPosterior, Weighed
from bayeskin.json_files import plain
from bayeskin.recordings import read_recording, segment
from bayeskin.runner import load_design
from bayeskin.surrogates import load_surrogate
from bayeskin.types import BinnedForce, PadMotion, Recording, Simulation
from bayeskin.workflow import diagnosis
from bayeskin.workflow.calibration import log_posterior_of
from bayeskin.workflow.engine import Run, Silent
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.posterior import PREDICTIVE_DRAWS, chains_folder, provenance_of, settings_of
from bayeskin.workflow.recording import pad_motion, prepared
from bayeskin.workflow.shipping import check_fits, shipped_files, shipped_for

if TYPE_CHECKING:
    import arviz

FILE, CONFIG = "recording.h5", "calibration.toml"


def load_recording(path: Path | str, sheet: str | None = None) -> Recording:
    """A recording (xlsx, csv, tsv, h5) in SI units. Raises InputError where it is none."""
    return read_recording(path, sheet=sheet)


def simulate(
    recording: Recording, /, theta: Mapping[str, float] | None = None, **settings: Any
) -> Simulation:
    """Returns one run of the full model on a recording's displacement: some seconds.

    theta : SI values by name; what is left out stands at the median of its prior
    settings : sections of a configuration, such as ``model={"refinement": 2}``

    Raises InputError for wrong settings or values.
    """
    with _opened(recording, settings) as run:
        space = parameter_space(run.config)
        unknown = set(theta or {}) - set(space.names)
        if unknown:
            found = ", ".join(sorted(unknown))
            raise InputError("simulate: theta", found, f"some of {', '.join(space.names)}")
        middle = dict(zip(space.names, map(float, space.from_unit(np.full(space.dim, 0.5))), strict=True))
        spec, protocol = model_spec(run), run.config.recording.protocol
        motion = pad_motion(spec.observation, recording, segment(recording), protocol)
        return run_model(spec, motion, {**middle, **(theta or {})})


def calibrate(
    recording: Recording,
    /,
    surrogate: str | Path | None = None,
    folder: str | Path | None = None,
    **settings: Any,
) -> arviz.InferenceData:
    """Posterior of a recording under a surrogate, with its verdict in the attributes.

    No full model is run: `check` does so at draws of the result, and `bayeskin run` at the most probable
    point too.

    Parameters
    ----------
    surrogate : a shipped one's name, such as "demo.h5", or a file with its design beside it; by default the
        shipped one that knows the recording's protocol
    folder : where chains are kept, so that a call with the same arguments goes on from there
    settings : ``seed`` and sections of a configuration, such as ``fit={"windows_s": [[0, 75]]}``,
        ``parameters={"E_c": {"upper": 1e6}}``, ``sample={"effective_samples": 1000}``

    Returns
    -------
    InferenceData : posterior, predictions, prior, data and the log-likelihood by phase, so that `az.plot_*`,
        `az.loo` (which leaves out one phase at a time) and `az.compare` work
    """
    with _opened(recording, _with_surrogate(recording, settings, surrogate), folder) as run:
        work = _workpiece(run, recording)
        log_posterior, config = work.log_posterior, run.config
        best = inference.find_map(log_posterior, config.seed, config.map.starts, config.map.evaluations).theta
        chains = chains_folder(run, log_posterior)
        posterior = inference.sample(
            log_posterior, chains, config.seed, best, settings_of(config), threads=config.design.workers
        )
        origin = provenance_of(run, log_posterior, recording.sha256)
        rng = np.random.default_rng([config.seed, 1])
        idata = inference.to_inference_data(log_posterior, posterior, origin, rng, PREDICTIVE_DRAWS)
        idata.attrs["map"] = json.dumps(dict(best))
        return idata


def check(recording: Recording, posterior: arviz.InferenceData, draws: int = 24) -> Weighed:
    """Runs the full model at evenly taken draws of a posterior of `calibrate`, and weighs them by it.

    Raises InputError for fewer than 8 draws, of which weights say next to nothing, and for a posterior by
    another surrogate than the file's that it names, as `bayeskin run` makes where it trains on.
    """
    if draws < FEWEST_CHECKED:
        raise InputError("draws", draws, f"at least {FEWEST_CHECKED}")
    settings = _settings_of(recording, posterior)
    with _opened(recording, settings) as run:
        work = _workpiece(run, recording)
        log_posterior, flat = work.log_posterior, inference.draws_of(posterior)[1]
        if json.loads(posterior.attrs["provenance"]).get("identity") != log_posterior.identity:
            other = f"one by another surrogate than that of {run.config.surrogate.file}"
            raise InputError("posterior", other, "one of bk.calibrate; `bayeskin run` has checked its own")
        few = inference.evenly(flat, draws)
        spec, names, edges = model_spec(run), log_posterior.surrogate.space.names, work.binned.edges_s
        force = np.full((len(few), len(edges) - 1), np.nan)
        for row, point in enumerate(log_posterior.split(few)[0]):
            found = run_model(spec, work.motion, dict(zip(names, map(float, point), strict=True)))
            if found.status == "ok":
                force[row] = found.bin_means(edges)
        return inference.weigh(log_posterior, few, force)


def diagnose(
    recording: Recording, posterior: arviz.InferenceData | None = None, folder: str | Path | None = None
) -> dict[str, Any]:
    """Returns the answer of ``bayeskin diagnose``: what the model leaves out of a recording.

    Surrogate, seed and noise are those that `posterior` was made with; the whole recording is fitted.
    Minutes, on two processes. `folder` keeps figures and what is needed to go on.
    """
    settings = {} if posterior is None else _settings_of(recording, posterior)
    with _opened(recording, _with_surrogate(recording, settings, None), folder) as run, _apart_from_script():
        return diagnosis.diagnose(run.config_path, Silent())


@contextmanager
def _apart_from_script() -> Iterator[None]:
    """Processes started inside do not run the caller's script again, so that it needs no guard: they need
    nothing of it."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


@dataclass(frozen=True)
class _Workpiece:
    binned: BinnedForce
    motion: PadMotion
    log_posterior: LogPosterior


def _workpiece(run: Run, recording: Recording) -> _Workpiece:
    """Bins, protocol and posterior of a run whose surrogate is there."""
    made = prepared(run, recording)
    files = shipped_files(run)
    check_fits(run, files, load_design(files.design), made.binned, made.motion)
    log_posterior = log_posterior_of(run, load_surrogate(files.surrogate), made.binned, made.motion)
    return _Workpiece(made.binned, made.motion, log_posterior)


def _with_surrogate(
    recording: Recording, settings: Mapping[str, Any], surrogate: str | Path | None
) -> dict[str, Any]:
    """The settings with a surrogate that knows the recording's protocol."""
    recording = _recording(recording)
    if surrogate is None and settings.get("surrogate", {}).get("file") is not None:
        return dict(settings)
    if surrogate is None:
        found = shipped_for(pad_motion("reaction", recording, segment(recording), "idealised"))
        if found is None:
            raise InputError(
                f"calibrate {recording.name}", "a protocol that no shipped surrogate was trained on",
                "surrogate=FILE of `bayeskin train`, or a configuration and `bayeskin run`",
            )  # fmt: skip
        surrogate = found.name
    own = Path(surrogate)
    return {**settings, "surrogate": {"file": str(own.resolve()) if own.is_file() else str(surrogate)}}


def _settings_of(recording: Recording, posterior: arviz.InferenceData) -> dict[str, Any]:
    """The configuration that a posterior was made with; refused for another recording than its own."""
    recording = _recording(recording)
    if "recording_sha256" not in posterior.attrs:
        raise InputError("posterior", "an InferenceData without provenance", "one made by bayeskin")
    if posterior.attrs["recording_sha256"] != recording.sha256:
        raise InputError(
            "posterior", f"that of another recording than {recording.name}", "the recording it was made of"
        )
    settings = dict(json.loads(posterior.attrs["provenance"])["config"])
    if settings["surrogate"].get("file") is None:
        expected = "one of a surrogate's file; `bayeskin run` and `diagnose` do this for a design of its own"
        raise InputError("posterior", "one of a run with a design of its own", expected)
    return settings


def _recording(given: object) -> Recording:
    if not isinstance(given, Recording):
        raise InputError("recording", f"{type(given).__name__} {given!r:.60}", "one of bk.load_recording")
    return given


@contextmanager
def _opened(
    recording: Recording, settings: Mapping[str, Any], folder: str | Path | None = None
) -> Iterator[Run]:
    """A run on a recording, its files in `folder` or in one that is gone afterwards."""
    with tempfile.TemporaryDirectory() as passing:
        recording = _recording(recording)
        where = Path(folder or passing)
        where.mkdir(parents=True, exist_ok=True)
        storage.save(where / FILE, recording)
        own = {**settings.get("recording", {}), "file": FILE}
        config = config_of(plain({"name": "calibration", **settings, "recording": own}), "settings")
        (where / CONFIG).write_text(to_toml(config), encoding="utf-8")
        yield Run(config, where / CONFIG, where / config.name, Silent())
