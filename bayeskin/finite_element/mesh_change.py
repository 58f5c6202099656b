"""Computes the change of the displacements of markers from a coarse mesh to the usual one.

Near the clamped edges of the pads a mesh is too stiff, so the skin between the pads moves too far. From mesh
to mesh this error shrinks by a nearly constant factor, and it hardly depends on the skin (docs/markers.md).
The change from 80 to 448 bricks therefore shows the shape of the error that the usual mesh still has.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.simulate import ModelSpec, problem_of, simulate
from bayeskin.finite_element.surface_points import SurfaceTracks, surface_displacement
from bayeskin.types import Array, Markers, PadMotion

COARSE, USUAL = 0, 1  # refinements of the bricks
SKIN = {"E_c": 140e3, "E_s": 22e3, "k_c": 3e-14, "k_s": 3e-14, "p_init": 0.0}  # the middle of the priors


def mesh_change(spec: ModelSpec, motion: PadMotion, markers: Markers) -> Array:
    """Returns the change (t - 1, p, 2) [m] of the markers' displacements from the coarse to the usual mesh.

    Raises InputError where a run fails, and for a marker outside the skin.
    """
    moved_m = []
    for refinement in (COARSE, USUAL):
        problem = problem_of("bricks", refinement, spec.geometry)
        tracks = SurfaceTracks(surface_displacement(problem, markers.reference_m))
        finer = replace(spec, mesh="bricks", refinement=refinement)
        simulation = simulate(finer, motion, SKIN, on_state=tracks.on_state)
        if simulation.status != "ok":
            failed = f"the full model fails on {problem.mesh.name}: {simulation.message}"
            raise InputError("markers", failed, "without its run the error of the mesh is not known")
        moved_m.append(tracks.since_first(simulation, markers.time_s))
    return np.asarray(moved_m[1] - moved_m[0])
