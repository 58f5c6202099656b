"""Stores chains on disk in emcee's HDF5 form.

A file is always replaced as a whole. A chain that belongs to another posterior is refused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import emcee
import h5py
import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError


def save(
    path: Path, backend: emcee.backends.Backend, names: tuple[str, ...], identity: Mapping[str, str]
) -> None:
    """Writes a chain so that `emcee.backends.HDFBackend(path)` can read it.

    emcee itself appends to the file at every step. A process that is killed during such a step leaves a file
    that cannot be opened. Here the earlier file stays until the new one is complete and on disk. Raises
    InputError where the file cannot be written.
    """

    def fill(handle: h5py.File) -> None:
        group = handle.create_group("mcmc")
        for name in ("chain", "log_prob"):
            steps = np.asarray(getattr(backend, name))
            group.create_dataset(name, data=steps, maxshape=(None, *steps.shape[1:]))
        group.create_dataset("accepted", data=np.asarray(backend.accepted, dtype=float))
        group.attrs.update(
            version=emcee.__version__, nwalkers=backend.nwalkers, ndim=backend.ndim, has_blobs=False,
            iteration=backend.iteration,
        )  # fmt: skip
        for index, part in enumerate(backend.random_state):
            group.attrs[f"random_state_{index}"] = part
        group.attrs["bayeskin"] = json.dumps({"names": list(names), "identity": dict(identity)})

    storage.write_hdf5(path, fill)


def load(path: Path, names: tuple[str, ...], identity: Mapping[str, str]) -> emcee.backends.Backend:
    """Returns the chain in `path` as an in-memory backend, including its random state.

    Raises InputError when the file is not readable, has other parameters, or differs in any entry of
    `identity`. Entries that `identity` lacks are not compared.
    """
    with storage.reading(path, "an ensemble_N.h5 that `bayeskin sample` wrote") as handle:
        stored = json.loads(handle["mcmc"].attrs["bayeskin"])
        stored_names, stored_identity = tuple(map(str, stored["names"])), dict(stored["identity"])
        if stored_names != names:
            raise InputError(
                path,
                f"this chain has the parameters {', '.join(stored_names)}",
                f"they must be {', '.join(names)}",
            )
        for entry, value in identity.items():
            if stored_identity.get(entry) != value:
                stored_value = f"{stored_identity.get(entry, 'none')!s:.12}"
                problem = f"this chain has other inputs (its {entry} is {stored_value}, not {value[:12]})"
                raise InputError(path, problem, "use another folder for this sampling")
        return _in_memory(emcee.backends.HDFBackend(str(path), read_only=True), len(names))


def _in_memory(disk: emcee.backends.HDFBackend, count: int) -> emcee.backends.Backend:
    """Returns a copy of a chain in memory.

    Raises InputError unless the chain holds steps of walkers in `count` parameters.
    """
    walkers, dim = (int(v) for v in disk.shape)
    memory = emcee.backends.Backend()
    memory.reset(walkers, dim)
    memory.chain = np.array(disk.get_chain())
    memory.log_prob = np.array(disk.get_log_prob())
    memory.accepted = np.array(disk.accepted)
    memory.iteration = int(disk.iteration)
    steps = (memory.iteration, walkers, count)
    if dim != count or (memory.chain.shape, memory.log_prob.shape) != (steps, steps[:2]):
        raise InputError(
            "chain",
            f"its shape is {memory.chain.shape}",
            f"it must be {steps}, and that of log_prob {steps[:2]}",
        )
    memory.random_state = tuple(
        part.item() if isinstance(part, np.generic) else part for part in disk.random_state
    )
    return memory
