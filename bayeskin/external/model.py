"""A forward model of one's own in the full model's place: a Python function, or a server of UM-Bridge.

A function ``force(theta, time_s, displacement_m)`` gives the force [N] at the times of a displacement. It is
named by where it stands, ``"FILE.py:FUNCTION"`` or ``"PACKAGE.MODULE:FUNCTION"``, so that worker processes
can find it. A server (``"http://HOST:PORT"``) is sent the parameters in their order, and as configuration
``{"protocol": {"time_s": [...], "displacement_m": [...]}, "times_s": [...]}``; it gives the force at these.
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

STEP_S = 0.1  # between the times at which a force is asked for; bins are five times as wide
Force = Callable[[Mapping[str, float], Array, Array], ArrayLike]


def identity(forward: str) -> str:
    """Returns a sha256 that changes with the behaviour of the function's file, or with the server's address.

    Comments and docstrings of the file do not count. Raises InputError for a function that cannot be found.
    """
    code = "" if _is_url(forward) else sha256_of_behaviour(_source(forward).read_bytes())
    name = forward if _is_url(forward) else forward.rpartition(":")[2]
    return hashlib.sha256(json.dumps(["own", name, code]).encode()).hexdigest()


def check_own(forward: str) -> None:
    """Raises InputError where a function cannot be imported, Unavailable where a server does not answer."""
    if _is_url(forward):
        Client(forward).name()
    else:
        _function(forward)


def simulate_own(forward: str, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
    """A run of the model that `forward` names.

    Raises InputError where it cannot be found, Unavailable where the server does not answer.
    """
    if _is_url(forward):
        return simulate_server(forward, motion, theta)
    return simulate_with(_function(forward), motion, theta, identity(forward))


def simulate_with(
    force: Force, motion: PadMotion, theta: Mapping[str, float], model_hash: str = "own"
) -> Simulation:
    """A run of any function ``force(theta, time_s, displacement_m)``, as the full model's runs look.

    A force that is not finite, or a function that raises, is a Simulation that failed. Raises InputError for
    a result of another shape than that of time_s (n,).
    """
    started, time_s, message = time.perf_counter(), motion.times(STEP_S), ""
    try:
        found = np.asarray(force(dict(theta), time_s, motion.at(time_s)), dtype=float)
    except InputError:
        raise
    except Exception as error:  # of somebody's function: it can be any
        found, message = np.full(len(time_s), np.nan), _told(error)
    return _simulation(motion, theta, time_s, found, model_hash, time.perf_counter() - started, message)


def simulate_server(url: str, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
    """A run of the model of a UM-Bridge server; one that the server refuses is a Simulation that failed."""
    started, time_s, client = time.perf_counter(), motion.times(STEP_S), Client(url)
    config = {"protocol": {k: v.tolist() for k, v in vars(motion).items()}, "times_s": time_s.tolist()}
    try:
        name = client.name()
        sizes = client.sizes(name, "input", config)
        if sum(sizes) != len(theta):
            found = f"a model of {sum(sizes)} inputs"
            raise InputError(url, found, f"{len(theta)}: {', '.join(theta)}")
        values = iter(theta.values())
        answer = client.evaluate(name, [[next(values) for _ in range(size)] for size in sizes], config)
        force_n, message = np.array(answer), ""
    except Refused as refusal:
        force_n, message = np.full(len(time_s), np.nan), f"the server: {refusal}"
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
        expected = f"({len(time_s)},), a force for each time"
        raise InputError("the own forward model", f"a force of shape {force_n.shape}", expected)
    if not message and not np.isfinite(force_n).all():
        message = "the own forward model's force is not finite"
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


def _told(error: Exception) -> str:
    """Returns one line that says which error a user's function raised, and where."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    said, place = " ".join(str(error).split()), f"{Path(last.filename).name}, line {last.lineno}"
    return f"{type(error).__name__}: {said} ({place})"


def _is_url(forward: str) -> bool:
    return "://" in forward


def _source(forward: str) -> Path:
    """The file in which a function stands."""
    place, colon, function = forward.rpartition(":")
    if not colon or not function.isidentifier():
        expected = "FILE.py:FUNCTION, PACKAGE.MODULE:FUNCTION or http://HOST:PORT"
        raise InputError("model.forward", repr(forward), expected)
    if place.endswith(".py"):
        source = Path(place)
    else:
        try:
            found = importlib.util.find_spec(place)
        except (ImportError, ValueError):
            found = None
        source = Path(found.origin) if found is not None and found.origin else Path(place)
    if not source.is_file():
        raise InputError(f"model.forward {forward}", f"no file {source}", "a Python file or module")
    return source


@lru_cache(maxsize=1)
def _function(forward: str) -> Force:
    """The function itself; its file is executed. Raises InputError where that fails, or there is none."""
    source, (place, _, name) = _source(forward), forward.rpartition(":")
    try:
        module = _executed(source) if place.endswith(".py") else importlib.import_module(place)
    except Exception as error:  # of somebody's file: it can be any
        found = f"{type(error).__name__}: {error}"
        raise InputError(f"model.forward {source}", found, "a file that Python can import") from None
    function: Any = getattr(module, name, None)
    if not callable(function):
        raise InputError(f"model.forward {source}", f"no function {name}", "FILE.py:FUNCTION")
    return function  # type: ignore[no-any-return]


def _executed(source: Path) -> ModuleType:
    """A file as a module; it may import what lies beside it."""
    spec = importlib.util.spec_from_file_location(f"own_{source.stem}", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    if str(source.parent) not in sys.path:
        sys.path.append(str(source.parent))
    spec.loader.exec_module(module)
    return module
