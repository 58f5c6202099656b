"""Compares the verdicts of a set with their keys, and counts how often they are right."""

from bayeskin.proof.scoring.scoreboard import score

__all__ = ["score"]
