"""Defines the two signatures of the compiled kernels of all tissue laws.

The full and the reduced models call the same kernels. A kernel evaluates a law at n points, one after the
other. The points may belong to any model. All arrays are C-contiguous and hold doubles:

    respond(time_s, elapsed_s, par, data, deformation, pressure, gradient,
            before, after, stress, content, flux)
    linearise(time_s, elapsed_s, par, data, deformation, pressure, gradient,
              before, stress_f, stress_p, content_f, content_p, flux_f, flux_g)

time_s : time [s] at the end of the solve, since the start of the test; 0 before the start
elapsed_s : time [s] since the memory `before` was stored
par (k,), data (n, d) : constants of the run, and constants of each point
deformation (n, 3, 3), pressure (n,), gradient (n, 3) : F, p [Pa] and grad p [Pa/m]
before, after (n, m) : the law's memory at the start and at the end of the solve; `respond` fills all of
    `after`
stress (n, 3, 3), content (n,), flux (n, 3) : the response of the base law and of the laws that were evaluated
    before this one; the kernel changes it in place. The stress is the first Piola-Kirchhoff stress with the
    pressure of the fluid, P = P_e - p J F^-T (`bayeskin.mechanisms.elastic` gives P_e). The flux is that over
    the whole solve
stress_f (n, 9, 9), stress_p, content_f (n, 9), content_p (n,), flux_f (n, 3, 9), flux_g (n, 3, 3) : the
    derivatives of that response with respect to deformation (as rows of nine), pressure and gradient; the
    kernel changes them in place

numba compiles a kernel when its module is imported for the first time, and loads it from its cache
afterwards.
"""

from __future__ import annotations

import numba
from numba.core.types import float64, void

from bayeskin.finite_element.assembly import SETTINGS

_VECTOR, _ROWS, _MATRICES = float64[::1], float64[:, ::1], float64[:, :, ::1]
_GIVEN = (float64, float64, _VECTOR, _ROWS, _MATRICES, _VECTOR, _ROWS, _ROWS)
RESPOND = void(*_GIVEN, _ROWS, _MATRICES, _VECTOR, _ROWS)
LINEARISE = void(*_GIVEN, _MATRICES, _ROWS, _ROWS, _VECTOR, _MATRICES, _MATRICES)

respond_kernel = numba.njit(RESPOND, **SETTINGS)
linearise_kernel = numba.njit(LINEARISE, **SETTINGS)
