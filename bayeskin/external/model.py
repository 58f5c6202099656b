"""Runs the user's own forward model in place of the full model: a Python function or a UM-Bridge server.

A function ``force(theta, time_s, displacement_m)`` returns the force [N] at the times of a displacement. Its
name is ``"FILE.py:FUNCTION"`` or ``"PACKAGE.MODULE:FUNCTION"``, so that worker processes can find it.

A server (``"http://HOST:PORT"``) receives the parameters in their order and the configuration
``{"protocol": {"time_s": [...], "displacement_m": [...]}, "times_s": [...]}``. It returns the force at
`times_s`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.external.umbridge import Client, Refused
from bayeskin.hashing import sha256_of_behaviour
from bayeskin.types import Array, PadMotion, Simulation, frozen_array

STEP_S = 0.1  # between the times at which the force is requested; bins are five times as wide
Force = Callable[[Mapping[str, float], Array, Array], ArrayLike]


def identity(forward: str) -> str:
    """Returns a sha256 that changes with the behaviour of the function's file, or with the server's address.

    Comments and docstrings of the file do not change it. Raises InputError where the function is not found.
    """
    code = "" if _is_url(forward) else sha256_of_behaviour(_source(forward).read_bytes())
    name = forward if _is_url(forward) else forward.rpartition(":")[2]
    return hashlib.sha256(json.dumps(["own", name, code]).encode()).hexdigest()


def check_own(forward: str) -> None:
    """Checks that the user's own model can be used.

    Raises InputError where a function cannot be imported, and Unavailable where a server does not answer.
    """
    if _is_url(forward):
        Client(forward).name()
    else:
        _function(forward)


def simulate_own(forward: str, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
    """Returns a run of the model that `forward` names.

    Raises InputError where the model cannot be found, and Unavailable where the server does not answer.
    """
    if _is_url(forward):
        return simulate_server(forward, motion, theta)
    return simulate_with(_function(forward), motion, theta, identity(forward))


def simulate_with(
    force: Force, motion: PadMotion, theta: Mapping[str, float], model_hash: str = "own"
) -> Simulation:
    """Returns a run of a function ``force(theta, time_s, displacement_m)``, in the form of a full run.

    The simulation has failed where the function raises an exception or the force is not finite. Raises
    InputError where the result has another shape than time_s (n,).
    """
    started, time_s, message = time.perf_counter(), motion.times(STEP_S), ""
    try:
        force_n = np.asarray(force(dict(theta), time_s, motion.at(time_s)), dtype=float)
    except InputError:
        raise
    except Exception as error:  # the user's function can raise any exception
        force_n, message = np.full(len(time_s), np.nan), _error_line(error)
    return _simulation(motion, theta, time_s, force_n, model_hash, time.perf_counter() - started, message)


def simulate_server(url: str, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
    """Returns a run of the model of a UM-Bridge server; the run has failed where the server refuses it.

    Raises InputError where the server has another number of inputs, and Unavailable where it does not answer.
    """
    started, time_s, client = time.perf_counter(), motion.times(STEP_S), Client(url)
    protocol = {"time_s": motion.time_s.tolist(), "displacement_m": motion.displacement_m.tolist()}
    config = {"protocol": protocol, "times_s": time_s.tolist()}
    try:
        name = client.name()
        sizes = client.sizes(name, "input", config)
        if sum(sizes) != len(theta):
            raise InputError(
                url,
                f"the number of the model's inputs is {sum(sizes)}",
                f"it must be {len(theta)}: {', '.join(theta)}",
            )
        values = iter(theta.values())
        answer = client.evaluate(name, [[next(values) for _ in range(size)] for size in sizes], config)
        force_n, message = np.array(answer), ""
    except Refused as refusal:
        force_n, message = np.full(len(time_s), np.nan), f"the server refused: {refusal}"
    seconds = time.perf_counter() - started
    return _simulation(motion, theta, time_s, force_n, identity(url), seconds, message)


def _simulation(
    motion: PadMotion,
    theta: Mapping[str, float],
    time_s: Array,
    force_n: Array,
    model_hash: str,
    seconds: float,
    message: str = "",
) -> Simulation:
    if force_n.shape != time_s.shape:
        raise InputError(
            "your own forward model",
            f"the shape of its forces is {force_n.shape}",
            f"it must be ({len(time_s)},), one force for each time",
        )
    if not message and not np.isfinite(force_n).all():
        message = "the force of your own forward model is not finite"
    return Simulation(
        theta={name: float(value) for name, value in theta.items()},
        time_s=time_s,
        displacement_m=motion.at(time_s),
        force_n=force_n,
        corner=frozen_array(np.isin(time_s, motion.time_s), bool),
        status="failed" if message else "ok",
        message=message,
        stats={"seconds": seconds, "peak_force_n": float(np.abs(force_n).max())},
        model_hash=model_hash,
    )


def _error_line(error: Exception) -> str:
    """Returns one line that says which error the user's function raised, and where."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text, place = " ".join(str(error).split()), f"{Path(last.filename).name}, line {last.lineno}"
    return f"{type(error).__name__}: {text} ({place})"


def _is_url(forward: str) -> bool:
    return "://" in forward


def _source(forward: str) -> Path:
    """Returns the file in which a function is defined. Raises InputError where it cannot be found."""
    place, colon, function = forward.rpartition(":")
    if not colon or not function.isidentifier():
        remedy = "write FILE.py:FUNCTION, PACKAGE.MODULE:FUNCTION or http://HOST:PORT"
        raise InputError("model.forward", f"{forward!r} does not name a function", remedy)
    if place.endswith(".py"):
        source = Path(place)
    else:
        try:
            spec = importlib.util.find_spec(place)
        except (ImportError, ValueError):
            spec = None
        source = Path(spec.origin) if spec is not None and spec.origin else Path(place)
    if not source.is_file():
        raise InputError(
            f"model.forward {forward}",
            f"there is no file {source}",
            "name a Python file or module that exists",
        )
    return source


@lru_cache(maxsize=1)
def _function(forward: str) -> Force:
    """Returns the function, after its file is executed.

    Raises InputError where the file cannot be imported or has no such function.
    """
    source, (place, _, name) = _source(forward), forward.rpartition(":")
    try:
        module = _module_of_file(source) if place.endswith(".py") else importlib.import_module(place)
    except Exception as error:  # the user's file can raise any exception
        raise InputError(
            f"model.forward {source}",
            f"the file cannot be imported ({type(error).__name__}: {error})",
            "correct the file so that Python can import it",
        ) from None
    function: Any = getattr(module, name, None)
    if not callable(function):
        raise InputError(
            f"model.forward {source}",
            f"the file has no function {name}",
            "name one of its functions as FILE.py:FUNCTION",
        )
    return function  # type: ignore[no-any-return]


def _module_of_file(source: Path) -> ModuleType:
    """Executes a file and returns it as a module. The file may import other files in its folder."""
    spec = importlib.util.spec_from_file_location(f"own_{source.stem}", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    if str(source.parent) not in sys.path:
        sys.path.append(str(source.parent))
    spec.loader.exec_module(module)
    return module
