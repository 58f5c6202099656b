"""Measures how a few full runs near a point reduce the reduced model's error, on sets of mechanisms.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_enriched.py --folder F [--skins 15 19 23]

The skins are those of reduced_model.py, given by their numbers, on the article's protocol. By default these
are its pairs, triples and quadruples of mechanisms. The error before is that of the shipped model at the
skin. The errors after are those of the enriched model at each further full run, at a skin nearby, before the
model is trained on this run. Full runs are stored in the folder, so that a second start makes none. Two
processes make the runs.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import h5py
import rows
from reduced_model import PROTOCOLS, RESULTS, compared, held_out

from bayeskin.execution.local import local
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.enrichment import EnrichmentSettings, enrich
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.store import Store
from bayeskin.workflow.reducing import SHIPPED

HEADER = (
    "skin", "mechanisms", "error before [% of peak]", "error after, as full runs are added [% of peak]",
    "full runs", "CPU s to enrich", "CPU s per run before", "CPU s per run after",
)  # fmt: skip


def spent_s() -> float:
    """Returns the CPU seconds of this process and of its processes that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def row(model: ReducedModel, number: int, folder: Path) -> list[str]:
    """Returns the table's row of one skin."""
    skin, motion = held_out()[number], PROTOCOLS["article"]
    with h5py.File(RESULTS) as handle:
        before = compared(model, motion, skin.theta, skin.mechanisms, handle[f"{number:02d}/article"])
    started = spent_s()
    with Store(folder / f"{number:02d}.store", "full runs near a skin") as store:
        result = enrich(
            model, skin.theta, skin.mechanisms, motion, EnrichmentSettings(), store, local(2),
            lambda what, share: None,
        )  # fmt: skip
    total_s = spent_s() - started
    mechanisms, costs = [catalogue()[name] for name in skin.mechanisms], []
    for either in (model, result.model):
        simulate_reduced(either, motion, skin.theta, mechanisms)
        run_started = time.process_time()
        simulate_reduced(either, motion, skin.theta, mechanisms)
        costs.append(f"{time.process_time() - run_started:.2f}")
    return [
        str(number), ", ".join(skin.mechanisms), before.message or f"{100 * before.rms:.3f}",
        " ".join(f"{100 * error:.3f}" for error in result.errors), str(result.full_runs), f"{total_s:.0f}",
        *costs,
    ]  # fmt: skip


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder that keeps the full runs")
    sets = [number for number, skin in enumerate(held_out()) if len(skin.mechanisms) > 1]
    parser.add_argument("--skins", type=int, nargs="*", default=sets)
    options = parser.parse_args()
    model, table = load_reduced(shipped(SHIPPED)), list[list[str]]()
    for number in options.skins:
        table.append(row(model, number, options.folder))
        rows.say(" | ".join(table[-1]))
    print(rows.markdown(HEADER, table))


if __name__ == "__main__":
    main()
