"""Writes the text of a configuration, whose comments describe the recording and all that can be set."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.config import Config, DesignConfig, config_of
from bayeskin.config.device import DeviceFile, device_lines
from bayeskin.design import default_space
from bayeskin.inference import NoisePriors
from bayeskin.types import Parameter

_SECONDS_A_RUN = (4, 15)  # range of one full run on one core, on the default mesh
_REDUCED_SECONDS_A_RUN = (0.1, 0.4)
_SHIPPED_KNOWS = (
    "# The shipped surrogate was trained for this model, this bin width and these bounds. For another model",
    "# or bin width, or for wider bounds, remove [surrogate] above. The run then trains its own surrogate.",
)

_NOISE = NoisePriors()
_EXAMPLES = {
    "windows_s": [[0.0, 60.0]], "sd_n": _NOISE.sd_n, "tau_s": _NOISE.tau_s, "nu": _NOISE.nu,
    "marker_sd_m": _NOISE.marker_sd_m,
}  # fmt: skip
# Each entry has the name of a section, its subject, and its keys with their meaning.
_SECTIONS: Sequence[tuple[str, str, Mapping[str, str]]] = (
    ("model", "the force that the model reports, and the mesh", {
        "observation": '"reaction": force on the pad; "article": force as the article\'s code computes it',
        "mesh": '"bricks" or the name of a gmsh file',
        "refinement": "refinement of the bricks: 0 is coarse and fast, 2 is fine and slow",
    }),
    ("fit", "the part of the recording that is fitted", {
        "windows_s": "an example, in s; without this key, the whole recording is fitted",
        "bin_width_s": "width of the bins, in s; the mean force of each bin is fitted",
    }),
    ("noise", "bounds of the log-uniform priors of the noise", {
        "sd_n": "standard deviation, in N, of each kind of phase",
        "tau_s": "correlation time, in s",
        "nu": "degrees of freedom of the Student-t noise; small values mean heavy tails",
        "marker_sd_m": "standard deviation, in m, of the displacements of markers, if there are any",
    }),
    ("map", "the search for the most probable point", {
        "starts": "number of starting points; three kinds of search take turns",
        "evaluations": "largest number of evaluations for each start",
    }),
    ("sample", "the sampler of the posterior, and when it stops", {
        "ensembles": "number of independent ensembles of walkers",
        "walkers": "number of walkers in each ensemble",
        "effective_samples": "sampling stops when every parameter has this number of effective samples",
        "max_steps": "sampling stops after this number of steps, even if the result is not trusted",
    }),
    ("check", "the check of the posterior with the full model", {
        "draws": "number of posterior draws at which the full model runs; 0 for no check",
        "rounds": "how often these runs may be added to the design, if the surrogate is not accurate",
    }),
    ("sobol", "Sobol' indices over the prior", {"samples": "more samples give narrower intervals"}),
)  # fmt: skip


def configuration_text(
    name: str, references: Sequence[str], description: str, section: list[str], ready: bool,
    stated: DeviceFile | None, markers: str | None = None,
) -> str:  # fmt: skip
    """Returns the text of the configuration. Raises InputError for two recordings of one name.

    markers : file of the tracks of a single recording
    """
    given = [{"file": reference} for reference in references]
    if markers is not None:
        given[0]["markers"] = markers
    sections: dict[str, Any] = {"recording": given[0]} if len(given) == 1 else {"recordings": given}
    config = config_of({"name": name, **sections}, "recordings")
    table = "[recording]" if len(given) == 1 else "[[recordings]]"
    parts = [
        [f"name = {_quoted(name)}", f"seed = {config.seed}"],
        _description_lines(description),
        *(
            [
                table,
                f"file = {_quoted(recording.file)}  # path relative to this file",
                f'# protocol = {_quoted(recording.protocol)}  # or "recorded": as measured, but slower',
                *(
                    [f"markers = {_quoted(recording.markers)}  # tracks of points"]
                    if recording.markers
                    else []
                ),
            ]
            for recording in config.each_recording
        ),
        *([device_lines(stated.device, stated.tissue)] if stated else []),
        section,
        [
            "# All other settings, with their defaults. To change one, remove the # from its line and from",
            "# the line of its [section].",
            *(_SHIPPED_KNOWS if ready else ()),
            *([] if stated else _commented_device(config)),
            *_optional_lines(config, stated_in=section),
        ],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _quoted(text: str) -> str:
    """Returns a text as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def _description_lines(text: str) -> list[str]:
    """Returns the description of the recording as TOML comments; unprintable characters become blanks."""
    clean = ("".join(c if c.isprintable() else " " for c in line) for line in text.splitlines())
    return ["# Contents of the recording:", *(f"#   {line}".rstrip() for line in clean)]


def surrogate_section(file: str) -> list[str]:
    """Returns the section of a shipped surrogate."""
    return [
        "# A shipped surrogate was trained for this protocol, so no full runs are needed before sampling.",
        "[surrogate]",
        f"file = {_quoted(file)}",
    ]


def wide_bins_section(width_s: float) -> list[str]:
    """Returns the section of the fit for a recording whose samples are far apart."""
    _, _, keys = next(section for section in _SECTIONS if section[0] == "fit")
    windows = f"# windows_s = {_default_as_toml(None, 'windows_s')}  # {keys['windows_s']}"
    return ["[fit]", f"bin_width_s = {width_s:g}  # {keys['bin_width_s']}; it needs two samples", windows]


def full_design_section() -> list[str]:
    """Returns the section of a design by the full model, with its expected duration."""
    design = DesignConfig()
    runs, (quick, slow) = _runs(design), _SECONDS_A_RUN
    low, high = (seconds * runs / (60 * design.workers) for seconds in _SECONDS_A_RUN)
    return [
        "# No shipped surrogate was trained for this protocol and this device, so the full model runs first:",
        f"# {runs} runs of about {quick} to {slow} s each, {low:.0f} to {high:.0f} minutes with "
        f"{design.workers} workers.",
        "# `bayeskin reduce` with this file builds a reduced model of the device from hundreds of full runs.",
        '# A design with coarse = "reduced" then takes minutes if the pads open no further than in training.',
        "[design]",
        *_wave_lines(design),
    ]


def reduced_design_section(file: str) -> list[str]:
    """Returns the section of a design by the reduced model, with its expected duration."""
    design = DesignConfig.model_validate({"coarse": "reduced"})
    full = design.fine_points + design.fine_held_out
    low, high = (
        (seconds * full + quick * _runs(design)) / (60 * design.workers)
        for seconds, quick in zip(_SECONDS_A_RUN, _REDUCED_SECONDS_A_RUN, strict=True)
    )
    return [
        "# No shipped surrogate was trained for this protocol and this device, so these runs come first:",
        f"# {_runs(design)} runs of the reduced model {file}, except where the skin folds,",
        f"# and {full} runs of the full model, which correct them: {low:.0f} to {high:.0f} minutes with "
        f"{design.workers} workers.",
        "[design]",
        'coarse = "reduced"  # the model that runs the points of the waves',
        f"fine_points = {design.fine_points}  # full runs that correct the reduced model",
        f"fine_held_out = {design.fine_held_out}  # further full runs, which measure the surrogate's error",
        *_wave_lines(design),
    ]


def _runs(design: DesignConfig) -> int:
    """Returns the number of runs of a design's waves."""
    return sum(design.points) + len(design.points) * design.held_out


def _wave_lines(design: DesignConfig) -> list[str]:
    """Returns the lines of a design's waves and workers."""
    return [
        f"points = {list(design.points)}  # number of training runs in each wave",
        f"held_out = {design.held_out}  # further runs in each wave, which measure the surrogate's error",
        f"workers = {design.workers}  # number of worker processes",
    ]


def _optional_lines(config: Config, stated_in: Sequence[str]) -> list[str]:
    """Returns commented lines for what can be set and has no section in `stated_in`, with the defaults."""
    lines = []
    for section, subject, keys in _SECTIONS:
        if f"[{section}]" in stated_in:
            continue
        defaults = {key: getattr(getattr(config, section), key) for key in keys}
        lines += ["", f"# [{section}]  # {subject}"]
        lines += [
            f"# {key} = {_default_as_toml(value, key)}  # {keys[key]}" for key, value in defaults.items()
        ]
    for parameter in default_space().parameters:
        lines += ["", *_prior_lines(parameter)]
    return lines


def _commented_device(config: Config) -> list[str]:
    """Returns the sections of the device and the tissue as comments."""
    return ["", *(f"# {line}" if line else "" for line in device_lines(config.device, config.tissue))]


def _default_as_toml(value: object, key: str) -> str:
    """Returns a default as TOML; where a key has no default, an example or the value that is used."""
    return json.dumps(_EXAMPLES[key] if value is None else value)


def _prior_lines(parameter: Parameter) -> list[str]:
    """Returns commented lines for the prior of a parameter."""
    return [
        f"# [parameters.{parameter.name}]  # {parameter.description}, {parameter.unit}",
        f"# lower = {parameter.lower!r}",
        f"# upper = {parameter.upper!r}",
        f"# prior = {_quoted(parameter.prior)}",
    ]
