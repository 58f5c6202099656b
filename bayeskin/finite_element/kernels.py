"""One signature for every tissue law, so that full and reduced models call the same compiled kernels.

A kernel acts on n points, one after the other, of whatever model; all arrays are C-contiguous doubles:

    respond(time_s, elapsed_s, par, data, deformation, pressure, gradient,
            before, after, stress, content, flux)
    linearise(time_s, elapsed_s, par, data, deformation, pressure, gradient,
              before, stress_f, stress_p, content_f, content_p, flux_f, flux_g)

time_s : end of the solve since the test started [s], 0 before; elapsed_s : since `before` was kept
par (k,), data (n, d) : constants of the run, and of each point
deformation (n, 3, 3), pressure (n,), gradient (n, 3) : F, p [Pa] and grad p [Pa/m]
before, after (n, m) : the law's memory at the start and at the end; `respond` fills all of `after`
stress (n, 3, 3), content (n,), flux (n, 3) : what the base law and the laws before answered, to change
stress_f (n, 9, 9), stress_p, content_f (n, 9), content_p (n,), flux_f (n, 3, 9), flux_g (n, 3, 3) : its
derivatives by deformation (rows of nine), pressure and gradient, to change

They are compiled when their module is first imported, and loaded from numba's cache from then on.
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
