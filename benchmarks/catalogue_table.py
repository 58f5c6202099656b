"""Prints the catalogue of mechanisms as a table: parameters with priors and neutral values, and look-alikes.

    python benchmarks/catalogue_table.py

The program writes the table between its markers of docs/mechanisms.md.
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
    """Returns a Markdown table of all mechanisms that come with bayeskin, in the order of their names."""
    return rows.markdown(HEADER, [_line(mechanism) for _, mechanism in sorted(catalogue().items())])


def _line(mechanism: Mechanism) -> list[str]:
    """Returns the table's row of a mechanism."""
    look_alikes = [f"`{name}`" for name in mechanism.group if name != mechanism.name]
    place = "instrument" if isinstance(mechanism.act, Instrument) else "tissue"
    if place == "instrument" and mechanism.act.bind is not None:
        place = "displacement, in series with the skin"
    parameters = "; ".join(_description(p, mechanism.neutral.get(p.name)) for p in mechanism.parameters)
    return [f"`{mechanism.name}`", place, parameters, ", ".join(look_alikes)]


def _description(parameter: Parameter, neutral: float | None) -> str:
    """Returns a parameter's range, prior, neutral value and description in one phrase."""
    unit = "" if parameter.unit in ("1", "-") else f" {parameter.unit}"
    neutral_value = "" if neutral is None else f" ({neutral:g})"
    prior_range = f"{parameter.lower:.3g} to {parameter.upper:.3g}{unit}"
    prior = f"{parameter.prior}, offset {parameter.offset:.0e}" if parameter.offset else parameter.prior
    return f"`{parameter.name}` {prior_range}, {prior}{neutral_value}: {parameter.description}"


def main() -> None:
    print(table())
    rows.into_docs(PAGE, "catalogue", table())


if __name__ == "__main__":
    main()
