"""A configuration for somebody's own recording, with comments on what was found and what can be set."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin.config import Config, DesignConfig, RecordingConfig
from bayeskin.design import default_space
from bayeskin.device import DeviceFile, StatedGeometry, device_lines, load_device_file, stated_geometry
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.inference import NoisePriors
from bayeskin.json_files import plain
from bayeskin.recordings import describe, describe_json, phase_noise, read_recording, segment
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.region import protocol_outside
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, Parameter
from bayeskin.workflow.recording import pad_motion
from bayeskin.workflow.reducing import find_reduced
from bayeskin.workflow.shipping import shipped_for

_SECONDS_A_RUN = (4, 15)  # of one core, on the default mesh
_REDUCED_SECONDS_A_RUN = (0.1, 0.4)
_SHIPPED_KNOWS = (
    "# Another model, bin width or wider bounds need another surrogate: take [surrogate] above out.",
)

_NOISE = NoisePriors()
_UNSTATED = {"windows_s": [[0.0, 60.0]], "sd_n": _NOISE.sd_n, "tau_s": _NOISE.tau_s, "nu": _NOISE.nu}
# section, what it is about, its keys and what they are
_SECTIONS: Sequence[tuple[str, str, Mapping[str, str]]] = (
    ("model", "the force that the model reports, and its mesh", {
        "observation": '"reaction" on the pad, or "article": what the article\'s code integrates',
        "mesh": "or a gmsh file",
        "refinement": "of the bricks: 0 coarse and quick, 2 fine and slow",
    }),
    ("fit", "what is fitted", {
        "windows_s": "for example; without it the whole recording",
        "bin_width_s": "of the force's means",
    }),
    ("noise", "bounds of its log-uniform priors", {
        "sd_n": "N, of each kind of phase",
        "tau_s": "s, correlation time",
        "nu": "tail index: small is heavy",
    }),
    ("map", "the search for the most probable point", {
        "starts": "by three kinds of search in turn",
        "evaluations": "of each start, at most",
    }),
    ("sample", "when the posterior has been sampled enough", {
        "ensembles": "that share nothing but the posterior",
        "walkers": "in each",
        "effective_samples": "of the parameter that has fewest",
        "max_steps": "it stops there, trusted or not",
    }),
    ("check", "the full model at draws of the posterior", {
        "draws": "0 for none; each is a full run",
        "rounds": "in which they may join the design, where the surrogate is off",
    }),
    ("sobol", "indices over the prior", {"samples": "more make their intervals narrower"}),
)  # fmt: skip


def new_config(file: Path, out: Path | None = None, device: Path | None = None) -> dict[str, Any]:
    """Writes a configuration that fits `file`, by default beside it, and says what was found in it.

    It takes a shipped surrogate where one knows the recording's protocol and device, else a design of its
    own, by the reduced model where the device has one. The sections of the file `device` are written into it.
    Raises InputError, with nothing written, for no recording of a test, a device that cannot be, or an `out`
    that is there already.
    """
    stated = None if device is None else load_device_file(device)
    recording = read_recording(file)
    out = out or file.with_suffix(".toml")
    if out.suffix != ".toml":
        raise InputError(f"-o {out}", f"ending {out.suffix!r}", "ending .toml")
    if out.exists():
        raise InputError(f"-o {out}", "a file that is there already", "a name that is free")
    phases = segment(recording)
    noise = phase_noise(recording, phases)
    found = describe(recording, phases, noise)
    motion, geometry = pad_motion("reaction", recording, phases, "idealised"), _geometry(stated)
    surrogate = None if geometry.sd_m else shipped_for(motion, geometry.geometry)
    reduced = None if surrogate else _reduced_for(motion, geometry.geometry, out)
    way, section = _way(surrogate, reduced)
    reference = Path(os.path.relpath(file.resolve(), out.resolve().parent)).as_posix()
    text = _configuration(_name(out), reference, found, section, surrogate is not None, stated)
    out.parent.mkdir(parents=True, exist_ok=True)
    with open(out, "x", encoding="utf-8") as handle:
        handle.write(text)
    facts = describe_json(recording, phases, noise)
    answer = {"ok": True, "out": out, "surrogate": surrogate.name if surrogate else None, **facts}
    return plain({**answer, "text": f"{found}\n\nwritten to {out}, with {way}\nnext: bayeskin run {out}"})


def new_demo(out: Path | None = None) -> dict[str, Any]:
    """Puts the demo's configuration, by default demo.toml, and its recording beside it into a folder.

    Raises InputError, with nothing written, where one of them is there already.
    """
    out = out or Path("demo.toml")
    recording = out.with_name("demo-recording.h5")  # demo.h5 is the surrogate's name
    if out.suffix != ".toml":
        raise InputError(f"-o {out}", f"ending {out.suffix!r}", "ending .toml")
    for file in (out, recording):
        if file.exists():
            raise InputError(file, "a file that is there already", "a folder without one")
    text = shipped("runs/demo.toml").read_text(encoding="utf-8")
    out.parent.mkdir(parents=True, exist_ok=True)
    recording.write_bytes(shipped("data/demo.h5").read_bytes())
    out.write_text(text.replace('"../data/demo.h5"', '"demo-recording.h5"'), encoding="utf-8")
    return plain({"ok": True, "out": out, "text": f"written to {out}\nnext: bayeskin run {out}"})


def _geometry(stated: DeviceFile | None) -> StatedGeometry:
    """The geometry of a device, by default the article's."""
    file = stated or DeviceFile()
    return stated_geometry(file.device, file.tissue, "device")


def _reduced_for(motion: PadMotion, geometry: Geometry, out: Path) -> Path | None:
    """The file of a reduced model that a run of the configuration `out` can make its design with."""
    file = find_reduced(geometry, [out])
    known = file is not None and not protocol_outside(load_reduced(file).trained.protocols, motion)
    return file if known else None


def _way(surrogate: Path | None, reduced: Path | None) -> tuple[str, list[str]]:
    """Returns how a run comes by its surrogate, in words and as a section."""
    if surrogate is not None:
        return f"the shipped surrogate {surrogate.name}", _surrogate(surrogate.name)
    if reduced is not None:
        return f"a design of the reduced model {reduced.name}", _reduced_design(reduced.name)
    return "a design of full runs of its own", _full_design()


def _name(out: Path) -> str:
    """A run's name from a file's: what a configuration does not allow becomes a hyphen."""
    return re.sub(r"^[^A-Za-z0-9]+", "", re.sub(r"[^A-Za-z0-9._-]", "-", out.stem)) or "run"


def _configuration(
    name: str, reference: str, found: str, section: list[str], ready: bool, stated: DeviceFile | None
) -> str:
    config = Config(name=name, recording=RecordingConfig(file=reference))
    parts = [
        [f"name = {_quoted(name)}", f"seed = {config.seed}"],
        _commented(found),
        [
            "[recording]",
            f"file = {_quoted(reference)}  # relative to this file",
            f'# protocol = {_quoted(config.recording.protocol)}  # or "recorded": as it was, dearer',
        ],
        *([device_lines(stated.device, stated.tissue)] if stated else []),
        section,
        [
            "# What can be set besides, with its default. To change one, take the # from its line and from",
            "# that of the section above it.",
            *(_SHIPPED_KNOWS if ready else ()),
            *([] if stated else _commented_device(config)),
            *_optional(config),
        ],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _commented(text: str) -> list[str]:
    """Lines as TOML allows them in comments: nothing that cannot be printed."""
    clean = ("".join(c if c.isprintable() else " " for c in line) for line in text.splitlines())
    return ["# Found in the recording:", *(f"#   {line}".rstrip() for line in clean)]


def _surrogate(file: str) -> list[str]:
    return [
        "# A shipped surrogate knows this recording's protocol, so no full runs are needed before sampling.",
        "[surrogate]",
        f"file = {_quoted(file)}",
    ]


def _full_design() -> list[str]:
    design = DesignConfig()
    runs, (quick, slow) = _runs(design), _SECONDS_A_RUN
    low, high = (seconds * runs / (60 * design.workers) for seconds in _SECONDS_A_RUN)
    return [
        "# No shipped surrogate knows this protocol on this device, so the full model is run first, here:",
        f"# {runs} runs of some {quick} to {slow} s each, {low:.0f} to {high:.0f} minutes with "
        f"{design.workers} workers.",
        "# `bayeskin reduce` with this file makes a reduced model of the device once, from hundreds of runs;",
        '# with it, coarse = "reduced" takes minutes, if the pads open no further than it knows.',
        "[design]",
        *_waves(design),
    ]


def _reduced_design(file: str) -> list[str]:
    design = DesignConfig.model_validate({"coarse": "reduced"})
    full = design.fine_points + design.fine_held_out
    low, high = (
        (seconds * full + quick * _runs(design)) / (60 * design.workers)
        for seconds, quick in zip(_SECONDS_A_RUN, _REDUCED_SECONDS_A_RUN, strict=True)
    )
    return [
        "# No shipped surrogate knows this protocol on this device, so runs are made first, here:",
        f"# {_runs(design)} by the reduced model {file}, but for skins that fold,",
        f"# and {full} by the full model, which correct them: {low:.0f} to {high:.0f} minutes with "
        f"{design.workers} workers.",
        "[design]",
        'coarse = "reduced"  # the model that makes the waves',
        f"fine_points = {design.fine_points}  # full runs that correct it",
        f"fine_held_out = {design.fine_held_out}  # full runs that measure the surrogate's error",
        *_waves(design),
    ]


def _runs(design: DesignConfig) -> int:
    return sum(design.points) + len(design.points) * design.held_out


def _waves(design: DesignConfig) -> list[str]:
    return [
        f"points = {list(design.points)}  # training runs of each wave",
        f"held_out = {design.held_out}  # of each wave, to measure the surrogate's error",
        f"workers = {design.workers}  # processes",
    ]


def _optional(config: Config) -> list[str]:
    lines = []
    for section, what, keys in _SECTIONS:
        stated = {key: getattr(getattr(config, section), key) for key in keys}
        lines += ["", f"# [{section}]  # {what}"]
        lines += [f"# {key} = {_toml(value, key)}  # {keys[key]}" for key, value in stated.items()]
    for parameter in default_space().parameters:
        lines += ["", *_prior(parameter)]
    return lines


def _commented_device(config: Config) -> list[str]:
    return ["", *(f"# {line}" if line else "" for line in device_lines(config.device, config.tissue))]


def _toml(value: object, key: str) -> str:
    """A default as TOML has it; where none is stated, an example or what stands for it."""
    return json.dumps(_UNSTATED[key] if value is None else value)


def _prior(parameter: Parameter) -> list[str]:
    return [
        f"# [parameters.{parameter.name}]  # {parameter.description}, {parameter.unit}",
        f"# lower = {parameter.lower!r}",
        f"# upper = {parameter.upper!r}",
        f"# prior = {_quoted(parameter.prior)}",
    ]
