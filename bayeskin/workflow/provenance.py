"""States the origin of a run's outputs."""

from __future__ import annotations

import bayeskin
from bayeskin.workflow.engine import Run


def caption(run: Run) -> str:
    """Returns one line about a figure's origin, for the metadata of its file."""
    config = run.config
    return f"bayeskin {bayeskin.__version__}, {config.name}, seed {config.seed}, config {config.sha256[:12]}"
