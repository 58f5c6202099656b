"""The proof: recordings in which an effect is concealed, and what a diagnosis of them is worth.

Nothing that diagnoses imports this package, and it imports nothing that diagnoses.
"""

from bayeskin.proof.conceal import conceal
from bayeskin.proof.score import score
from bayeskin.proof.seals import closed

__all__ = ["closed", "conceal", "score"]
