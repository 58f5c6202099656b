"""The configuration of a whole run; every key has a default except the file of the recording."""

from __future__ import annotations

import hashlib
import json
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import Field, model_validator

from bayeskin.config.device import DeviceConfig, StatedGeometry, TissueConfig, stated_geometry
from bayeskin.config.run_sections import (
    CheckConfig,
    DesignConfig,
    FitConfig,
    MapConfig,
    ModelConfig,
    NoiseConfig,
    PriorConfig,
    RecordingConfig,
    SampleConfig,
    SlurmConfig,
    SobolConfig,
    SurrogateConfig,
)
from bayeskin.config.sections import Section
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry

# These keys say where runs are made, so no result depends on them.
WHO_RUNS: Any = {"design": {"workers", "scheduler"}, "slurm": True}


class Config(Section):
    """The configuration of a whole run, which `load_config` reads from a file.

    It has either one `recording`, or several `recordings` of one skin, which share the skin's parameters.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    recording: RecordingConfig | None = None
    recordings: tuple[RecordingConfig, ...] = ()
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
    def _one_recording_or_several(self) -> Config:
        """Refuses a configuration without a recording, and one that has both forms."""
        remedy = "write [recording], or two or more [[recordings]]"
        if self.recording is None and not self.recordings:
            raise InputError("recording", "there is no recording", remedy)
        if self.recording is not None and self.recordings:
            raise InputError("recordings", "[recording] is there too", remedy)
        if len(self.recordings) == 1:
            raise InputError("recordings", "there is a single recording", remedy)
        stems = [PurePath(recording.file).stem for recording in self.recordings]
        twice = next((stem for stem in stems if stems.count(stem) > 1), None)
        if twice is not None:
            raise InputError(
                "recordings", f"{twice!r} is the name of two files", "each file needs a name of its own"
            )
        if self.recordings and self.fit.windows_s is not None:
            raise InputError(
                "fit.windows_s",
                "a configuration of several recordings cannot have windows",
                "leave out this key",
            )
        if self.recordings and self.model.spec().formulation.fixed_discretisation:
            raise InputError(
                "model.observation",
                f"{self.model.observation!r} cannot describe several recordings",
                "it must be 'reaction'",
            )
        if self.recordings and self.surrogate.file is not None:
            raise InputError(
                "surrogate.file",
                "a configuration of several recordings cannot use the file of a surrogate",
                "leave out this key",
            )
        return self

    @property
    def each_recording(self) -> tuple[RecordingConfig, ...]:
        """Returns the recordings, in order."""
        return self.recordings or ((self.recording,) if self.recording is not None else ())

    def only_recording(self, where: object = "configuration") -> RecordingConfig:
        """Returns the recording. Raises InputError, which names `where`, where there are several."""
        if self.recordings:
            raise InputError(
                f"{where}: recordings",
                f"there are {len(self.recordings)} recordings",
                "this command needs a single recording",
            )
        return self.each_recording[0]

    @model_validator(mode="after")
    def _coarse_model_is_coarser(self) -> Config:
        """Refuses a coarse model that is not coarser than the model itself."""
        coarse, model = self.design.coarse, self.model
        below = 0 if coarse == "reduced" else coarse
        if below is not None and (model.mesh != "bricks" or below >= model.refinement):
            problem = (
                f"it is {coarse!r} with model.observation {model.observation!r}, model.mesh {model.mesh!r}, "
                f"model.refinement {model.refinement}"
            )
            needed = "refinement 1 or more" if coarse == "reduced" else "a higher refinement"
            raise InputError("design.coarse", problem, f"the model must have bricks with {needed}")
        return self

    @model_validator(mode="after")
    def _forward_model_has_no_coarse_model(self) -> Config:
        """Refuses a coarse model where a forward model of the user's own replaces the full model."""
        if self.model.forward is not None and self.design.coarse is not None:
            raise InputError(
                "design.coarse",
                "it concerns the full model, which model.forward replaces",
                "leave out this key",
            )
        return self

    @property
    def sha256(self) -> str:
        """Returns the hash of all keys that can change a result; where runs are made is left out."""
        plain = self.model_dump(mode="json", exclude=WHO_RUNS)
        for name, default in (("device", DeviceConfig()), ("tissue", TissueConfig())):
            if getattr(self, name) == default:  # keeps hashes from before these sections existed
                del plain[name]
        if not self.recordings:
            del plain["recordings"]
        if not self.fit.shared:
            del plain["fit"]["shared"]
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
            problem = f"{conflict!r} in [model] does not allow a mean and an sd"
            raise InputError(
                f"{where}: tissue.{name}m",
                problem,
                "give a number, or use observation 'reaction' on mesh 'bricks'",
            )
        if not any_device and stated != StatedGeometry(Geometry()):
            section = "device" if self.device != DeviceConfig() else "tissue"
            problem = f"it differs from the article's, which observation {model.observation!r} needs"
            raise InputError(
                f"{where}: {section}", problem, "leave out this section, or use observation 'reaction'"
            )
        return stated
