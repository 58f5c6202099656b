"""Coarse proposals of the sampler, which it learns quickly. They change its pace, not what it samples."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bayeskin.inference import proposal


def propose_coarsely(patch: pytest.MonkeyPatch) -> None:
    """Lets the sampler learn mixtures of four components in two rounds."""
    patch.setattr(proposal, "MIXTURE", replace(proposal.MIXTURE, components=4, rounds=2))
