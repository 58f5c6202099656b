"""Makes the section of a page on Sobol' indices and Shapley effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.number_format import percent
from bayeskin.report.page.charts import indices_chart
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.figures import pictures
from bayeskin.report.page.parts import Block, Cell, Folded, Section, Table, Text, row
from bayeskin.report.page.sections import absent, phases_of

_INDICES = {
    "prior_gp": "over the prior, Gaussian process",
    "prior_chaos": "over the prior, polynomial chaos",
    "near_map": "near the most probable point",
    "posterior": "over the posterior",
}


def sobol(facts: RunFacts) -> Section:
    """Returns the section on Sobol' indices."""
    summaries = facts.said("sobol")
    blocks: list[Block] = list(absent(facts, "sobol"))
    for name, summary in summaries.items():
        title = _INDICES.get(name, name)
        tables = [_shares(summary)] if "shares" in summary else _indices(summary, title)
        key, indices = f"indices-{name}".replace("_", "-"), facts.indices.get(name)
        blocks += [
            *tables,
            Text([summary["sentence"]]),
            *([indices_chart(key, title, indices, phases_of(facts))] if indices is not None else []),
            *pictures(facts, "sobol", [f"sobol_{name}"]),
            Folded(
                f"Method: {title}",
                [
                    Text(
                        [
                            f"{summary['method']}, {summary['samples']} samples",
                            f"inputs: {summary['distribution']}",
                        ]
                    )
                ],
            ),
        ]
    return Section("sobol", "Sobol' indices", blocks)


def _indices(summary: Mapping[str, Any], title: str) -> list[Block]:
    """Returns a table of first-order and total indices for parameters, and of second-order ones for pairs."""
    pairs = [
        row((pair, Cell(_share(index["second"]), index["second"]), _between(index["second_90"])))
        for pair, index in summary["pairs"].items()
    ]
    return [
        Table(
            f"Sobol' indices aggregated over time, {title}",
            ("parameter", "first order", "90 % interval", "total", "90 % interval"),
            [_index(parameter, index) for parameter, index in summary["aggregated"].items()],
            symbols=True,
        ),
        Folded(
            f"Pairs: {title}",
            [Table(f"Second order, {title}", ("pair", "second order", "90 % interval"), pairs, symbols=True)],
        ),
    ]


def _shares(summary: Mapping[str, Any]) -> Table:
    rows = [
        row((name, Cell(percent(share["share"]), share["share"]), _between(share["share_90"])))
        for name, share in summary["shares"].items()
    ]
    return Table(
        "Shapley effects aggregated over time, over the posterior",
        ("parameter", "share of the variance", "90 % interval"),
        rows,
        symbols=True,
    )


def _index(name: str, index: Mapping[str, Any]) -> tuple[Cell, ...]:
    cells: list[str | Cell] = [name]
    for kind in ("first", "total"):
        cells += [Cell(_share(index[kind]), index[kind]), _between(index[f"{kind}_90"])]
    return row(cells)


def _between(limits: Sequence[float | None]) -> Cell:
    low, high = limits
    return Cell(f"{_share(low)} to {_share(high)}", low)


def _share(value: float | None) -> str:
    """Returns an index with three decimals, because further decimals would only be noise of the estimate."""
    return "–" if value is None else f"{round(value, 3) + 0.0:.3f}".replace("-", "−")
