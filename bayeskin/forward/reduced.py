"""Uses the reduced model of a device as a forward model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ModelRun, change
from bayeskin.forward.observed import beside_neutral
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import REGION
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.reduced.surface import SurfaceRun, simulate_surface
from bayeskin.types import Array, Markers, PadMotion, ParameterSpace, Simulation


@dataclass(frozen=True)
class ReducedForward:
    """The reduced model of a device on a protocol.

    edges_s (m+1,) : edges of the bins [s]; markers : tracks of points whose displacements are computed too
    """

    model: ReducedModel
    motion: PadMotion
    edges_s: Array
    markers: Markers | None = None

    @property
    def solves(self) -> frozenset[str]:
        """Returns the tissue mechanisms that it was trained for, and those in series with the skin."""
        in_series = (m.name for m in catalogue().values() if isinstance(m.act, Instrument) and m.act.bind)
        return frozenset({*self.model.trained.mechanisms, *in_series})

    @property
    def hash(self) -> str:
        return self.model.hash

    @property
    def spec(self) -> ModelSpec:
        """Returns the specification of the full model that it was made from."""
        return ModelSpec(refinement=self.model.refinement, geometry=self.model.trained.geometry)

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns a run, or the reason why it failed.

        Derivatives by a parameter at its neutral value are computed beside that value. The force is then
        extrapolated back to the neutral value.
        """
        by = dict(zip(space.names, map(float, change(space, at)), strict=True))
        values = dict(zip(space.names, map(float, at), strict=True))
        if derive:
            values |= beside_neutral(values, by, mechanisms)
        run = self._with_markers(values, mechanisms, by if derive else None)
        simulation, markers_m, marker_slopes_m = run.simulation, run.displacement_m, run.slopes_m
        if simulation.status != "ok":
            return simulation.message
        force_n = simulation.bin_means(self.edges_s)
        if not derive:
            return ModelRun(at, force_n, None, markers_m)
        if not np.all(np.isfinite(simulation.gradient_n)):
            return "the derivatives of the run are not finite"
        slopes_n = simulation.gradient_bin_means(self.edges_s)
        offset = np.array([(values[name] - wanted) / by[name] for name, wanted in zip(by, at, strict=True)])
        if markers_m is not None and marker_slopes_m is not None:
            markers_m = markers_m - marker_slopes_m @ offset
        return ModelRun(at, force_n - slopes_n @ offset, slopes_n, markers_m, marker_slopes_m)

    def _with_markers(
        self, values: Mapping[str, float], mechanisms: Sequence[Mechanism], by: Mapping[str, float] | None
    ) -> SurfaceRun:
        """Returns a run on the recording's protocol, with the displacements of markers where there are any.

        by : changes of parameters to differentiate by
        """
        if self.markers is None:
            return SurfaceRun(self.simulated(self.motion, values, mechanisms, by))
        return simulate_surface(
            self.model, self.motion, values, mechanisms, by, self.markers.reference_m, self.markers.time_s,
            REGION.least_stiffness_if_checked,
        )  # fmt: skip

    def simulated(
        self, motion: PadMotion, values: Mapping[str, float], mechanisms: Sequence[Mechanism],
        by: Mapping[str, float] | None = None,
    ) -> Simulation:  # fmt: skip
        """Returns a simulation on any protocol; by : changes of parameters to differentiate by."""
        return simulate_reduced(
            self.model, motion, values, mechanisms, by, least_stiffness=REGION.least_stiffness_if_checked
        )

    def errors(self, at: Array) -> Array:
        """Returns no errors (0, m), since the reduced model states none. Runs of the full model show them."""
        return np.zeros((0, len(self.edges_s) - 1))


def stands_for(spec: ModelSpec) -> bool:
    """Returns whether a reduced model can replace a full model."""
    return spec.formulation.reducible and spec.mesh == "bricks"
