"""A skin and a screen of closed form, with which the cases of the proof are made and diagnosed quickly."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from bayeskin.design import default_space
from bayeskin.mechanisms import catalogue, observed
from bayeskin.mechanisms.binned import BinnedForces
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.proof import conceal
from bayeskin.proof.cases import Case
from bayeskin.proof.conceal import Concealed, concealed
from bayeskin.proof.outside import Change
from bayeskin.proof.plans import Plan
from bayeskin.proof.protocol import EDGES_S, MOTION
from bayeskin.proof.refit_residual import Refit
from bayeskin.proof.screen import Screen
from bayeskin.types import Prediction, Simulation

SEED, COUNT = 5, 4
THETA = {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 0.0}


class QuickSkin:
    """A surrogate of two moduli and two relaxations, each with its share of the force."""

    space, edges_s, provenance = default_space(), EDGES_S, {}

    def predict(self, theta) -> Prediction:
        e_c, e_s, k_c, k_s = np.atleast_2d(theta).T[:4, :, None]
        middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
        u = MOTION.at(middle) / 1e-2
        late = lfilter([0.1], [1.0, -0.9], u)
        relaxing = 0.02 * (np.log(k_c / 1e-14) + 2.0 * np.log(k_s / 1e-14)) * late
        mean = (4e-6 * e_c + 1e-5 * e_s) * u * (1.0 + 0.05 * u * e_s / (e_c + e_s)) + 0.05 * relaxing
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros_like(mean))

    def predict_mean(self, theta):
        return self.predict(theta).mean


class QuickScreen(Screen):
    """The force of `QuickSkin` as the instrument reports it; mechanisms of the tissue have no effect."""

    def force(self, names, theta, values):
        mean_n = self.refit.force(theta)
        seen = [self.known[name] for name in names if isinstance(self.known[name].act, Instrument)]
        forces = BinnedForces(EDGES_S, MOTION, seen)
        return mean_n + forces.change(partial(observed, seen, values, MOTION), mean_n)


SKIN = QuickScreen(Refit(QuickSkin()), None, catalogue())


def quick_run(case: Case, names, change: Change) -> Simulation:
    """`QuickSkin` in the place of the full model."""
    theta = np.array([[case.theta[name] for name in SKIN.refit.surrogate.space.names]])
    values = {name: np.array([value]) for name, value in case.values.items()}
    force_n = SKIN.force(names, theta, values)[0]
    time_s = np.concatenate([[0.0], 0.5 * (EDGES_S[1:] + EDGES_S[:-1]), MOTION.time_s[-1:]])
    force_n = np.concatenate([[0.0], force_n, force_n[-1:]])
    corner = np.ones(len(time_s), dtype=bool)  # straight between
    return Simulation(case.theta, time_s, MOTION.at(time_s), force_n, corner, "ok", "", {}, "")


def quickly(plan: Plan) -> Concealed:
    return concealed(plan, SKIN, quick_run)


def one_by_one(function, items):
    yield from ((index, function(item)) for index, item in enumerate(items))


def conceal_quickly(folder: Path) -> None:
    """Makes a set of `COUNT` recordings in a folder."""
    assert conceal(folder, SEED, COUNT, make=quickly, run_all=one_by_one) == COUNT


def nothing_found(sources: list[Path], reporter) -> dict:
    return {"verdict": "nothing-missing", "located": [], "mechanisms": [], "fit": {"after": {}}}
