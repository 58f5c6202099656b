"""Coarse proposals of the sampler, which it makes quickly. They change its pace, not what it samples."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bayeskin.inference import moves, proposal


def propose_coarsely(patch: pytest.MonkeyPatch) -> None:
    """Lets the sampler learn mixtures of four components in two rounds, and try a single point at a time."""
    patch.setattr(proposal, "MIXTURE", replace(proposal.MIXTURE, components=4, rounds=2))
    patch.setattr(moves, "MOVES", replace(moves.MOVES, tries=1))
