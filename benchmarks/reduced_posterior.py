"""Compares the article's posterior by a design of the reduced model with that by the shipped surrogate.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_posterior.py --folder F

The recording is the article's. The environment variable BAYESKIN_SUPPLEMENT must name the supplement's
folder. The shipped surrogate was trained on full runs alone. The other surrogate is trained here, on runs of
the reduced model that eight full runs correct. The program prints both 90 % intervals of each parameter. It
also prints by how many sd of the shipped posterior the mean shifts (in logarithms where the prior is
logarithmic), the Monte Carlo error of this shift, and the ratio of the sd. A second start with the same
folder continues, and repeats nothing.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
import rows

from bayeskin.inference import load_inference_data
from bayeskin.types import Array
from bayeskin.workflow.importing import import_recording
from bayeskin.workflow.stages import run

CONFIG = """name = "{name}"
seed = 1
[recording]
file = "healthy-skin.h5"
[model]
observation = "reaction"
{source}
[sample]
max_steps = 30000
[check]
draws = 0
"""
SOURCES = {
    "shipped": '[surrogate]\nfile = "healthy-skin-reaction.h5"',
    "reduced": '[design]\ncoarse = "reduced"\nfine_points = 8\nfine_held_out = 4',
}
HEADER = (
    "",
    "shipped: 5 %, 50 %, 95 %",
    "reduced: 5 %, 50 %, 95 %",
    "shift [sd]",
    "Monte Carlo error of the shift [sd]",
    "ratio of sd",
)


def sampled(folder: Path, name: str) -> tuple[dict[str, dict[str, Any]], dict[str, Array]]:
    """Returns the summary of each parameter of a run, and its draws."""
    config = folder / f"{name}.toml"
    if not config.exists():
        config.write_text(CONFIG.format(name=name, source=SOURCES[name]))
    summary = run(config, "sample", rows.Log())
    rows.say(f"{name}: {summary['verdict']}: {'; '.join(summary['reasons'])}")
    posterior = load_inference_data(Path(summary["folder"]) / "sample" / "posterior.nc")["posterior"]
    return summary["parameters"], {key: np.ravel(posterior[key]) for key in summary["parameters"]}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder that keeps both runs")
    folder, supplement = parser.parse_args().folder, os.environ.get("BAYESKIN_SUPPLEMENT")
    if supplement is None:
        raise SystemExit("BAYESKIN_SUPPLEMENT is not set; set it to the folder of the article's supplement")
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "healthy-skin.h5"
    if not recording.exists():
        import_recording(rows.Log(), Path(supplement) / "data" / "Healthy_skin.xlsx", recording)
    (shipped_run, shipped_draws), (other_run, reduced_draws) = (sampled(folder, name) for name in SOURCES)
    table = []
    for name, fitted in shipped_run.items():
        scale = np.log if fitted["prior"]["kind"].startswith("log") else np.asarray
        a, b = scale(shipped_draws[name]), scale(reduced_draws[name])
        intervals = [
            ", ".join(f"{p[key]:.3g}" for key in ("low_90", "median", "high_90"))
            for p in (fitted, other_run[name])
        ]
        table.append([
            name, *intervals, f"{(b.mean() - a.mean()) / a.std():+.3f}",
            f"{np.sqrt(1.0 / fitted['ess'] + 1.0 / other_run[name]['ess']):.3f}", f"{b.std() / a.std():.3f}",
        ])  # fmt: skip
    print(rows.markdown(HEADER, table))


if __name__ == "__main__":
    main()
