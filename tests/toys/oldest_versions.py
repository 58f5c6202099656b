"""Prints, for pip's -c, the lowest version of each package that pyproject.toml allows: `make test-oldest`."""

import re
import tomllib
from pathlib import Path


def constraints(pyproject: Path) -> list[str]:
    """``name==version`` of every requirement with a lower bound, those of the extra `benchmark` left out."""
    project = tomllib.loads(pyproject.read_text())["project"]
    extras = project["optional-dependencies"]
    asked = [
        *project["dependencies"],
        *(line for name in extras if name != "benchmark" for line in extras[name]),
    ]
    matches = [re.match(r"([A-Za-z0-9_.-]+)>=([0-9.]+)", line) for line in asked]
    return [f"{match[1]}=={match[2]}" for match in matches if match]


if __name__ == "__main__":
    print("\n".join(constraints(Path(__file__).parents[2] / "pyproject.toml")))
