"""The catalogue of mechanisms as a table: parameters with priors and neutral values, and look-alikes.

    python benchmarks/catalogue_table.py

Writes the table between its markers of docs/mechanisms.md.
"""

from __future__ import annotations

from pathlib import Path

import rows

from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.types import Parameter

PAGE = Path(__file__).parents[1] / "docs" / "mechanisms.md"
HEADER = ("mechanism", "acts on", "parameters", "look-alikes")


def table() -> str:
    """All mechanisms that come with bayeskin, by name."""
    return rows.markdown(HEADER, [_line(one) for _, one in sorted(catalogue().items())])


def _line(mechanism: Mechanism) -> list[str]:
    others = [f"`{name}`" for name in mechanism.group if name != mechanism.name]
    place = "instrument" if isinstance(mechanism.act, Instrument) else "tissue"
    if place == "instrument" and mechanism.act.bind is not None:
        place = "displacement, in series with the skin"
    parameters = "; ".join(_told(p, mechanism.neutral.get(p.name)) for p in mechanism.parameters)
    return [f"`{mechanism.name}`", place, parameters, ", ".join(others)]


def _told(parameter: Parameter, neutral: float | None) -> str:
    unit = "" if parameter.unit in ("1", "-") else f" {parameter.unit}"
    off = "" if neutral is None else f" ({neutral:g})"
    span = f"{parameter.lower:.3g} to {parameter.upper:.3g}{unit}"
    law = f"{parameter.prior}, offset {parameter.offset:.0e}" if parameter.offset else parameter.prior
    return f"`{parameter.name}` {span}, {law}{off}: {parameter.description}"


def main() -> None:
    print(table())
    rows.into_docs(PAGE, "catalogue", table())


if __name__ == "__main__":
    main()
