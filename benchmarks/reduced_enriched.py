"""What a few full runs near a point make of the reduced model's error, on sets of mechanisms.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_enriched.py --folder F [--skins 15 19 23]

Skins are those of reduced_model.py, by number, on the article's protocol; by default its pairs, triples and
quadruples of mechanisms. Before: the error of the shipped model at the skin. After: the error of the enriched
one on the last full run that it predicted, a skin near by that it had not learnt from. Full runs stay in the
folder, so that a second start makes none. Workers are two processes.
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
from bayeskin.workflow.reducing import SHIPPED

HEADER = (
    "skin", "mechanisms", "before [% of peak]", "after, as full runs join [% of peak]", "full runs",
    "CPU s to enrich", "CPU s a run before", "after",
)  # fmt: skip


def spent_s() -> float:
    """Processor seconds of this process and of those that it has ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def row(model: ReducedModel, number: int, folder: Path) -> list[str]:
    """The table's row of one skin."""
    skin, motion = held_out()[number], PROTOCOLS["article"]
    with h5py.File(RESULTS) as handle:
        before = compared(model, motion, skin.theta, skin.mechanisms, handle[f"{number:02d}/article"])
    started = spent_s()
    found = enrich(
        model, skin.theta, skin.mechanisms, motion, EnrichmentSettings(), folder / f"{number:02d}", local(2),
        lambda what, share: None,
    )  # fmt: skip
    enriching = spent_s() - started
    acting, cost = [catalogue()[name] for name in skin.mechanisms], []
    for which in (model, found.model):
        simulate_reduced(which, motion, skin.theta, acting)
        begun = time.process_time()
        simulate_reduced(which, motion, skin.theta, acting)
        cost.append(f"{time.process_time() - begun:.2f}")
    return [
        str(number), ", ".join(skin.mechanisms), before.message or f"{100 * before.rms:.3f}",
        " ".join(f"{100 * error:.3f}" for error in found.errors), str(found.full_runs), f"{enriching:.0f}",
        *cost,
    ]  # fmt: skip


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where full runs stay")
    sets = [number for number, skin in enumerate(held_out()) if len(skin.mechanisms) > 1]
    parser.add_argument("--skins", type=int, nargs="*", default=sets)
    options = parser.parse_args()
    model, table = load_reduced(shipped(SHIPPED)), list[list[str]]()
    for number in options.skins:
        (options.folder / f"{number:02d}").mkdir(parents=True, exist_ok=True)
        table.append(row(model, number, options.folder))
        rows.say(" | ".join(table[-1]))
    print(rows.markdown(HEADER, table))


if __name__ == "__main__":
    main()
