"""The configuration of a run: reads a TOML file into checked values, and reports an error in one line.

Every key has a default except ``recording.file``. Units are part of the names (``bin_width_s``). The bounds
of a parameter are in the SI unit of the parameter, as in `bayeskin.design.default_space`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from bayeskin.design import default_space
from bayeskin.device import (
    ROOM,
    DeviceConfig,
    StatedGeometry,
    TissueConfig,
    length_parameters,
    stated_geometry,
)
from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.sections import Section, checked, one_of, read_toml
from bayeskin.types import Correlation, Observation, Parameter, ParameterSpace

EXPECTED = "a TOML configuration, as `bayeskin new RECORDING` writes one"
FEWEST_CHECKED = 8  # importance weights of fewer draws carry almost no information
# The upper bounds catch typing errors, which would exhaust the memory. No real computation comes near them.
Positive = Annotated[int, Field(gt=0, le=10**9)]
Runs = Annotated[int, Field(gt=0, le=100_000)]  # runs of the full model
Refinement = Annotated[int, Field(ge=0, le=6)]


# These keys say where runs are made, so no result depends on them.
WHO_RUNS: Any = {"design": {"workers", "scheduler"}, "slurm": True}


class RecordingConfig(Section):
    """The recording, and how the protocol of the model follows its displacement.

    With "idealised", the protocol goes straight between the recording's corners, whose times and
    displacements are rounded. With "recorded", it follows the measured displacement closely.
    """

    file: str
    protocol: Literal["recorded", "idealised"] = "idealised"


class ModelConfig(Section):
    """The force that the model reports, its mesh (the generator's bricks or a gmsh file) and its refinement.

    `forward` names a forward model of the user's own, which then replaces the full model. It is
    "FILE.py:FUNCTION" (beside the configuration), "PACKAGE.MODULE:FUNCTION" or the URL of a UM-Bridge server.
    The observation of such a model is "own".
    """

    observation: Observation = "reaction"
    mesh: str = "bricks"
    refinement: Refinement = 1  # of the bricks, towards the edges of the pads; 0 gives 80 bricks
    forward: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _forward_model_implies_observation_own(cls, given: Any) -> Any:
        """Sets the observation "own" where a forward model of the user's own is given."""
        return {"observation": "own", **given} if isinstance(given, dict) and "forward" in given else given

    @model_validator(mode="after")
    def _observation_own_needs_a_forward_model(self) -> ModelConfig:
        """Refuses the observation "own" without a forward model, and another observation with it."""
        if (self.observation == "own") != (self.forward is not None):
            raise ValueError(
                f"observation: found {self.observation!r}; expected 'own' with model.forward, and only then"
            )
        return self

    def spec(self) -> ModelSpec:
        """Returns the specification of the model on the article's device, with the paths as they are written.

        Raises InputError for a mesh that does not go with the observation.
        """
        return ModelSpec(self.observation, self.mesh, self.refinement, forward=self.forward)


class PriorConfig(Section):
    """Values that replace the default prior of one parameter; values that are not given keep their default.

    `mean` and `sd` belong to a normal prior. `median` and `factor` (the factor of one sd) belong to a
    log-normal prior. Both priors are truncated at the bounds. `correlations` maps names of other parameters
    with normal priors to correlations; each pair is stated once.

    With `model.forward`, the parameters of the configuration are the only parameters. Each of them has
    bounds, and may have a unit.
    """

    lower: float | None = None
    upper: float | None = None
    prior: Literal["uniform", "log-uniform", "normal", "log-normal"] | None = None
    mean: float | None = None
    sd: Annotated[float, Field(gt=0)] | None = None
    median: Annotated[float, Field(gt=0)] | None = None
    factor: Annotated[float, Field(gt=1)] | None = None
    correlations: dict[str, float] = {}
    source: str = "configuration"
    unit: str | None = None

    @model_validator(mode="after")
    def _normal_prior_has_its_two_numbers(self) -> PriorConfig:
        """Refuses a normal or log-normal prior without its two numbers, and these numbers without it."""
        given = {name for name in ("mean", "sd", "median", "factor") if getattr(self, name) is not None}
        needed = {"normal": {"mean", "sd"}, "log-normal": {"median", "factor"}}.get(self.prior or "", set())
        if given != needed:
            found = ", ".join(sorted(given)) or "none of its numbers"
            expected = f"{' and '.join(sorted(needed))}" if needed else "them only with a normal prior"
            raise ValueError(f"prior: found {found}; expected {expected}")
        return self

    @property
    def centre_and_spread(self) -> tuple[float, float]:
        """Returns centre and spread of the prior on its line: the value itself or its logarithm.

        For a uniform prior, both numbers are placeholders without meaning.
        """
        if self.mean is not None and self.sd is not None:
            return self.mean, self.sd
        if self.median is not None and self.factor is not None:
            return self.median, math.log(self.factor)
        return 0.0, 1.0


class DesignConfig(Section):
    """Runs of the model: training points and held-out points of each wave, and worker processes.

    With `coarse`, the waves run a quicker model. The configuration's model then runs at `fine_points` and
    `fine_held_out` of their points, to correct the surrogate of the quicker model. The quicker model is
    either the bricks at a refinement below the model's, or "reduced", the reduced model of the device. With
    "reduced", the waves from the third on are drawn from the posterior that the surrogate of the earlier
    waves gives. If `scheduler`, the address of a Dask scheduler, is set, the runs are made there.
    """

    points: Annotated[list[Runs], Field(min_length=1, max_length=100)] = [128, 96, 64]
    held_out: Runs = 16
    coarse: Refinement | Literal["reduced"] | None = None
    fine_points: Runs = 16
    fine_held_out: Runs = 6
    workers: Annotated[int, Field(gt=0, le=4096)] = 2
    scheduler: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _defaults_of_a_reduced_model(cls, given: Any) -> Any:
        """Sets the defaults for a reduced model, which needs fewer full runs as a correction."""
        reduced = isinstance(given, dict) and given.get("coarse") == "reduced"
        usual = {"points": [128, 96, 64, 64], "fine_points": 8, "fine_held_out": 4}
        return {**usual, **given} if reduced else given


class SlurmConfig(Section):
    """Runs of the full model as SLURM jobs through dask-jobqueue: the number of jobs, and their requests."""

    jobs: Annotated[int, Field(gt=0, le=100_000)]
    queue: str | None = None
    account: str | None = None
    memory: str = "2GB"
    walltime: str = "04:00:00"


class SurrogateConfig(Section):
    """The kind of surrogate, or the file of a shipped surrogate, with which no design is needed."""

    kind: Literal["auto", "gp", "chaos"] = "auto"
    file: str | None = None


class FitConfig(Section):
    """The windows of the recording that are fitted (default: all of it), and the width of the bins."""

    windows_s: list[tuple[float, float]] | None = None
    bin_width_s: Annotated[float, Field(gt=0)] = 0.5

    @model_validator(mode="after")
    def _windows_start_before_they_end(self) -> FitConfig:
        """Refuses an empty list of windows, and a window that does not start before it ends."""
        if self.windows_s is not None and not self.windows_s:
            raise ValueError("windows_s: found an empty list; expected at least one [start, end]")
        for start, end in self.windows_s or ():
            if not start < end:
                raise ValueError(f"windows_s: found [{start:g}, {end:g}]; expected start below end")
        return self


class NoiseConfig(Section):
    """Bounds of the log-uniform priors on the noise: sd [N], correlation time [s], tail index."""

    sd_n: tuple[float, float] | None = None
    tau_s: tuple[float, float] | None = None
    nu: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _lower_bounds_lie_below_upper(self) -> NoiseConfig:
        """Refuses bounds that are not ascending or not positive."""
        for name, bounds in self:
            if bounds is not None and not 0 < bounds[0] < bounds[1]:
                found = f"[{bounds[0]:g}, {bounds[1]:g}]"
                raise ValueError(f"{name}: found {found}; expected lower below upper, both above zero")
        return self


class SampleConfig(Section):
    """The number of independent ensembles and of walkers, and the criteria for stopping the sampler."""

    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    walkers: Annotated[int, Field(ge=4, le=100_000)] = 40
    effective_samples: Positive = 5000
    max_steps: Annotated[int, Field(ge=500)] = 20000  # the first 300 steps only lead to the posterior


class CheckConfig(Section):
    """The number of posterior draws that full runs check, and how often these may join the design."""

    draws: Annotated[int, Field(ge=0, le=100_000)] = 24
    rounds: Annotated[int, Field(ge=0, le=1000)] = 2

    @model_validator(mode="after")
    def _very_few_draws_are_refused(self) -> CheckConfig:
        """Refuses numbers of draws whose importance weights carry almost no information."""
        if 0 < self.draws < FEWEST_CHECKED:
            raise ValueError(f"draws: found {self.draws}; expected 0 for none, or at least {FEWEST_CHECKED}")
        return self


class MapConfig(Section):
    """The number of starts of the search for the most probable point, and of evaluations of each start."""

    starts: Annotated[int, Field(gt=0, le=100_000)] = 8
    evaluations: Positive = 20000


class SobolConfig(Section):
    """The number of samples in each matrix of the pick-freeze estimate, on the Gaussian process."""

    samples: Annotated[int, Field(gt=0, le=2**20)] = 2048


class Config(Section):
    """The configuration of a whole run, which `load_config` reads from a file."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    recording: RecordingConfig
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    model: ModelConfig = ModelConfig()
    device: DeviceConfig = DeviceConfig()
    tissue: TissueConfig = TissueConfig()
    parameters: dict[str, PriorConfig] = {}
    design: DesignConfig = DesignConfig()
    slurm: SlurmConfig | None = None
    surrogate: SurrogateConfig = SurrogateConfig()
    fit: FitConfig = FitConfig()
    noise: NoiseConfig = NoiseConfig()
    sample: SampleConfig = SampleConfig()
    check: CheckConfig = CheckConfig()
    map: MapConfig = MapConfig()
    sobol: SobolConfig = SobolConfig()

    @model_validator(mode="after")
    def _model_has_a_specification(self) -> Config:
        """Refuses a mesh that does not go with the observation."""
        self.model.spec()
        return self

    @model_validator(mode="after")
    def _coarse_model_is_coarser(self) -> Config:
        """Refuses a coarse model that is not coarser, and keys that do not go with a forward model of the
        user."""
        coarse, model = self.design.coarse, self.model
        below = 0 if coarse == "reduced" else coarse
        if below is not None and (model.mesh != "bricks" or below >= model.refinement):
            found = (
                f"{coarse} with model.observation {model.observation!r}, model.mesh {model.mesh!r}, "
                f"model.refinement {model.refinement}"
            )
            expected = "refinement 1 or more" if coarse == "reduced" else "a higher refinement"
            raise ValueError(f"design.coarse: found {found}; expected bricks with {expected}")
        if model.forward is not None and (coarse is not None or self.surrogate.file is not None):
            key = "design.coarse" if coarse is not None else "surrogate.file"
            raise ValueError(
                f"{key}: found a value with model.forward; expected none, because it concerns the full model"
            )
        return self

    @property
    def sha256(self) -> str:
        """Returns the hash of all keys that can change a result, without the keys that say where runs are
        made."""
        plain = self.model_dump(mode="json", exclude=WHO_RUNS)
        for name, default in (("device", DeviceConfig()), ("tissue", TissueConfig())):
            if getattr(self, name) == default:  # keeps hashes from before these sections existed
                del plain[name]
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

    def geometry(self, where: object = "configuration") -> StatedGeometry:
        """Returns device and tissue as the sections `device` and `tissue` state them.

        An uncertain length moves the nodes of the mesh, so it needs the generator's bricks. Raises
        InputError, which names `where`, for lengths that are impossible or do not go with the model.
        """
        stated = stated_geometry(self.device, self.tissue, where)
        model, any_device = self.model, self.model.spec().formulation.any_device
        if stated.sd_m and not (any_device and model.mesh == "bricks"):
            name, conflict = next(iter(stated.sd_m)), model.mesh if any_device else model.observation
            found = f"a mean and an sd, with {conflict!r} in [model]"
            expected = "a number, or observation 'reaction' on mesh 'bricks'"
            raise InputError(f"{where}: tissue.{name}m", found, expected)
        if not any_device and stated != StatedGeometry(Geometry()):
            section = "device" if self.device != DeviceConfig() else "tissue"
            found = f"settings other than the article's, with observation {model.observation!r}"
            raise InputError(f"{where}: {section}", found, "observation 'reaction'")
        return stated


def load_config(path: Path | str) -> Config:
    """Reads and checks a configuration; ``name`` defaults to the file's name without its suffix.

    Raises InputError for a file that is absent or is not TOML, an unknown key, a value of the wrong type or
    range, and a lower bound above the upper.
    """
    path = Path(path)
    plain = read_toml(path, EXPECTED)
    plain.setdefault("name", path.stem)
    return config_of(plain, path)


def config_of(plain: Mapping[str, Any], where: Path | str) -> Config:
    """Checks the sections of a configuration. Raises InputError as `load_config`, which names `where`."""
    config = checked(Config, plain, where, EXPECTED)
    parameter_space(config, where)
    config.geometry(where)
    return config


def to_toml(config: Config) -> str:
    """Returns a configuration as TOML text with all keys, from which `load_config` reads the same values."""
    return "\n".join(_table(config.model_dump(mode="json", exclude_none=True))) + "\n"


def _table(plain: Mapping[str, Any], name: str = "") -> list[str]:
    # JSON and TOML write a scalar, and a list of scalars, in the same way.
    """Returns the lines of a TOML table and of the tables in it."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in plain.items() if not isinstance(value, dict)]
    for key, value in plain.items():
        if isinstance(value, dict):
            path = f"{name}.{key}" if name else key
            lines += [f"[{path}]", *_table(value, path)]
    return lines


def parameter_space(config: Config, where: object = "configuration") -> ParameterSpace:
    """Returns the prior of a configuration: the default parameters with the configuration's changes.

    With a forward model of the user's own, these are the parameters of the configuration. Uncertain lengths
    of the tissue follow after the default parameters. Raises InputError for an unknown parameter, a lower
    bound above the upper, a logarithmic prior that reaches zero, impossible lengths, or impossible
    correlations.
    """
    space = (
        _space_of_forward_model(config, where)
        if config.model.forward is not None
        else _space_of_full_model(config, where)
    )
    correlations = tuple(
        Correlation(name, partner, value)
        for name, prior in config.parameters.items()
        for partner, value in prior.correlations.items()
    )
    try:
        return replace(space, correlations=correlations)
    except InputError as error:
        raise InputError(f"{where}: {error.where}", error.found, error.expected) from None


def _space_of_full_model(config: Config, where: object) -> ParameterSpace:
    """Returns the default parameters and the uncertain lengths, with the configuration's changes."""
    stated = config.geometry(where)
    default = ParameterSpace((*default_space().parameters, *length_parameters(stated)))
    unknown = sorted(set(config.parameters) - set(default.names))
    if unknown:
        where = f"{where}: parameters.{unknown[0]}"
        raise InputError(where, "an unknown parameter", one_of(default.names))
    space = ParameterSpace(
        tuple(_overridden(p, config.parameters.get(p.name), where) for p in default.parameters)
    )
    _check_lengths(space, stated.geometry, where)
    return space


def _check_lengths(space: ParameterSpace, geometry: Geometry, where: object) -> None:
    """Raises InputError where some lengths between the bounds cannot be meshed."""
    lengths = [p for p in space.parameters if p.name in LENGTHS]
    low = {p.name: p.lower / (1.0 + ROOM) for p in lengths}
    high = {p.name: p.upper / (1.0 - ROOM) for p in lengths}
    thickest = {name: low[name] if name == "arm_radius_m" else value for name, value in high.items()}
    for corner in (low, high, thickest):
        try:
            moved(geometry, corner)
        except InputError as error:
            p = next((p for p in lengths if p.name == error.where), lengths[0])
            found = f"{1e3 * p.lower:g} to {1e3 * p.upper:g} mm"
            raise InputError(f"{where}: parameters.{p.name}", found, error.expected) from None


def _space_of_forward_model(config: Config, where: object) -> ParameterSpace:
    """Returns the parameters of a forward model of the user's own, by default those of the full model.

    The parameters do not have the law by which the force of the full model scales with stiffness and
    permeability.
    """
    if not config.parameters:
        return ParameterSpace(tuple(replace(p, stress_power=0) for p in default_space().parameters))
    parameters = []
    for name, prior in config.parameters.items():
        for key in ("lower", "upper"):
            if getattr(prior, key) is None:
                at = f"{where}: parameters.{name}.{key}"
                raise InputError(at, "nothing", "a bound, because model.forward is set")
        blank = Parameter(name, prior.unit or "", 0.0, 0.0, "uniform")
        parameters.append(_overridden(blank, prior, where))
    return ParameterSpace(tuple(parameters))


def _overridden(default: Parameter, change: PriorConfig | None, where: object) -> Parameter:
    """Returns a parameter with the changes of a configuration. Raises InputError for invalid changes."""
    if change is None:
        return default
    if change.unit not in (None, default.unit):
        raise InputError(f"{where}: parameters.{default.name}.unit", repr(change.unit), repr(default.unit))
    lower = default.lower if change.lower is None else change.lower
    upper = default.upper if change.upper is None else change.upper
    prior = change.prior or default.prior
    at = f"{where}: parameters.{default.name}"
    if not lower < upper:
        raise InputError(at, f"lower {lower:g}, upper {upper:g} {default.unit}", "lower below upper")
    if prior.startswith("log") and lower <= 0:
        raise InputError(f"{at}.lower", f"{lower:g} with a {prior} prior", "a bound above zero")
    centre, spread = change.centre_and_spread if change.prior else (default.centre, default.spread)
    if prior.endswith("normal") and not lower <= centre <= upper:
        raise InputError(
            at,
            f"a prior centred at {centre:g} {default.unit}",
            f"{lower:g} to {upper:g}, the bounds of the parameter",
        )
    return replace(
        default, lower=lower, upper=upper, prior=prior, source=change.source, centre=centre, spread=spread
    )
