"""The recording, the reduced model of its device, and tasks on them, of a diagnosis by that model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import bayeskin
from bayeskin import storage
from bayeskin.execution.local import Lost, standing
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ForwardModel, ModelRun
from bayeskin.forward.observed import FullForce
from bayeskin.forward.opened import forward_model
from bayeskin.forward.reduced import ReducedForward
from bayeskin.hashing import sha256_of
from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import ALL, noise_space
from bayeskin.json_files import read_lines
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, observed, with_one
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.fit import (
    QUICK_S,
    fit,
    instrument_noise,
    promised,
    restored,
    soft_on_stiff,
    without_swings,
)
from bayeskin.mismatch.hypotheses import Evidences
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.refuted import refuted
from bayeskin.mismatch.tangent import Tangent
from bayeskin.mismatch.tasks import (
    Ask,
    Climb,
    FullProbe,
    Join,
    OtherTest,
    Probe,
    Promise,
    Task,
    Weigh,
)
from bayeskin.mismatch.trust_region import JointFit, TrustSettings, as_json, fit_jointly, within
from bayeskin.recordings import analyse, bin_recording, jumps_of
from bayeskin.types import Array, BinnedForce, Jumps, PadMotion, ParameterSpace, Recording, Surrogate
from bayeskin.workflow.model import model_error

TRUST = 0.15  # of the prior's width about a run, within which a mechanism is searched for on its tangent


@dataclass(frozen=True)
class Source:
    """The files and settings that a bench is opened from.

    recording : folder of a run's stage `recording`; model : file of the forward model; spec : the full model
    that the configuration asks for; base : priors of the base model; noise : bounds of the noise's parameters
    that the configuration states
    """

    recording: Path
    model: Path
    spec: ModelSpec
    seed: int
    base: ParameterSpace
    noise: tuple[tuple[str, tuple[float, float]], ...] = ()


class Workbench:
    """A recording's bins and protocol, a forward model, and posteriors of sets about its runs."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.binned, self.jumps, self.motion = calm_bins(source.recording)
        self.forward: ForwardModel = forward_model(
            source.model, source.spec, self.motion, self.binned.edges_s
        )
        self.known: Mapping[str, Mechanism] = _known(self.forward)
        self.base = source.base
        self._seed = source.seed
        self._noise = replace(instrument_noise(self.binned), by_kind=False, **dict(source.noise))  # type: ignore[arg-type]
        self._neutral = {name: value for m in self.known.values() for name, value in m.neutral.items()}

    @property
    def noise(self) -> dict[str, float]:
        """Values of the noise's parameters to begin with: the middle of their priors."""
        space = noise_space([ALL], self._noise)
        return dict(zip(space.names, map(float, space.from_unit(np.full(space.dim, 0.5))), strict=True))

    def space(self, names: Sequence[str]) -> ParameterSpace:
        """Parameters that the forward model solves for a set: the base's, then each mechanism's."""
        own = tuple(p for m in self.solved(names) for p in m.parameters)
        return ParameterSpace((*self.base.parameters, *own))

    def force(self, names: Sequence[str], theta: Mapping[str, float]) -> Array | str:
        """Force (m,) of the skin with a set at values, or why the run failed."""
        run = self._run(names, theta, slopes=False)
        return run if isinstance(run, str) else run.force_n

    def full(self, names: Sequence[str], theta: Mapping[str, float]) -> Array | str:
        """Force (m,) of the skin with a set at values by the full model, or why its run failed."""
        return self._full((self._solved_names(names), theta))

    def reported(self, case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
        """Force (m,) as the instrument reports it, with a set at values."""
        names, theta = case
        run = self._run(names, theta, slopes=False)
        return run if isinstance(run, str) else self.reported_of(names, theta, run.force_n)

    def reported_of(self, names: Sequence[str], theta: Mapping[str, float], force_n: Array) -> Array:
        """A force (m,) of the skin as the instrument reports it, with a set at values."""
        at = np.array([theta[name] for name in self.space(names).names])
        seen = self._seen(names, (), [ModelRun(at, force_n, np.zeros((len(force_n), len(at))))])
        return seen.predict_mean(np.array([theta[name] for name in seen.space.names]))[0]

    def elsewhere(self, task: OtherTest) -> Array | str:
        """Force (m,) that the instrument reports of a set in another test, or why the run failed."""
        motion = PadMotion(np.array(task.time_s), np.array(task.displacement_m))
        values = {name: task.theta[name] for name in self.space(task.names).names}
        assert isinstance(self.forward, ReducedForward)
        found = self.forward.simulated(motion, values, self.solved(task.names))
        if found.status != "ok":
            return found.message
        beyond = [self.known[name] for name in sorted(task.names) if name not in self.forward.solves]
        rows = {name: np.array([value]) for name, value in task.theta.items()}
        force = observed(beyond, rows, motion, lambda time_s: np.atleast_2d(found.at(time_s)))
        return bin_means(force, motion, np.array(task.edges_s), beyond)[0]

    def skin(self, names: Sequence[str], theta: Mapping[str, float]) -> ModelRun | str:
        """A run with derivatives of a set at values, or why it failed."""
        return self._run(names, theta, slopes=True)

    def local(
        self, names: Sequence[str], runs: Sequence[ModelRun], off_n: Array | None = None,
        until_s: float | None = None,
    ) -> LogPosterior:  # fmt: skip
        """The posterior of a set about runs of it, to which the error of the reduced model was added.

        That error changes from place to place by as much as it is, so it counts as known to one sd of itself.

        until_s : end of what of the recording is known; None for all
        """
        return _with_error(self._posterior(self._seen(names, (), runs), until_s), off_n)

    def _run(self, names: Sequence[str], theta: Mapping[str, float], slopes: bool) -> ModelRun | str:
        space = self.space(names)
        at = np.array([theta[name] for name in space.names])
        return self.forward.run(space, at, self.solved(names), slopes)

    def solved(self, names: Sequence[str]) -> list[Mechanism]:
        """Those of a set that the forward model solves, by their names' order."""
        return [self.known[name] for name in sorted(names) if name in self.forward.solves]

    def _seen(self, names: Sequence[str], more: Sequence[str], runs: Sequence[ModelRun]) -> Surrogate:
        """The reported force about runs of a set, with `more` mechanisms by what they do to a force."""
        errors_n = self.forward.errors(runs[0].theta)
        skin = Tangent(self.space(names), self.binned.edges_s, tuple(runs), errors_n)
        beyond = tuple(
            self.known[name] for name in sorted({*names, *more})
            if name in more or name not in self.forward.solves
        )  # fmt: skip
        return ObservedSurrogate(skin, beyond, self.motion) if beyond else skin

    @property
    def _full(self) -> FullForce:
        return FullForce(self.forward.spec, self.motion, self.binned.edges_s)

    def _solved_names(self, names: Sequence[str]) -> tuple[str, ...]:
        return tuple(m.name for m in self.solved(names))

    def _posterior(self, seen: Surrogate, until_s: float | None = None) -> LogPosterior:
        return LogPosterior(
            seen,
            self.binned,
            None if until_s is None else ((float(self.binned.edges_s[0]), until_s),),
            self._noise,
            ParameterSpace(seen.space.parameters, self.base.correlations),
            None,
            soft_on_stiff,
            model_error(self.forward.spec, self.motion, self.binned.edges_s),
        )

    def done(self, task: Task) -> dict[str, Any]:
        """The answer to a task, as JSON has it."""
        if isinstance(task, Probe | FullProbe | OtherTest):
            force = self._force_of(task)
            return {"message": force} if isinstance(force, str) else {"force_n": force.tolist()}
        if isinstance(task, Promise):
            return {"nats": self._promised(task)}
        if isinstance(task, Weigh):
            left = discrepancy(self._fitted(task.fit).fit, self.motion)
            return asdict(Evidences(left.without_log_evidence, left.log_evidence))
        if isinstance(task, Join):
            beside = task.promise
            names = with_one(beside.names, beside.name, self.known)
            start = {**self._neutral, **beside.theta, **self._searched(beside)}
            return self._climbed(Climb(names, start, task.runs, beside.off_n))
        return self._climbed(task)

    def _force_of(self, task: Probe | FullProbe | OtherTest) -> Array | str:
        if isinstance(task, OtherTest):
            return self.elsewhere(task)
        run = self.force if isinstance(task, Probe) else self.full
        return run(task.names, task.theta)

    def _climbed(self, task: Climb) -> dict[str, Any]:
        start = dict(task.start)
        if {"E_c", "E_s"} <= set(start):
            start["E_c"] = max(start["E_c"], start["E_s"] / 1.9)  # a stiffer subcutis is ruled out
        off_n = np.array(task.off_n) if task.off_n else None
        local = partial(self.local, off_n=off_n, until_s=task.until_s)
        settings = TrustSettings(runs=task.runs)
        found = fit_jointly(task.names, start, self.skin, local, settings, off_n)
        return {"message": found} if isinstance(found, str) else as_json(found)

    def _promised(self, task: Promise) -> float:
        """Nats that a mechanism promises by what it does to a force."""
        about, new = self._beside(task)
        parts = [part for name in new for part in self.known[name].whole_or_parts]
        return promised(about, task.theta, self._neutral, parts, self._seed)

    def _searched(self, task: Promise) -> Mapping[str, float]:
        """Values of a set with a mechanism more, on the tangent of the run without it."""
        about, new = self._beside(task)
        vector = np.clip(about.vector({**self._neutral, **task.theta}), *about.bounds)
        parts = [part for name in new for part in self.known[name].whole_or_parts]
        near = within(about, vector, TRUST)
        return fit((*task.names, *new), near, task.theta, self._neutral, self._seed, parts).theta

    def _beside(self, task: Promise) -> tuple[LogPosterior, list[str]]:
        new = [name for name in with_one(task.names, task.name, self.known) if name not in task.names]
        about = self._posterior(self._seen(task.names, new, [task.run]))
        return _with_error(about, np.array(task.off_n) if task.off_n else None), new

    def answered(self, task: Task, said: Mapping[str, Any]) -> object:
        """Returns an answer as a search reads it: a fit, nats, a force, evidences, or why there is none."""
        if "message" in said:
            return said["message"]
        if isinstance(task, Probe | FullProbe | OtherTest):
            return np.array(said["force_n"])
        if isinstance(task, Promise):
            return said["nats"]
        if isinstance(task, Weigh):
            return Evidences(**said)
        found = self._fitted(said, task.until_s if isinstance(task, Climb) else None)
        against = refuted(found.fit, self.known, self.motion, self.jumps)
        return f"the recording's samples show nothing of {', '.join(against)}" if against else found

    def _fitted(self, said: Mapping[str, Any], until_s: float | None = None) -> JointFit:
        """A fit from what `as_json` made of it."""
        run = ModelRun(*(np.array(said["run"][name]) for name in ("theta", "force_n", "slopes_n")))
        off_n = np.array(said["off_n"])
        about = self.local(said["fit"]["names"], [run], off_n if off_n.any() else None, until_s)
        return JointFit(restored(said["fit"], about), run, said["runs"], said["settled"], off_n)


def _with_error(about: LogPosterior, off_n: Array | None) -> LogPosterior:
    """Returns the posterior with an error (m,) of the reduced model among those that it allows for."""
    if off_n is None or about.model_error is None:
        return about
    return replace(about, model_error=replace(about.model_error, measured_n=off_n[None]))


def _known(forward: ForwardModel) -> dict[str, Mechanism]:
    """Mechanisms of the catalogue that a forward model can solve, or that act on the force."""
    known = {
        name: m for name, m in catalogue().items() if name in forward.solves or not isinstance(m.act, Tissue)
    }
    return {name: m for name, m in known.items() if set(m.needs) <= set(known)}


@dataclass(frozen=True)
class _Worker:
    """Answers tasks in a process of its own, whose bench stays from one to the next."""

    source: Source

    def __call__(self, task: Task) -> dict[str, Any]:
        return _bench(self.source).done(task)


@lru_cache(maxsize=1)
def _bench(source: Source) -> Workbench:
    return Workbench(source)


def calm_bins(folder: Path) -> tuple[BinnedForce, Jumps, PadMotion]:
    """Returns bins with their quick noise alone, the jumps that the samples allow, and the protocol.

    All are of the stage `recording`, from its folder.
    """
    samples = storage.load(folder / "recording.h5", Recording)
    binned = storage.load(folder / "binned.h5", BinnedForce)
    quick = bin_recording(samples, binned.phases, binned.edges_s, analyse(samples, binned.phases, QUICK_S))
    motion = storage.load(folder / "motion.h5", PadMotion)
    return without_swings(binned, quick.variance_n2), jumps_of(samples, binned.phases), motion


@contextmanager
def asked(bench: Workbench, file: Path, workers: int) -> Iterator[Ask]:
    """Yields what answers tasks, in so many processes; answers are kept in a file, and found there again.

    Raises InputError for a file that holds something else.
    """
    kept = {row["task"]: row["answer"] for row in read_lines(file)}
    file.parent.mkdir(parents=True, exist_ok=True)
    with standing(_Worker(bench.source), workers) as run_all, open(file, "a", encoding="utf-8") as handle:

        def ask(tasks: Sequence[Task]) -> list[object]:
            keys = [sha256_of([type(task).__name__, asdict(task)]) for task in tasks]
            new = [i for i, key in enumerate(keys) if key not in kept]
            for i, answer in run_all([tasks[i] for i in new]):
                said = {"message": answer.reason} if isinstance(answer, Lost) else answer
                kept[keys[new[i]]] = said
                handle.write(json.dumps({"task": keys[new[i]], "answer": said}) + "\n")
                handle.flush()
            return [bench.answered(task, kept[key]) for task, key in zip(tasks, keys, strict=True)]

        yield ask


def searches_file(run_folder: Path, bench: Workbench) -> Path:
    """Returns the file in which answers to a bench's tasks are kept, by all that they depend on."""
    identity = [
        bayeskin.__version__, bench.source.seed, repr(bench.source.base), bench.source.noise,
        bench.forward.hash, asdict(bench.binned), asdict(bench.motion),
        [repr(m.parameters) for m in bench.known.values()],
    ]  # fmt: skip
    return run_folder / "searches" / f"{sha256_of(identity)[:16]}.jsonl"
