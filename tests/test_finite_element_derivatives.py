"""The check of a law's derivatives passes all laws of the catalogue, and sees each kind of mistake."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toys.skin_with_mechanisms import SOLVED, THETA, TISSUE, strong

from bayeskin.errors import InputError
from bayeskin.finite_element.derivative_check import derivative_errors
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.tissue import TissueLaw


@respond_kernel
def coupled(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):
    """Changes stress and content by the pressure, and the flux by the deformation."""
    for n in range(len(pressure)):
        stress[n, 0, 1] += par[0] * pressure[n] ** 2
        content[n] += par[1] * pressure[n] ** 2
        flux[n] *= deformation[n, 0, 0] ** 2


@linearise_kernel
def its_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before,
    stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """States those by the pressure, and forgets that of the flux by the deformation."""
    for n in range(len(pressure)):
        stress_p[n, 1] += 2.0 * par[0] * pressure[n]
        content_p[n] += 2.0 * par[1] * pressure[n]
        flux_g[n] *= deformation[n, 0, 0] ** 2


@pytest.mark.parametrize("name", SOLVED)
@pytest.mark.parametrize("seed", [0, 1])
def test_all_laws_of_the_catalogue_have_the_derivatives_of_their_response(name, seed):
    errors = derivative_errors(SOLVED[name].act.bind, strong(name), seed)
    assert max(errors.values()) < 1e-5, errors


def test_a_forgotten_derivative_is_seen_where_it_is_missing():
    law = TissueLaw(par=np.array([0.01, 1e-7]), respond=coupled, linearise=its_derivatives)
    errors = derivative_errors(lambda values, sites: dataclasses.replace(law, data=sites.table()), THETA)
    wrong = {name for name, error in errors.items() if error > 1e-5}
    assert wrong == {"flux by F"}
    assert errors["flux by F"] == pytest.approx(1.0)


def test_a_memory_that_is_not_filled_is_refused():
    law = TISSUE["preconditioning"].act.bind
    with pytest.raises(InputError, match="1 of 2 numbers of the memory"):
        derivative_errors(lambda v, s: dataclasses.replace(law(v, s), remembers=2), strong("preconditioning"))
