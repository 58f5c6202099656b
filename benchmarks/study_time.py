"""Measures how long a study takes: recordings of one protocol by the full model, inferred and compared.

The full model makes recordings of a loading with a hold and an unloading, with correlated noise, of skins in
two groups that differ in E_c by a factor of 1.8. `bayeskin study` infers them with a design by the reduced
model. The program prints the wall seconds of each part, as the records of the stages state them, and the true
values beside the intervals. A second start with the same folder continues, and repeats nothing.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/study_time.py --subjects 4 --folder /tmp/study-1
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rows
from noisy_recordings import inside_intervals, random_skin, save_noisy_recording

from bayeskin.types import PadMotion
from bayeskin.workflow.folder import read_record
from bayeskin.workflow.study import study

GROUPS, FACTOR, SPREAD = ("control", "keloid"), 1.8, 0.25  # factor and sd of log(E_c)
MOTION = PadMotion(
    np.array([0.0, 5.0, 11.0, 51.0, 57.0, 77.0]), 1e-3 * np.array([0.0, 0.0, 6.0, 6.0, 0.0, 0.0])
)
STUDY = """table = "table.csv"
[design]
coarse = "reduced"
[sample]
effective_samples = 2000
[check]
draws = 8
"""


def make(folder: Path, subject: int) -> tuple[str, str, dict[str, float]]:
    """Writes a subject's recording, if it does not exist, and returns its name, its group and its skin."""
    rng, group = np.random.default_rng([subject, 31]), GROUPS[subject % 2]
    theta = random_skin(rng, SPREAD)
    theta["E_c"] *= FACTOR if group == GROUPS[1] else 1.0
    file = folder / f"s{subject:02d}.h5"
    if not file.exists():
        save_noisy_recording(file, rng, MOTION, theta)
    return file.stem, group, theta


def seconds_by_stage(folder: Path) -> dict[str, float]:
    """Returns the seconds of each stage, summed over the runs in a folder."""
    seconds = dict[str, float]()
    for file in folder.glob("*/*/stage.json"):
        record = read_record(file.parent)
        name = file.parent.name
        seconds[name] = seconds.get(name, 0.0) + (record.seconds if record else 0.0)
    return seconds


def report(answer: Mapping[str, Any], folder: Path, skins: Mapping[str, Mapping[str, float]]) -> None:
    """Prints times, and true values beside intervals."""
    shared, own = (seconds_by_stage(folder / "study" / part) for part in ("protocols", "recordings"))
    table = [["the protocol", stage, f"{s:.0f}"] for stage, s in shared.items()]
    table += [["all recordings", stage, f"{s:.0f}"] for stage, s in own.items()]
    table.append(["one recording", "all", f"{sum(own.values()) / len(skins):.0f}"])
    print(rows.markdown(["of", "stage", "process seconds"], table))
    for recording in answer["recordings"]:
        if "alone" in recording:
            print(recording["name"], recording["group"])
            table = inside_intervals(recording["alone"], skins[recording["name"]])
            print(rows.markdown(["", "true", "5 %", "95 %", "inside"], table))
    print(answer["text"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--subjects", type=int, default=4)
    parser.add_argument("--folder", type=Path, required=True)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    skins = [make(options.folder, subject) for subject in range(options.subjects)]
    lines = [f"{name}.h5,{name},{group}" for name, group, _ in skins]
    (options.folder / "table.csv").write_text("\n".join(["recording,subject,group", *lines]) + "\n")
    config = options.folder / "study.toml"
    config.write_text(STUDY)
    answer = study(config, rows.Log())
    report(answer, options.folder, {name: theta for name, _, theta in skins})


if __name__ == "__main__":
    main()
