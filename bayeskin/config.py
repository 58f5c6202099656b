"""The configuration of a run: TOML in, checked values out, one line on what is wrong.

Every key has a default except ``recording.file``. Units stand in the names (``bin_width_s``); bounds
of a parameter are in its own SI unit, as in `bayeskin.design.default_space`.
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
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.sections import Section, checked, one_of, read_toml
from bayeskin.types import Correlation, Parameter, ParameterSpace

EXPECTED = "a TOML configuration, as `bayeskin new RECORDING` writes one"
FEWEST_CHECKED = 8  # draws: of fewer, weights say next to nothing
# Upper bounds refuse slips of the pen, which would take all memory; no computation comes near them.
Positive = Annotated[int, Field(gt=0, le=10**9)]
Runs = Annotated[int, Field(gt=0, le=100_000)]  # of the full model
Refinement = Annotated[int, Field(ge=0, le=6)]


WHO_RUNS: Any = {"design": {"workers", "scheduler"}, "slurm": True}  # no result depends on it


class RecordingConfig(Section):
    """The recording, and whether the model follows its displacement closely or its corners, rounded."""

    file: str
    protocol: Literal["recorded", "idealised"] = "idealised"


class ModelConfig(Section):
    """The force that the model reports, on which mesh (the generator's bricks or a gmsh file), how finely.

    `forward`: a model of one's own instead, "FILE.py:FUNCTION" (beside the configuration),
    "PACKAGE.MODULE:FUNCTION" or the URL of a UM-Bridge server; its observation is "own".
    """

    observation: Literal["reaction", "article", "own"] = "reaction"
    mesh: str = "bricks"
    refinement: Refinement = 1  # of the bricks, toward the pads' edges; 0: 80 of them
    forward: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _a_forward_model_is_ones_own(cls, given: Any) -> Any:
        return {"observation": "own", **given} if isinstance(given, dict) and "forward" in given else given

    @model_validator(mode="after")
    def _own_needs_its_forward_model(self) -> ModelConfig:
        if (self.observation == "own") != (self.forward is not None):
            raise ValueError(f"observation: found {self.observation!r}; expected 'own' with model.forward")
        return self

    @model_validator(mode="after")
    def _article_needs_its_mesh(self) -> ModelConfig:
        if self.observation == "article" and self.mesh == "bricks":
            raise ValueError(
                "mesh: found 'bricks'; expected the article's gmsh file with observation 'article'"
            )
        return self


class PriorConfig(Section):
    """Values that replace the default prior of one parameter; what is not given stays as it was.

    `mean` and `sd` belong to a normal prior, `median` and `factor` (of one sd) to a log-normal one; both are
    cut to the bounds. `correlations` are with normal priors of other parameters, by their names, stated once.

    With `model.forward` these are all the parameters there are: each has bounds, and may have a unit.
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
    def _a_normal_prior_has_its_two_numbers(self) -> PriorConfig:
        given = {name for name in ("mean", "sd", "median", "factor") if getattr(self, name) is not None}
        wanted = {"normal": {"mean", "sd"}, "log-normal": {"median", "factor"}}.get(self.prior or "", set())
        if given != wanted:
            found = ", ".join(sorted(given)) or "none of its numbers"
            expected = f"{' and '.join(sorted(wanted))}" if wanted else "these with a normal prior only"
            raise ValueError(f"prior: found {found}; expected {expected}")
        return self

    @property
    def centre_and_spread(self) -> tuple[float, float]:
        """Returns the centre and spread of the prior on its line; those of a uniform prior say nothing."""
        if self.mean is not None and self.sd is not None:
            return self.mean, self.sd
        if self.median is not None and self.factor is not None:
            return self.median, math.log(self.factor)
        return 0.0, 1.0


class DesignConfig(Section):
    """Full runs: training points of each wave, held-out points of each wave, worker processes.

    With `coarse` the waves run a quicker model, and the model itself at `fine_points` and `fine_held_out` of
    their points, to correct what the quicker one gave: coarser bricks, of a refinement below the model's, or
    "reduced", the reduced model of the device, whose waves from the third on are drawn from the posterior by
    the surrogate of the waves before. `scheduler`, the address of a Dask scheduler, has the runs
    made there.
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
    def _a_reduced_model_needs_less_correction(cls, given: Any) -> Any:
        reduced = isinstance(given, dict) and given.get("coarse") == "reduced"
        usual = {"points": [128, 96, 64, 64], "fine_points": 8, "fine_held_out": 4}
        return {**usual, **given} if reduced else given


class SlurmConfig(Section):
    """Full runs as jobs of SLURM through dask-jobqueue: how many, and what it is told of each."""

    jobs: Annotated[int, Field(gt=0, le=100_000)]
    queue: str | None = None
    account: str | None = None
    memory: str = "2GB"
    walltime: str = "04:00:00"


class SurrogateConfig(Section):
    """Kind of surrogate, or a shipped one that spares the design."""

    kind: Literal["auto", "gp", "chaos"] = "auto"
    file: str | None = None


class FitConfig(Section):
    """The stretches of the recording that are fitted (default: all of it) and the bins of its means."""

    windows_s: list[tuple[float, float]] | None = None
    bin_width_s: Annotated[float, Field(gt=0)] = 0.5

    @model_validator(mode="after")
    def _windows_have_an_inside(self) -> FitConfig:
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
    def _bounds_are_the_right_way_up(self) -> NoiseConfig:
        for name, bounds in self:
            if bounds is not None and not 0 < bounds[0] < bounds[1]:
                found = f"[{bounds[0]:g}, {bounds[1]:g}]"
                raise ValueError(f"{name}: found {found}; expected lower below upper, both above zero")
        return self


class SampleConfig(Section):
    """Independent ensembles of walkers, and when to stop."""

    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    walkers: Annotated[int, Field(ge=4, le=100_000)] = 40
    effective_samples: Positive = 5000
    max_steps: Annotated[int, Field(ge=500)] = 20000  # the first 300 only lead to the posterior


class CheckConfig(Section):
    """Posterior draws that the full model runs again, and how often they may join the design."""

    draws: Annotated[int, Field(ge=0, le=100_000)] = 24
    rounds: Annotated[int, Field(ge=0, le=1000)] = 2

    @model_validator(mode="after")
    def _one_or_two_say_nothing(self) -> CheckConfig:
        if 0 < self.draws < FEWEST_CHECKED:
            raise ValueError(f"draws: found {self.draws}; expected 0 for none, or at least {FEWEST_CHECKED}")
        return self


class MapConfig(Section):
    """Starts of the search for the most probable point, and evaluations that each may spend."""

    starts: Annotated[int, Field(gt=0, le=100_000)] = 8
    evaluations: Positive = 20000


class SobolConfig(Section):
    """Samples a matrix of the pick-freeze estimate on the Gaussian process."""

    samples: Annotated[int, Field(gt=0, le=2**20)] = 2048


class Config(Section):
    """A whole run. `load_config` makes it from a file."""

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
    def _coarse_is_coarser(self) -> Config:
        coarse, model = self.design.coarse, self.model
        below = 0 if coarse == "reduced" else coarse
        if below is not None and (model.mesh != "bricks" or below >= model.refinement):
            found = (
                f"{coarse} with model.observation {model.observation!r}, model.mesh {model.mesh!r}, "
                f"model.refinement {model.refinement}"
            )
            expected = "refinement 1 or more" if coarse == "reduced" else "a higher refinement"
            raise ValueError(f"design.coarse: found {found}; expected bricks of {expected}")
        if model.forward is not None and (coarse is not None or self.surrogate.file is not None):
            key = "design.coarse" if coarse is not None else "surrogate.file"
            raise ValueError(f"{key}: found one with model.forward; expected none: it is the full model's")
        return self

    @property
    def sha256(self) -> str:
        """Hash of all that can change a result; who makes the runs cannot."""
        plain = self.model_dump(mode="json", exclude=WHO_RUNS)
        for name, usual in (("device", DeviceConfig()), ("tissue", TissueConfig())):
            if getattr(self, name) == usual:  # hashes are older than these sections
                del plain[name]
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

    def geometry(self, where: object = "configuration") -> StatedGeometry:
        """Device and tissue of the sections. Raises InputError, of `where`, for what cannot be.

        An uncertain length moves nodes, so it needs the generator's bricks.
        """
        stated = stated_geometry(self.device, self.tissue, where)
        if stated.sd_m and (self.model.observation, self.model.mesh) != ("reaction", "bricks"):
            name, model = next(iter(stated.sd_m)), self.model
            own = model.observation if model.observation != "reaction" else model.mesh
            found = f"a mean and an sd, with {own!r} in [model]"
            expected = "a number, or observation 'reaction' on mesh 'bricks'"
            raise InputError(f"{where}: tissue.{name}m", found, expected)
        if self.model.observation != "reaction" and stated != StatedGeometry(Geometry()):
            section = "device" if self.device != DeviceConfig() else "tissue"
            found = f"another than the article's, with observation {self.model.observation!r}"
            raise InputError(f"{where}: {section}", found, "observation 'reaction' with it")
        return stated


def load_config(path: Path | str) -> Config:
    """Reads and checks a configuration; ``name`` defaults to the file's name without its suffix.

    Raises InputError for a file that is absent or not TOML, an unknown key, a value of the wrong kind
    or range, bounds upside down.
    """
    path = Path(path)
    plain = read_toml(path, EXPECTED)
    plain.setdefault("name", path.stem)
    return config_of(plain, path)


def config_of(plain: Mapping[str, Any], where: Path | str) -> Config:
    """Checks a configuration's sections. Raises InputError as `load_config`, saying that it is of `where`."""
    config = checked(Config, plain, where, EXPECTED)
    parameter_space(config, where)
    config.geometry(where)
    return config


def to_toml(config: Config) -> str:
    """A configuration as a file that `load_config` reads back to the same; all keys, defaults too."""
    return "\n".join(_table(config.model_dump(mode="json", exclude_none=True))) + "\n"


def _table(plain: Mapping[str, Any], name: str = "") -> list[str]:
    # A scalar or a list of scalars is written alike in JSON and TOML.
    lines = [f"{key} = {json.dumps(value)}" for key, value in plain.items() if not isinstance(value, dict)]
    for key, value in plain.items():
        if isinstance(value, dict):
            path = f"{name}.{key}" if name else key
            lines += [f"[{path}]", *_table(value, path)]
    return lines


def parameter_space(config: Config, where: object = "configuration") -> ParameterSpace:
    """The prior box: the defaults with the configuration's changes, or that of a forward model of one's own.

    Uncertain lengths of the tissue follow the defaults. Raises InputError for an unknown parameter, bounds
    upside down, a log prior that reaches zero, lengths that cannot be, or correlations that cannot be.
    """
    space = _own_space(config, where) if config.model.forward is not None else _changed_space(config, where)
    stated = tuple(
        Correlation(one, other, value)
        for one, given in config.parameters.items()
        for other, value in given.correlations.items()
    )
    try:
        return replace(space, correlations=stated)
    except InputError as error:
        raise InputError(f"{where}: {error.where}", error.found, error.expected) from None


def _changed_space(config: Config, where: object) -> ParameterSpace:
    """The default one and uncertain lengths, with the configuration's changes."""
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
    """Raises InputError for bounds of lengths between which some cannot be meshed."""
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


def _own_space(config: Config, where: object) -> ParameterSpace:
    """Those of the table, or the default ones; without the law by which the full model's forces scale."""
    if not config.parameters:
        return ParameterSpace(tuple(replace(p, stress_power=0) for p in default_space().parameters))
    own = []
    for name, given in config.parameters.items():
        for key in ("lower", "upper"):
            if getattr(given, key) is None:
                at = f"{where}: parameters.{name}.{key}"
                raise InputError(at, "nothing", "a bound, with model.forward")
        blank = Parameter(name, given.unit or "", 0.0, 0.0, "uniform")
        own.append(_overridden(blank, given, where))
    return ParameterSpace(tuple(own))


def _overridden(default: Parameter, change: PriorConfig | None, where: object) -> Parameter:
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
            at, f"a prior about {centre:g} {default.unit}", f"{lower:g} to {upper:g}, its bounds"
        )
    return replace(
        default, lower=lower, upper=upper, prior=prior, source=change.source, centre=centre, spread=spread
    )
