"""Defines the numeric settings of a search for mechanisms."""

from __future__ import annotations

from dataclasses import dataclass

from bayeskin.mismatch.fit import SAME_MAXIMUM


@dataclass(frozen=True)
class SearchSettings:
    """Settings of a search. Weights and gains are in nats.

    Starting points of the base model
    skins : number of tissues, spread over the prior, with which the model runs at first
    starts, best : number of base fits that start from the nearest of these tissues, and number of fits that
        are always continued

    Effort of a fit
    first, runs : largest number of model runs of a fit before it is compared with others, and in total
    behind : difference in weight from the best set from which a fit is given up
    again : shares of a mechanism's strength with which a fit starts again after it failed

    Candidate mechanisms
    probes, off : number of runs for each part of a tissue mechanism, and their distance from the neutral
        value, as a share of the prior
    shortlist : largest number of mechanisms that are fitted in addition to a set
    promised : smallest promised gain of a mechanism that is fitted, where more than noise is left; score
        tests promise too little while a missing mechanism biases the tissue's parameters
    gain : smallest gain in weight for which the search continues; most : largest number of mechanisms

    Other tissues
    astray : gain in weight from which a missing mechanism may have biased the tissue of the smaller set
    near, alike : share of the best gain from which sets are fitted from other tissues, and their largest
        number
    others, tried : number of tissues with which a set runs, and number of those from which it is fitted
    left : RMS residual, divided by the RMS noise, from which more than noise is left

    Checks by the full model
    close : largest difference in weight from the best set with which a set is checked, or counts as likely
    compared, checks : largest number of sets that are checked in a round, and of rounds
    weighed : number of sets whose hypotheses are compared
    exact : largest error of the forward model that needs no correction, RMS over bins, divided by the noise

    Further maxima
    rival : difference in log-probability from the most probable set, up to which a set could become as likely
    shapes : number of shapes of each part of a mechanism from which further maxima are searched for
    ends, ratios : positions of a permeability in its prior, and ratios of the moduli, from which fits start
    maxima : largest number of further maxima that are kept
    alike_by : largest difference between two runs that count as the same maximum, as a share of the prior
    """

    skins: int = 32
    starts: int = 4
    best: int = 2
    first: int = 4
    runs: int = 9
    behind: float = 12.0
    again: tuple[float, ...] = (1.0, 0.2)
    probes: int = 3
    off: float = 0.25
    shortlist: int = 4
    promised: float = 1.0
    gain: float = 1.0
    most: int = 6
    astray: float = 10.0
    near: float = 0.8
    alike: int = 3
    others: int = 16
    tried: int = 2
    left: float = 1.1
    close: float = 6.0
    compared: int = 6
    checks: int = 4
    weighed: int = 6
    exact: float = 0.05
    rival: float = 20.0
    shapes: int = 2
    ends: tuple[float, float] = (0.1, 0.9)
    ratios: tuple[float, ...] = (0.05, 0.2, 0.6, 1.5)
    maxima: int = 3
    alike_by: float = SAME_MAXIMUM
