"""The recording, surrogate and mechanisms of a diagnosis, and the posteriors of sets of mechanisms."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.config import Config, DesignConfig, RecordingConfig, SurrogateConfig, parameter_space
from bayeskin.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.fit import (
    QUICK_S,
    Fit,
    instrument_noise,
    soft_on_stiff,
    surrogate_limit,
    without_swings,
)
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.refuted import refuted
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline import recording
from bayeskin.pipeline.effects import effects_of
from bayeskin.pipeline.engine import Reporter, Run, open_run
from bayeskin.pipeline.model import model_error, model_spec
from bayeskin.pipeline.shipping import shipped_for
from bayeskin.pipeline.training import base_surrogate
from bayeskin.recordings import analyse, bin_recording, jumps_of, read_recording, segment
from bayeskin.surrogates import Effect, effects_among, with_effects
from bayeskin.types import BinnedForce, Jumps, PadMotion, ParameterSpace, Recording, Surrogate


@dataclass(frozen=True)
class Workbench:
    """All that a search needs of a run: its bins and protocol, the base's surrogate, what is known.

    jumps : what the recording's samples allow its force to jump by
    """

    run: Run
    binned: BinnedForce
    jumps: Jumps
    motion: PadMotion
    base: Surrogate
    effects: tuple[Effect, ...]
    known: Mapping[str, Mechanism]

    @cached_property
    def spec(self) -> ModelSpec:
        """The full model."""
        return model_spec(self.run)

    @property
    def learnt(self) -> frozenset[str]:
        """Mechanisms of which the surrogate knows what they do, with an error."""
        return frozenset(name for effect in self.effects for name in effect.mechanisms)

    def refuted(self, found: Fit) -> list[str]:
        """Mechanisms of a fit that the samples it is of speak against."""
        return refuted(found, self.known, self.motion, self.jumps)

    def surrogate(self, names: Sequence[str]) -> Surrogate:
        """Of the full model on its mesh, with a set of mechanisms."""
        parts = effects_among(self.effects, names)
        skin: Surrogate = with_effects(self.base, parts)  # type: ignore[arg-type]
        learnt = {name for effect in parts for name in effect.mechanisms}
        others = (self.known[name] for name in names if name not in learnt)
        instrument = tuple(mechanism for mechanism in others if isinstance(mechanism.act, Instrument))
        return ObservedSurrogate(skin, instrument, self.motion) if instrument else skin

    def posterior(self, until_s: float | None, names: Sequence[str]) -> LogPosterior:
        """The posterior with a set of mechanisms, fitted up to a time (None: to the end)."""
        asked = {name: bounds for name, bounds in self.run.config.noise if bounds is not None}
        windows = None if until_s is None else ((0.0, until_s),)
        seen, surrogate = _up_to(self.binned, until_s), self.surrogate(names)
        noise, material = replace(instrument_noise(seen), **asked), self._priors(surrogate.space)
        return LogPosterior(
            surrogate, self.binned, windows, noise, material, surrogate_limit(seen), soft_on_stiff,
            model_error(self.spec, self.motion, self.binned.edges_s),
        )  # fmt: skip

    def _priors(self, space: ParameterSpace) -> ParameterSpace:
        """A surrogate's parameters with the configuration's priors where it has them."""
        asked = parameter_space(self.run.config)
        own = {p.name: p for p in asked.parameters}
        return ParameterSpace(tuple(own.get(p.name, p) for p in space.parameters), asked.correlations)


def _up_to(binned: BinnedForce, until_s: float | None) -> BinnedForce:
    """Bins with nothing in those that end after a time (None: as they are)."""
    if until_s is None:
        return binned
    seen = binned.edges_s[1:] <= until_s
    force_n, variance_n2 = (np.where(seen, x, np.nan) for x in (binned.force_n, binned.variance_n2))
    return replace(binned, force_n=force_n, variance_n2=variance_n2)


def opened(source: Path, reporter: Reporter, device: Path | None = None) -> Run:
    """A configuration's run, or that of a recording by itself beside it, made with the device of a file.

    A recording by itself takes a shipped surrogate where one knows its protocol, else the reduced model of
    its device. Raises InputError for bad input, for a device beside a configuration, which states its own,
    and for an uncertain length in one whose design the reduced model does not make.
    """
    if source.suffix == ".toml":
        if device is not None:
            raise InputError(
                "--device", f"{device} beside a configuration", "the device in [device] and [tissue]"
            )
        run = open_run(source, reporter)
        if run.config.design.coarse != "reduced":
            run.config.refuse_uncertain(source, "diagnose")
        return run
    found = read_recording(source)
    sections: dict[str, Any] = {}
    shipped = None
    if device is not None:
        sections = dict(load_device_file(device))
    else:
        shipped = shipped_for(recording.pad_motion("reaction", found, segment(found), "idealised"))
    if shipped is not None:
        sections["surrogate"] = SurrogateConfig(file=shipped.name)
    else:
        sections["design"] = DesignConfig(coarse="reduced", workers=2)
    config = Config(
        name=re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{source.stem}"),
        recording=RecordingConfig(file=source.name), **sections,
    )  # fmt: skip
    return Run(config, source, source.resolve().with_name(f"{source.stem}-diagnosis"), reporter)


def calm_bins(folder: Path) -> tuple[BinnedForce, Jumps, PadMotion]:
    """Returns bins with their quick noise alone, the jumps that the samples allow, and the protocol.

    All are of the stage `recording`, from its folder.
    """
    samples = storage.load(folder / "recording.h5", Recording)
    binned = storage.load(folder / "binned.h5", BinnedForce)
    quick = bin_recording(samples, binned.phases, binned.edges_s, analyse(samples, binned.phases, QUICK_S))
    motion = storage.load(folder / "motion.h5", PadMotion)
    return without_swings(binned, quick.variance_n2), jumps_of(samples, binned.phases), motion


def workbench(run: Run) -> Workbench:
    """Returns the workbench of a run whose stages up to `train` are done."""
    binned, jumps, motion = calm_bins(run.folder / "recording")
    effects = effects_of(run) if run.config.model.observation == "reaction" else []
    learnt = {effect.mechanisms[0] for effect in effects if len(effect.mechanisms) == 1}
    known = {n: m for n, m in catalogue().items() if isinstance(m.act, Instrument) or n in learnt}
    known = {name: m for name, m in known.items() if set(m.needs) <= set(known)}
    return Workbench(run, binned, jumps, motion, base_surrogate(run), tuple(effects), known)
