"""The data types that the parts of bayeskin exchange: frozen, in SI units, with the unit in the name.

Arrays in these types are read-only; `dataclasses.replace` makes a changed copy. In shapes, ``n`` counts
samples or parameter points, ``d`` parameters, ``m`` time bins, and ``k`` corners. Files that bayeskin writes
name each dataclass of this package, so a dataclass keeps its name.
"""

from bayeskin.types.arrays import Array, FreezesArrays, frozen_array
from bayeskin.types.design import Design
from bayeskin.types.joint import Span
from bayeskin.types.markers import Markers
from bayeskin.types.parameters import STIFFEST_BELOW, Correlation, Parameter, ParameterSpace
from bayeskin.types.protocol import PHASE_IN_WORDS, PHASE_KINDS, PadMotion, Phase, PhaseKind
from bayeskin.types.provenance import Provenance
from bayeskin.types.recording import BinnedForce, Jumps, Recording
from bayeskin.types.simulation import Observation, Simulation
from bayeskin.types.surrogate import POINTS_AT_ONCE, Prediction, Surrogate

__all__ = [
    "PHASE_IN_WORDS",
    "PHASE_KINDS",
    "POINTS_AT_ONCE",
    "STIFFEST_BELOW",
    "Array",
    "BinnedForce",
    "Correlation",
    "Design",
    "FreezesArrays",
    "Jumps",
    "Markers",
    "Observation",
    "PadMotion",
    "Parameter",
    "ParameterSpace",
    "Phase",
    "PhaseKind",
    "Prediction",
    "Provenance",
    "Recording",
    "Simulation",
    "Span",
    "Surrogate",
    "frozen_array",
]
