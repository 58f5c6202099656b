"""Defines the arrays that the compiled core of the reduced model takes (`kernels`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayeskin.types import Array


class System(NamedTuple):
    """Modes and weights at n points, the base law's constants there, and the linear part that points miss.

    gradient (n, 9, k) : gradients of the k displacement fields: the pads' field, the dual field and the modes
    pressure (n, m), slope (n, 3, m) : pressure modes and their gradients
    weight (n,) : weights of the points [m^3]; mu, lam, mobility, storage (n,) : constants of the base law
    solid (k, k), coupling (k, m), flow (m, m) : matrices that add the missing part to the residual; flow is a
        rate, multiplied by the length of the stage

    gradient, pressure and slope are in single precision, which is the precision of the modes.
    """

    gradient: Array
    pressure: Array
    slope: Array
    weight: Array
    mu: Array
    lam: Array
    mobility: Array
    storage: Array
    solid: Array
    coupling: Array
    flow: Array


class Laws(NamedTuple):
    """The l laws of mechanisms, in the order in which they are evaluated.

    respond, linearise (l,) : addresses of their kernels, 0 where a law has none
    par, data : flat arrays of the constants of all laws, for the run and for the points
    par_at, data_at, memory_at (l + 1,) : index at which the part of each law begins in its flat array
    data_width, memory_width (l,) : how many constants and memory values each law has at a point
    """

    respond: np.ndarray
    linearise: np.ndarray
    par: Array
    par_at: np.ndarray
    data: Array
    data_width: np.ndarray
    data_at: np.ndarray
    memory_width: np.ndarray
    memory_at: np.ndarray


class History(NamedTuple):
    """The history of a stage.

    volume, pressure (n,) : J* and p*; memory : memory of all laws, flat
    displacement (k,) : coefficients x* of the displacement
    length_s : h*; elapsed_s : time since the memory was stored
    time_s : time from the start of the test to the end of the stage
    """

    volume: Array
    pressure: Array
    memory: Array
    displacement: Array
    length_s: float
    elapsed_s: float
    time_s: float


class Room(NamedTuple):
    """Arrays at n points that a solve fills: kinematics, response of the laws, and the state at the end."""

    deformation: Array
    at_pressure: Array
    at_slope: Array
    stress: Array
    content: Array
    flux: Array
    volume: Array
    memory: Array
