"""Kills stages with `kill -9` at random times, and checks what is lost and whether the result is the same.

    python benchmarks/kills.py --kills 14 --seed 1

The benchmark makes a recording with a small model of its own, and runs `bayeskin` on it undisturbed. Then
each of the stages design, train, sample and diagnose is run again from the end of the stage before it. It is
started, killed from outside at a random time, inspected, and started again. The program prints a table of
kills, of finished items that were gone after a kill, and whether the result equals the undisturbed one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayeskin import storage
from bayeskin.types import Recording
from bayeskin.workflow.folder import current_record, read_record

STAGES = ("design", "train", "sample", "diagnose")
KILLS_A_ROUND = 5  # after these kills the stage runs to its end, and a new round begins
MODEL = """
import time
import numpy as np

def force(theta, time_s, displacement_m):
    time.sleep(0.05)
    decay = np.exp(-np.diff(time_s) / theta["tau"])
    rate = np.diff(displacement_m) / np.diff(time_s)
    element = np.zeros(len(time_s))
    for i in range(1, len(time_s)):
        element[i] = element[i - 1] * decay[i - 1] + rate[i - 1] * theta["tau"] * (1 - decay[i - 1])
    return theta["stiffness"] * (displacement_m + theta["share"] * element)
"""
CONFIG = """
[recording]
file = "measured.h5"
[model]
forward = "model.py:force"
[parameters.stiffness]
lower = 10.0
upper = 1000.0
prior = "log-uniform"
[parameters.share]
lower = 0.0
upper = 1.0
[parameters.tau]
lower = 1.0
upper = 50.0
prior = "log-uniform"
[fit]
bin_width_s = 1.0
[design]
points = [32, 24]
held_out = 8
[map]
starts = 2
evaluations = 500
[sample]
ensembles = 2
walkers = 24
effective_samples = 3000
max_steps = 1500
"""


@dataclass(frozen=True)
class Row:
    """Holds the outcome for one stage.

    kills, rounds : number of kills, and number of times the stage began from its start
    lost : finished items that were gone after a kill
    same : True if the result equals the undisturbed one in every round
    """

    stage: str
    kills: int
    rounds: int
    lost: tuple[str, ...]
    same: bool


def make_case(folder: Path) -> Path:
    """Writes a recording of the model with noise and sensor drift, the model's file and its configuration.

    Returns the path of the configuration.
    """
    folder.mkdir(parents=True)
    namespace: dict[str, Any] = {}
    exec(MODEL, namespace)
    time_s = np.arange(0.0, 130.001, 0.1)
    corners_s = [0.0, 5.0, 15.0, 45.0, 55.0, 65.0, 75.0, 105.0, 115.0, 130.1]
    displacement_m = np.interp(time_s, corners_s, [0.0, 0.0, 9e-3, 9e-3, 0.0, 0.0, 9e-3, 9e-3, 0.0, 0.0])
    force_n = namespace["force"]({"stiffness": 100.0, "share": 0.6, "tau": 8.0}, time_s, displacement_m)
    noise_n = 2e-3 * np.random.default_rng(5).standard_normal(len(time_s))
    recording = Recording(time_s, displacement_m, force_n + noise_n + 3e-4 * time_s, "spring", "0" * 64)
    storage.save(folder / "measured.h5", recording)
    (folder / "model.py").write_text(MODEL)
    (folder / "case.toml").write_text(CONFIG)
    return folder / "case.toml"


def study(where: Path, kills: int, seed: int) -> Iterator[Row]:
    """Yields one row for each stage, with at least `kills` kills."""
    rng, config = np.random.default_rng(seed), make_case(where / "undisturbed")
    for stage in STAGES:
        before = where / f"before-{stage}"
        shutil.copytree(config.parent, before)
        started = time.monotonic()
        _finish(config, stage)
        yield _kill_repeatedly(where, before, config.parent, stage, kills, rng, time.monotonic() - started)
        shutil.rmtree(before)


def _kill_repeatedly(
    where: Path, before: Path, undisturbed: Path, stage: str, kills: int, rng: Any, lasts_s: float
) -> Row:
    """Kills one stage repeatedly until there are enough kills, and returns its row.

    lasts_s : seconds that the undisturbed stage took; a kill comes at a random time within them
    """
    count, rounds, lost, same = 0, 0, list[str](), True
    while count < kills:
        disturbed = where / "disturbed"
        shutil.copytree(before, disturbed)
        rounds += 1
        for _ in range(min(KILLS_A_ROUND, kills - count)):
            before_kill = finished_items(disturbed)
            if not _kill_after(disturbed / "case.toml", stage, float(rng.uniform(0.0, lasts_s))):
                break
            count += 1
            lost += [
                f"{kind} {key}"
                for kind, keys in before_kill.items()
                for key in keys - finished_items(disturbed)[kind]
            ]
        _finish(disturbed / "case.toml", stage)
        same = same and _result(disturbed, stage) == _result(undisturbed, stage)
        shutil.rmtree(disturbed)
    return Row(stage, count, rounds, tuple(lost), same)


def _command(config: Path, stage: str) -> list[str]:
    """Returns the command line that runs a stage."""
    return [sys.executable, "-c", "from bayeskin.cli import main; main()", stage, str(config)]


def _finish(config: Path, stage: str) -> None:
    """Runs a stage to its end; ends the program where it fails."""
    process = subprocess.run(_command(config, stage), capture_output=True, text=True, check=False)
    if process.returncode not in (0, 1):  # exit code 1: the stage has finished, but its result is not trusted
        raise SystemExit(f"{stage}: {process.stderr[-2000:]}")


def _kill_after(config: Path, stage: str, seconds: float) -> bool:
    """Kills a stage after some seconds; returns True if it was still running then."""
    process = subprocess.Popen(_command(config, stage), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        return True
    return False


def finished_items(folder: Path) -> dict[str, set[str]]:
    """Returns the names of everything that is finished in a run's folder; these sets may only grow."""
    run = folder / "case"
    finished: dict[str, set[str]] = {"result": set(), "steps": set(), "stage": set()}
    for store in run.glob("finished/*.store"):
        text = store.read_bytes()
        results = text[: text.rfind(b"\n") + 1].splitlines()[1:]
        finished["result"] |= {result.split(b" ", 3)[2].decode() for result in results}
    for chain in run.glob("chains/*/*.h5"):
        with h5py.File(chain) as handle:
            finished["steps"] |= {f"{chain.name} {n}" for n in range(int(handle["mcmc"].attrs["iteration"]))}
    for record in run.glob("*/stage.json"):
        stage_record = read_record(record.parent)
        if stage_record is not None and current_record(record.parent, stage_record.inputs_sha256) is not None:
            finished["stage"].add(record.parent.name)
    return finished


def _result(folder: Path, stage: str) -> Any:
    """Returns the result of a stage without the times that it took."""
    record = read_record(folder / "case" / stage)
    assert record is not None
    numbers: dict[str, Any] = {"done": record.done, "summary": _timeless(record.summary)}
    if stage == "design":
        with h5py.File(folder / "case" / "design" / "design.h5") as handle:
            numbers |= {name: handle[name][()].tobytes() for name in ("theta", "force_n", "ok", "wave")}
    if stage == "train":
        numbers |= _arrays(folder / "case" / "train" / "surrogate.h5")
    for chain in sorted((folder / "case").glob("chains/*/*.h5")):
        with h5py.File(chain) as handle:
            numbers[chain.name] = handle["mcmc/chain"][()].tobytes()
    return numbers


def _arrays(file: Path) -> dict[str, bytes]:
    """Returns every numeric array of an HDF5 file by its path, apart from seconds.

    Texts are left out, because they contain times.
    """
    arrays: dict[str, bytes] = {}

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and node.dtype.kind in "fiub" and "seconds" not in name:
            arrays[name] = np.asarray(node[()]).tobytes()

    with h5py.File(file) as handle:
        handle.visititems(visit)
    return arrays


def _timeless(value: Any) -> Any:
    """Returns a value without the entries of its mappings that are seconds."""
    if isinstance(value, Mapping):
        return {k: _timeless(v) for k, v in value.items() if "seconds" not in k}
    return [_timeless(item) for item in value] if isinstance(value, list | tuple) else value


def table(rows: list[Row]) -> str:
    """Returns the rows as a Markdown table."""
    lines = ["| stage | kills | rounds | finished items lost | same result as undisturbed |"]
    lines += ["|---|--:|--:|--:|---|"]
    for row in rows:
        end = "yes" if row.same else "NO"
        lines.append(f"| `{row.stage}` | {row.kills} | {row.rounds} | {len(row.lost)} | {end} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=14, help="number of kills of each stage")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as where:
        for row in study(Path(where), options.kills, options.seed):
            print(row, file=sys.stderr, flush=True)
            rows.append(row)
    print(table(rows))


if __name__ == "__main__":
    main()
