"""What the outputs of a run say of where they come from."""

from __future__ import annotations

import bayeskin
from bayeskin.workflow.engine import Run


def caption(run: Run) -> str:
    """One line for a figure's metadata."""
    config = run.config
    return f"bayeskin {bayeskin.__version__}, {config.name}, seed {config.seed}, config {config.sha256[:12]}"
