"""Adds full runs to a design, and trains the surrogate again with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from bayeskin import storage
from bayeskin.design import Wave
from bayeskin.forward.design_model import ForceModel
from bayeskin.surrogates import load_manifest, load_surrogate, manifest_of, save_surrogate
from bayeskin.types import Array, BinnedForce, Design, PadMotion, Simulation, Surrogate
from bayeskin.workflow.design_runs import joined, run_wave
from bayeskin.workflow.engine import Run
from bayeskin.workflow.model import full_model, waves_model
from bayeskin.workflow.training import corrected, fine_design, trained


class Refining:
    """The designs of a stage with the runs that are added to them, and the surrogate trained last."""

    def __init__(self, run: Run, binned: BinnedForce, stage: str, surrogate: str) -> None:
        self.run, self.binned = run, binned
        self.design = storage.load(run.at(stage, "design.h5"), Design)
        self.fine = fine_design(run, stage)
        self.surrogate = load_surrogate(run.at(surrogate, "surrogate.h5"))
        self.manifest = load_manifest(run.at(surrogate, "surrogate.h5"))

    def retrain(self, theta: Mapping[str, float], simulation: Simulation) -> Surrogate:
        """Returns the surrogate after training with one more run of the configuration's model."""
        self.run.reporter.log(
            "map: the surrogate is not accurate at this point; the run is added to the design"
        )
        return self.learn(_as_design(self.design, theta, simulation))

    def learn(self, runs: Design) -> Surrogate:
        """Returns the surrogate after training with more runs of the configuration's model.

        Failed runs are left out.
        """
        waves = runs
        if self.fine is not None:
            waves = runs_at(self.run, "coarse model", runs, waves_model(self.run))
        self.design = _extended(self.design, waves)
        self.surrogate, validation = trained(self.run, self.design, self.binned)
        if self.fine is not None:
            self.fine = _extended(self.fine, runs)
            self.surrogate, validation = corrected(self.run, self.surrogate, self.fine, self.binned)
        self.manifest = {**self.manifest, **manifest_of(self.surrogate, validation)}
        return self.surrogate

    def save(self, stage: str) -> None:
        """Writes the surrogate and the designs into a stage's folder."""
        save_surrogate(self.run.at(stage, "surrogate.h5"), self.surrogate, self.manifest)
        storage.save(self.run.at(stage, "design.h5"), self.design)
        if self.fine is not None:
            storage.save(self.run.at(stage, "fine.h5"), self.fine)


def full_runs(run: Run, label: str, points: Design) -> Design:
    """Returns the points of a design with the results of the configuration's model."""
    return runs_at(run, label, points, full_model(run))


def runs_at(run: Run, label: str, points: Design, model: ForceModel) -> Design:
    """Returns the points of a design with the results of a model; runs are stored, so none is made twice."""
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    training = np.zeros(len(points.theta), bool)
    wave = Wave(points.space, points.theta, training, 0, run.config.seed, {"rule": label})
    return run_wave(run, label, wave, points.edges_s, model, motion)


def points_like(design: Design, theta: Array) -> Design:
    """Returns a design of points (n, d) that have not been run, with the space and bins of another design."""
    n, bins = len(theta), len(design.edges_s) - 1
    return dataclasses.replace(
        design, theta=theta, force_n=np.full((n, bins), np.nan), wave=np.zeros(n, dtype=np.int64),
        held_out=np.zeros(n, bool), ok=np.zeros(n, bool), messages=("",) * n, seconds=np.full(n, np.nan),
    )  # fmt: skip


def _as_design(like: Design, theta: Mapping[str, float], simulation: Simulation) -> Design:
    """Returns one run as a design with one point."""
    point = points_like(like, np.array([[theta[name] for name in like.space.names]]))
    return dataclasses.replace(
        point, force_n=simulation.bin_means(like.edges_s)[None], ok=np.array([True]),
        messages=(simulation.message,), seconds=np.array([simulation.stats["seconds"]]),
    )  # fmt: skip


def _extended(design: Design, runs: Design) -> Design:
    """Returns the design with further training rows, which form a wave of their own."""
    number = np.full(len(runs.theta), design.wave.max() + 1)
    return joined([design, dataclasses.replace(runs, wave=number)])
