"""The article's posterior by a design of the reduced model, beside the one by the shipped surrogate.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_posterior.py --folder F

The recording is the article's, from the supplement's folder that BAYESKIN_SUPPLEMENT names. The shipped
surrogate was trained on full runs alone. The other one is trained here, on runs of the reduced
model that eight full runs correct. Prints both 90 % intervals of each parameter, by how many sd of the
shipped posterior the mean moves (on the line that the prior is in, logarithms mostly), the ratio of the sd,
and the Monte Carlo error of that shift. A second start with the same folder goes on, and repeats nothing.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import rows

from bayeskin.config import load_config
from bayeskin.types import Array
from bayeskin.workflow.single import import_recording
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
HEADER = ("", "shipped: 5 %, 50 %, 95 %", "reduced: 5 %, 50 %, 95 %", "shift [sd]", "error of it", "sd ratio")


def sampled(folder: Path, name: str) -> tuple[dict[str, dict[str, Any]], dict[str, Array]]:
    """Returns the summary of each parameter of a run, and its draws."""
    config = folder / f"{name}.toml"
    if not config.exists():
        config.write_text(CONFIG.format(name=name, source=SOURCES[name]))
    said = run(config, "sample", rows.Log())
    rows.say(f"{name}: {said['verdict']}: {'; '.join(said['reasons'])}")
    posterior = az.from_netcdf(folder / load_config(config).name / "sample" / "posterior.nc")["posterior"]
    return said["parameters"], {key: np.ravel(posterior[key]) for key in said["parameters"]}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where both runs stay")
    folder, supplement = parser.parse_args().folder, os.environ.get("BAYESKIN_SUPPLEMENT")
    if supplement is None:
        raise SystemExit("BAYESKIN_SUPPLEMENT: found nothing; expected the supplement's folder")
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "healthy-skin.h5"
    if not recording.exists():
        import_recording(Path(supplement) / "data" / "Healthy_skin.xlsx", recording)
    (known, before), (other, after) = (sampled(folder, name) for name in SOURCES)
    table = []
    for name, one in known.items():
        on_line = np.log if one["prior"]["kind"].startswith("log") else np.asarray
        a, b = on_line(before[name]), on_line(after[name])
        intervals = [
            ", ".join(f"{p[key]:.3g}" for key in ("low_90", "median", "high_90")) for p in (one, other[name])
        ]
        table.append([
            name, *intervals, f"{(b.mean() - a.mean()) / a.std():+.3f}",
            f"{np.sqrt(1.0 / one['ess'] + 1.0 / other[name]['ess']):.3f}", f"{b.std() / a.std():.3f}",
        ])  # fmt: skip
    print(rows.markdown(HEADER, table))


if __name__ == "__main__":
    main()
