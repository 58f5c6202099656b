"""Validates the diagnosis on simulated recordings in which effects are concealed.

The package makes these recordings with sealed keys, and scores the diagnoses of them against the keys. No
module that diagnoses imports this package, and this package imports no module that diagnoses.
"""

from bayeskin.proof.conceal import conceal
from bayeskin.proof.scoring import score
from bayeskin.proof.seals import closed

__all__ = ["closed", "conceal", "score"]
