"""What a diagnosis by the reduced model makes of recordings of the development sets, whose keys are known.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/joint_diagnosis.py --folder F [development/009 ...]

Shipped surrogates know the protocol of these recordings. Here a configuration of each, with
`coarse = "reduced"`, has the reduced model solve all mechanisms of a set together. Prints what was concealed
and how large it is (in noise floors), what is named, the probability that nothing is missing, how many of the
skin's and the effect's parameters lie in their 90 % intervals, RMS residuals before and after, by how much
the reduced model is off at the end, and seconds. A second start with the same folder goes on.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import rows

from bayeskin.pipeline.diagnosis import diagnose

DATA = Path(__file__).parent.parent / "data"
CONFIG = """name = "{name}"
[recording]
file = "{name}.h5"
[design]
coarse = "reduced"
workers = 2
"""
CASES = ("001", "002", "004", "009", "016", "018", "022", "026", "041", "054")
HEADER = (
    "recording", "concealed", "size [floors]", "named (probability)", "nothing", "skin inside",
    "effect inside", "RMS residual [mN]", "reduced model off by [mN]", "seconds",
)  # fmt: skip


def row(case: str, folder: Path) -> list[str]:
    """The table's row of one recording, such as "development/009"."""
    which, number = case.split("/")
    name = f"{which}-{number}"
    config = folder / f"{name}.toml"
    if not config.exists():
        shutil.copy(DATA / which / "recordings" / f"{number}.h5", folder / f"{name}.h5")
        config.write_text(CONFIG.format(name=name))
    said = diagnose(config, rows.Log())
    key: dict[str, Any] = json.loads((DATA / which / "seals" / f"{number}.json").read_text())
    values, fit = said["fit"]["after"]["theta"], said["fit"]
    full = said["full_model"]
    named = [f"{one['name']} ({one['probability']:.2f})" for one in said["mechanisms"]]
    return [
        case, key["label"], f"{key['size']:.1f}",
        ", ".join(named) or said["verdict"],
        f"{said['nothing_probability']:.2f}", _inside(key["theta"], values), _inside(key["values"], values),
        f"{1e3 * fit['before']['rmse']:.1f} to {1e3 * fit['after']['rmse']:.1f}",
        full.get("message") or f"{1e3 * full['reduced_off_by']:.2f}", f"{said['seconds']:.0f}",
    ]  # fmt: skip


def _inside(truth: dict[str, float], values: dict[str, Any]) -> str:
    """How many of the true values lie in their 90 % intervals, of those that were fitted."""
    known = {name: value for name, value in truth.items() if name in values and name != "p_init"}
    ends = {name: values[name]["interval90"] for name in known}
    return f"{sum(ends[n][0] <= v <= ends[n][1] for n, v in known.items())} of {len(known)}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where diagnoses stay")
    parser.add_argument("cases", nargs="*", default=[f"development/{number}" for number in CASES])
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    table = list[list[str]]()
    for case in options.cases:
        table.append(row(case, options.folder))
        rows.say(" | ".join(table[-1]))
    print(rows.markdown(HEADER, table))


if __name__ == "__main__":
    main()
