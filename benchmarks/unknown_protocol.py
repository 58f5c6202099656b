"""Measures how long a recording with an unknown protocol takes to a trusted posterior, stage by stage.

No shipped file knows the protocol. The full model makes a staircase test with random holds on a skin, with
correlated noise. `bayeskin new` writes its configuration, and the stages run as in `bayeskin run`. The
program prints the wall seconds and CPU seconds of each stage, the number of full runs, the effective draws of
the check, the verdict, and whether the true values lie in the 90 % intervals. A second start with the same
folder continues, and repeats nothing.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/unknown_protocol.py --seed 1 --folder /tmp/unknown-1
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import rows
from noisy_recordings import inside_intervals, random_skin, save_noisy_recording

from bayeskin.types import PadMotion
from bayeskin.workflow.new import new_config
from bayeskin.workflow.stages import BEFORE_REPORT, run

SPREAD = 0.3  # sd of the logarithms of a seed's skin about `TRUTH`
REST_S, STEP_MM, STEPS, SPEED_MM_S = 5.0, 3.0, 3, 1.0
HOLDS_S = (20.0, 40.0)


def staircase(rng: np.random.Generator) -> PadMotion:
    """Returns steps of 3 mm with holds between `HOLDS_S`, one unloading, and a rest."""
    time_s, height_mm = [0.0, REST_S], [0.0, 0.0]
    for level in (*(STEP_MM * (step + 1) for step in range(STEPS)), 0.0):
        ramp_s = abs(level - height_mm[-1]) / SPEED_MM_S
        hold_s = round(float(rng.uniform(*HOLDS_S)), 1)
        time_s += [time_s[-1] + ramp_s, time_s[-1] + ramp_s + hold_s]
        height_mm += [level, level]
    return PadMotion(np.array(time_s), 1e-3 * np.array(height_mm))


def make(file: Path, seed: int) -> dict[str, float]:
    """Writes a seed's recording, if it does not exist, and returns the parameters of its skin."""
    rng = np.random.default_rng([seed, 30])
    theta, motion = random_skin(rng, SPREAD), staircase(rng)
    if not file.exists():
        save_noisy_recording(file, rng, motion, theta)
    return theta


def spent_s() -> tuple[float, float]:
    """Returns the wall seconds, and the CPU seconds of this process and of its processes that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(usage.ru_utime + usage.ru_stime for usage in usages)


def stage_by_stage(config: Path) -> tuple[list[list[str]], dict[str, Any]]:
    """Returns a table row of each stage, and the summary of the run.

    The first row includes the reading of the recording.
    """
    table, started = [], spent_s()
    for name in (*(stage.name for stage in BEFORE_REPORT[1:]), None):
        stage_started = spent_s()
        summary = run(config, name, rows.Log())
        table.append(
            [name or "report", *(f"{b - a:.1f}" for a, b in zip(stage_started, spent_s(), strict=True))]
        )
    table.append(["all", *(f"{b - a:.1f}" for a, b in zip(started, spent_s(), strict=True))])
    return table, summary


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="folder that keeps the run (default: a temporary one)")
    options = parser.parse_args()
    with ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        theta = make(folder / "staircase.h5", options.seed)
        config = folder / "staircase.toml"
        if not config.exists():
            new_config([folder / "staircase.h5"])
        table, summary = stage_by_stage(config)
    print(rows.markdown(["stage", "seconds", "CPU seconds"], table))
    print(rows.markdown(["", "true", "5 %", "95 %", "inside"], inside_intervals(summary["posterior"], theta)))
    for check in summary["full_model_at_draws"]:
        print(check["message"])
    polished = summary["map"]["polished"] or {"full_runs": 0}
    print(f"{polished['full_runs']} full runs polish the maximum")
    print(f"{summary['verdict']}: {'; '.join(summary['because'])}")


if __name__ == "__main__":
    main()
