"""Opens the context of a diagnosis from a run's folder, and answers its tasks in worker processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin import storage
from bayeskin.execution.local import Lost, standing
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.opened import forward_model
from bayeskin.hashing import sha256_of
from bayeskin.mismatch.answers import answer, read_answer
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.noise_bounds import NOISE_BOUNDS, without_swings
from bayeskin.mismatch.tasks import AnswerTasks, Task
from bayeskin.recordings import analyse, bin_recording, jumps_of
from bayeskin.recordings.join import join_bins, join_jumps
from bayeskin.store import Store
from bayeskin.types import BinnedForce, Jumps, PadMotion, ParameterSpace, Recording
from bayeskin.workflow.recording import recorded_markers


@dataclass(frozen=True)
class ContextSource:
    """The files and settings from which any process can open the context of a diagnosis.

    recording : folder of the run's stage `recording`; model : file of the forward model
    spec : the full model that the configuration asks for; base : priors of the base model
    noise : bounds of the noise parameters that the configuration states
    shared : what several recordings share besides the skin (`DiagnosisContext`)
    """

    recording: Path
    model: Path
    spec: ModelSpec
    seed: int
    base: ParameterSpace
    noise: tuple[tuple[str, tuple[float, float]], ...] = ()
    shared: tuple[str, ...] = ()


def open_context(source: ContextSource) -> DiagnosisContext:
    """Returns the context from the files and settings of a source."""
    binned, jumps, motion = calm_bins(source.recording)
    markers = recorded_markers(source.recording)
    forward = forward_model(source.model, source.spec, motion, binned.edges_s, markers)
    noise = dict(source.noise)
    return DiagnosisContext(
        binned, jumps, motion, forward, source.base, source.seed, noise, source.shared, markers
    )


def calm_bins(folder: Path) -> tuple[BinnedForce, Jumps, PadMotion]:
    """Returns the bins with variances of quick noise, the jumps that the samples allow, and the protocol.

    folder : the folder of the stage `recording`, from which all of them are read
    """
    samples = storage.load(folder / "recording.h5", Recording)
    binned = storage.load(folder / "binned.h5", BinnedForce)
    motion = storage.load(folder / "motion.h5", PadMotion)
    if not binned.spans:
        return *_calm(samples, binned), motion
    parts = [_calm(samples.part(span), part) for span, part in zip(binned.spans, binned.parts, strict=True)]
    calm, jumps = zip(*parts, strict=True)
    return join_bins(calm, binned.spans), join_jumps(jumps, binned.spans), motion


def _calm(samples: Recording, binned: BinnedForce) -> tuple[BinnedForce, Jumps]:
    """Returns the bins of one recording with variances of quick noise, and the jumps of its samples."""
    quick_noise = analyse(samples, binned.phases, NOISE_BOUNDS.quick_s)
    quick = bin_recording(samples, binned.phases, binned.edges_s, quick_noise)
    return without_swings(binned, quick.variance_n2), jumps_of(samples, binned.phases)


@dataclass(frozen=True)
class _Worker:
    """Answers tasks in a worker process, which opens its context once."""

    source: ContextSource

    def __call__(self, task: Task) -> dict[str, Any]:
        return answer(_opened_once(self.source), task)


@lru_cache(maxsize=1)
def _opened_once(source: ContextSource) -> DiagnosisContext:
    """Returns the context of a source, which this process opens only at the first call."""
    return open_context(source)


@contextmanager
def asked(
    source: ContextSource, context: DiagnosisContext, store: Store, workers: int,
    tell_tasks: Callable[[int], None],
) -> Iterator[AnswerTasks]:  # fmt: skip
    """Yields a function that answers tasks in worker processes, and keeps all answers in a store.

    A task whose answer is in the store is not run again.

    tell_tasks : receives the number of tasks that are done, after each that was run. Those whose answers were
        in the store are counted, but not told, because they say nothing about the pace
    """
    with standing(_Worker(source), workers) as run_all, store:
        done: set[str] = set()

        def ask(tasks: Sequence[Task]) -> list[object]:
            keys = [sha256_of([type(task).__name__, asdict(task)]) for task in tasks]
            new = [i for i, key in enumerate(keys) if key not in store]
            done.update(key for key in keys if key in store)
            for i, result in run_all([tasks[i] for i in new]):
                store.add(keys[new[i]], {"message": result.reason} if isinstance(result, Lost) else result)
                done.add(keys[new[i]])
                tell_tasks(len(done))
            return [
                read_answer(context, task, store.read(key, dict))
                for task, key in zip(tasks, keys, strict=True)
            ]

        yield ask


def depends_on(context: DiagnosisContext) -> list[Any]:
    """Returns everything on which the answers to a context's tasks depend besides the tasks."""
    return [
        bayeskin.__version__, context.seed, repr(context.base.without_texts),
        sorted(context.stated_noise.items()), sorted(context.shared),
        context.forward.hash, asdict(context.binned), asdict(context.motion),
        [repr(ParameterSpace(m.parameters).without_texts) for m in context.known.values()],
        *([] if context.markers is None else [asdict(context.markers)]),
    ]  # fmt: skip
