"""The sections of a run's configuration, besides `device` and `tissue`.

Units are part of the names (``bin_width_s``). The bounds of a parameter are in the SI unit of the parameter,
as in `bayeskin.design.default_space`.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from bayeskin.config.sections import Section
from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec
from bayeskin.types import Observation

FEWEST_CHECKED = 8  # importance weights of fewer draws carry almost no information
# The upper bounds catch typing errors, which would exhaust the memory. No real computation comes near them.
Positive = Annotated[int, Field(gt=0, le=10**9)]
Runs = Annotated[int, Field(gt=0, le=100_000)]  # runs of the full model
Refinement = Annotated[int, Field(ge=0, le=6)]


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
    refinement: Refinement = 1  # fineness of the bricks at the pads' edges; 0 gives 80 bricks
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
            problem = f"{self.observation!r} is given with{'out' * (self.forward is None)} model.forward"
            raise InputError("observation", problem, "it must be 'own' with model.forward, and only then")
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
            problem = (
                f"a {self.prior or 'default'} prior is given with {', '.join(sorted(given)) or 'no number'}"
            )
            needs = f"it needs {' and '.join(sorted(needed))}"
            remedy = needs if needed else "only a normal or log-normal prior has such numbers"
            raise InputError("prior", problem, remedy)
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
    """The windows of the recording that are fitted (default: all of it), and the width of the bins.

    shared : what several recordings share, although each usually has its own: "p_init", "noise", or names of
        mechanisms of the instrument
    """

    windows_s: list[tuple[float, float]] | None = None
    bin_width_s: Annotated[float, Field(gt=0)] = 0.5
    shared: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _windows_start_before_they_end(self) -> FitConfig:
        """Refuses an empty list of windows, and a window that does not start before it ends."""
        if self.windows_s is not None and not self.windows_s:
            raise InputError("windows_s", "the list is empty", "it needs at least one window [start, end]")
        for start, end in self.windows_s or ():
            if not start < end:
                raise InputError(
                    "windows_s",
                    f"the window [{start:g}, {end:g}] does not start before it ends",
                    "write it as [start, end]",
                )
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
                raise InputError(
                    name,
                    f"the bounds are [{bounds[0]:g}, {bounds[1]:g}]",
                    "the lower bound must be below the upper, and both above zero",
                )
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
            raise InputError(
                "draws",
                f"{self.draws} draws are too few",
                f"use 0 for no check, or at least {FEWEST_CHECKED}",
            )
        return self


class MapConfig(Section):
    """The number of starts of the search for the most probable point, and of evaluations of each start."""

    starts: Annotated[int, Field(gt=0, le=100_000)] = 8
    evaluations: Positive = 20000


class SobolConfig(Section):
    """The number of samples in each matrix of the pick-freeze estimate, on the Gaussian process."""

    samples: Annotated[int, Field(gt=0, le=2**20)] = 2048
