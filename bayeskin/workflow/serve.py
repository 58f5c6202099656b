"""Offers the forward model as a UM-Bridge model: from parameters to the force over a protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.config import parameter_space
from bayeskin.errors import InputError
from bayeskin.external.model import check_own
from bayeskin.external.umbridge import Refused, Vectors, server
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.forward.observed import reported
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, laws, solved
from bayeskin.recordings import covered_s, read_recording, segment, uniform_edges
from bayeskin.shipped import shipped
from bayeskin.types import Array, PadMotion, Parameter
from bayeskin.workflow.engine import Reporter, Run, open_run
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.recording import pad_motion

NAME = "bayeskin"
KEYS = ("protocol", "edges_s", "times_s", "mechanisms")
MOST_TIMES = 1_000_000


@dataclass(frozen=True)
class Asked:
    """One request to the model: its protocol, the bins or times of the force, and the mechanisms to add.

    edges_s : the bins whose mean forces are the output, (m+1,)
    times_s : times (t,) whose forces are the output instead of the bins', or None
    """

    motion: PadMotion
    edges_s: Array
    times_s: Array | None
    mechanisms: tuple[Mechanism, ...]

    @property
    def outputs(self) -> int:
        """Returns the number of outputs."""
        return len(self.edges_s) - 1 if self.times_s is None else len(self.times_s)


@dataclass(frozen=True)
class ServedModel:
    """The model of a configuration, in the form of `bayeskin.external.umbridge.Model`.

    A client may send ``protocol`` (``time_s`` [s] and ``displacement_m`` [m] of its corners, as displacement
    between the pads), ``edges_s`` or ``times_s`` [s], and names of ``mechanisms``. The parameters of
    mechanisms follow the parameters of the base model in the one input vector. Anything that the client does
    not send is as in `usual`.
    """

    spec: ModelSpec
    parameters: tuple[Parameter, ...]
    usual: Asked
    name: str = NAME

    def input_sizes(self, config: Mapping[str, Any]) -> list[int]:
        """Returns the number of parameters, as the length of the one input vector."""
        return [len(self._names(self._request_of(config)))]

    def output_sizes(self, config: Mapping[str, Any]) -> list[int]:
        """Returns the number of forces, as the length of the one output vector."""
        return [self._request_of(config).outputs]

    def evaluate(self, inputs: Vectors, config: Mapping[str, Any]) -> Vectors:
        """Returns the forces of one run. Raises Refused for a run that fails, with its message."""
        request = self._request_of(config)
        values = dict(zip(self._names(request), inputs[0], strict=True))
        solved_names = {p.name for mechanism in solved(request.mechanisms) for p in mechanism.parameters}
        theta = {n: v for n, v in values.items() if n in solved_names or n in self._names(self.usual)}
        run = simulate(self.spec, request.motion, theta, laws=laws(request.mechanisms))
        if run.status != "ok":
            raise Refused(run.message)
        force = reported(run, request.mechanisms, values, request.motion)
        if request.times_s is not None:
            return [np.atleast_2d(force(request.times_s))[0].tolist()]
        if not request.mechanisms:  # the same means as in a design
            return [run.bin_means(request.edges_s).tolist()]
        return [bin_means(force, request.motion, request.edges_s, request.mechanisms)[0].tolist()]

    def _names(self, asked: Asked) -> list[str]:
        """Returns the names of the parameters. Raises InputError for a name that occurs twice."""
        added = [p.name for mechanism in asked.mechanisms for p in mechanism.parameters]
        names = [*(p.name for p in self.parameters), *added]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(
                "config: mechanisms",
                f"two of their parameters have the name {twice[0]}",
                "use mechanisms with parameters of different names",
            )
        return names

    def _request_of(self, config: Mapping[str, Any]) -> Asked:
        """Returns a client's config as a request. Raises InputError for a config that is wrong."""
        for key in config:
            if key not in KEYS:
                raise InputError(f"config: {key}", "this key is not known", f"use some of {', '.join(KEYS)}")
        motion, edges_s = self.usual.motion, self.usual.edges_s
        if "protocol" in config:
            motion = _protocol(config["protocol"])
            width_s = float(edges_s[1] - edges_s[0])
            edges_s = uniform_edges(float(motion.time_s[-1]), width_s)
        if "edges_s" in config:
            edges_s = _times("edges_s", config["edges_s"], motion)
        times_s = _times("times_s", config["times_s"], motion) if "times_s" in config else None
        if times_s is None and len(edges_s) < 2:
            raise InputError(
                "config: edges_s", f"the number of edges is {len(edges_s)}", "at least two are needed"
            )
        return Asked(motion, edges_s, times_s, _mechanisms(config.get("mechanisms", [])))


def open_server(
    config: Path | None, host: str, port: int, reporter: Reporter
) -> tuple[ThreadingHTTPServer, dict[str, Any]]:
    """Returns a listening server of a configuration's model (default: the demo's), and the command's answer.

    Raises InputError for wrong input, or an address that is not available.
    """
    run = open_run(config or shipped("runs/demo.toml"), reporter)
    model = _served_model(run)
    listening = server(model, host, port)
    address = f"http://{host}:{listening.server_address[1]}"
    names = [p.name for p in model.parameters]
    text = (
        f"{NAME} at {address}: {', '.join(names)} in, mean forces over {model.usual.outputs} bins out; "
        "Ctrl-C ends it"
    )
    offered = {"url": address, "model": NAME, "inputs": names, "outputs": model.usual.outputs}
    return listening, {"ok": True, **offered, "text": text}


def _served_model(run: Run) -> ServedModel:
    """Returns the model that a run's configuration serves."""
    spec, space = model_spec(run), parameter_space(run.config, run.config_path)
    if spec.forward is not None:
        check_own(spec.forward)
    only = run.config.only_recording(run.config_path)
    recording = read_recording(run.beside(only.file))
    motion = pad_motion(spec, recording, segment(recording), only.protocol)
    edges_s = uniform_edges(covered_s(recording, motion), run.config.fit.bin_width_s)
    return ServedModel(spec, space.parameters, Asked(motion, edges_s, None, ()))


def _protocol(given: Any) -> PadMotion:
    """Returns a client's protocol. Raises InputError for one that is wrong."""
    keys = {"time_s", "displacement_m"}
    if not isinstance(given, dict) or set(given) != keys:
        raise InputError(
            "config: protocol",
            f"it is {given!r:.60}",
            "it must be a table with the lists time_s and displacement_m",
        )
    time_s, displacement_m = (_numbers(f"protocol.{key}", given[key]) for key in ("time_s", "displacement_m"))
    if len(time_s) != len(displacement_m) or len(time_s) < 2:
        problem = f"it has {len(time_s)} times and {len(displacement_m)} displacements"
        raise InputError("config: protocol", problem, "both lists need the same length, at least 2")
    if time_s[0] != 0.0 or not np.all(np.diff(time_s) > 0):
        raise InputError(
            "config: protocol.time_s",
            f"the times start at {time_s[0]:g} or do not increase",
            "they must increase from 0",
        )
    return PadMotion(time_s, displacement_m)


def _times(key: str, given: Any, motion: PadMotion) -> Array:
    """Returns a client's times, which increase and lie within the protocol."""
    times_s, end_s = _numbers(key, given), float(motion.time_s[-1])
    if not len(times_s) or not np.all(np.diff(times_s) > 0):
        raise InputError(
            f"config: {key}",
            "the times do not increase",
            "at least one time is needed, and times must increase",
        )
    if times_s[0] < 0.0 or times_s[-1] > end_s * (1.0 + 1e-9):
        raise InputError(
            f"config: {key}",
            f"the times reach from {times_s[0]:g} to {times_s[-1]:g} s",
            f"they must lie within the protocol, 0 to {end_s:g} s",
        )
    return times_s


def _numbers(key: str, given: Any) -> Array:
    """Returns a client's list of numbers as an array. Raises InputError for anything else."""
    numeric = isinstance(given, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in given
    )
    array = np.array(given, dtype=float) if numeric and len(given) <= MOST_TIMES else np.array([np.nan])
    if not np.isfinite(array).all():
        raise InputError(
            f"config: {key}",
            f"it is {given!r:.60}",
            f"it must be a list of at most {MOST_TIMES} finite numbers",
        )
    return array


def _mechanisms(given: Any) -> tuple[Mechanism, ...]:
    """Returns the mechanisms that a client names. Raises InputError for unknown or repeated names."""
    if given == []:
        return ()
    known = catalogue()
    if not isinstance(given, list) or len({str(name) for name in given}) != len(given):
        raise InputError(
            "config: mechanisms", f"it is {given!r:.60}", "it must be a list of names, each once"
        )
    for name in given:
        if not isinstance(name, str) or name not in known:
            raise InputError(
                "config: mechanisms", f"{name!r} is not known", f"use some of {', '.join(known)}"
            )
    return tuple(known[name] for name in given)
