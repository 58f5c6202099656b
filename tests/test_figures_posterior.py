"""Figures of a posterior: regions, profiles, the check by the full model; names, units, numbers at axes."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from toys.closed_form_model import SPACE
from toys.figure_inputs import DRAWS, TRUTH, drawn, headline, labels

from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.inference import Corrected, Profile, Weighed
from bayeskin.inference.convergence import Verdict
from bayeskin.number_format import unit_text
from bayeskin.report import posterior, style, triangle
from bayeskin.types import Parameter, ParameterSpace

pytestmark = pytest.mark.filterwarnings("error")


def test_posterior_says_what_the_recording_leaves_open() -> None:
    figure = drawn(report.figure_posterior(SPACE, DRAWS, dict(zip(SPACE.names, TRUTH, strict=True))))
    assert len(figure.axes) == 15
    assert "log$_{10}$ $E_{c}$ / Pa" in labels(figure)
    assert "$p_{\\mathrm{init}}$ [Pa]" in labels(figure)
    narrowed, left = headline(figure).split("leaves")
    assert "E_{s}" in narrowed
    assert "k_{c}" in left
    assert "init" in left
    flat = next(ax for ax in figure.axes if ax.get_subplotspec().get_geometry()[2:] == (22, 22))
    assert not flat.collections  # p_init over k_c: tinted evenly, no contour of sampling scatter


def test_posterior_of_a_chosen_pair_and_of_one() -> None:
    assert len(drawn(report.figure_posterior(SPACE, DRAWS, {}, names=("E_s", "k_s"))).axes) == 3
    assert len(drawn(report.figure_posterior(SPACE, DRAWS, {}, names=("p_init",))).axes) == 1
    with pytest.raises(InputError, match="E_q"):
        report.figure_posterior(SPACE, DRAWS, {}, names=("E_q",))


def test_posterior_that_does_not_move() -> None:
    constant = np.tile(TRUTH, (50, 1))
    assert len(drawn(report.figure_posterior(SPACE, constant, {"E_c": 1.2e5})).axes) == 15


def test_posterior_of_eleven_parameters() -> None:
    further = tuple(Parameter(f"gap_{c}_length", "m", 1e-6, 3e-4, "uniform") for c in "abcdef")
    wide = np.column_stack([DRAWS, np.random.default_rng(7).uniform(1e-6, 3e-4, (2000, 6))])
    space = ParameterSpace(SPACE.parameters + further)
    figure = report.figure_posterior(space, wide, {})
    assert len(figure.axes) == 66
    assert figure.get_figwidth() > style.PAGE_IN


def test_regions_hold_their_share_of_a_correlated_normal() -> None:
    rng = np.random.default_rng(8)
    x = rng.normal(size=20_000)
    y = 0.95 * x + np.sqrt(1 - 0.95**2) * rng.normal(size=20_000)
    span = np.array([-4.0, 4.0])
    x_mid, y_mid, density, flat = posterior.smoothed_histogram(x, y, span, span)
    assert not flat
    cell = density[np.searchsorted(x_mid, x).clip(0, 79), np.searchsorted(y_mid, y).clip(0, 79)]
    for share, level in zip((0.5, 0.9), posterior.mass_levels(density, (0.5, 0.9)), strict=True):
        assert np.mean(cell >= level) == pytest.approx(share, abs=0.05)


def test_mass_levels_of_a_known_density() -> None:
    """The region of exp(-r^2/2) that holds a share s of the mass is bounded at the height 1 - s."""
    axis = np.linspace(-6, 6, 241)
    density = np.exp(-0.5 * (axis[:, None] ** 2 + axis**2))
    np.testing.assert_allclose(posterior.mass_levels(density, (0.5, 0.9)), [0.5, 0.1], atol=0.002)


def test_numbers_stay_clear_of_the_corners() -> None:
    assert triangle.inner_ticks(0.0, 10.0, 4) == [2.0, 4.0, 6.0, 8.0]
    assert triangle.inner_ticks(-16.0, -11.0, 4) == [-15.0, -14.0, -13.0, -12.0]
    for low, high in [(3.75, 4.52), (-670.0, 2144.0), (0.0, 1e-6), (4.26, 4.2601)]:
        ticks = triangle.inner_ticks(low, high, 3)
        assert 2 <= len(ticks) <= 3
        assert low < ticks[0] < ticks[-1] < high


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("E_c", "$E_{c}$"), ("p_init", r"$p_{\mathrm{init}}$"),
        ("tau_1", r"$\tau_{1}$"), ("tau1", r"$\tau_{1}$"),
        ("F0", "$F_{0}$"), ("Fc", "$F_{c}$"), ("g", "$g$"), ("loss_of_force", "loss of force"),
        ("gap", "gap"), ("noise_sd", "noise sd"), ("mu", r"$\mu$"),
    ],
)  # fmt: skip
def test_names_are_set_as_symbols_or_words(name: str, printed: str) -> None:
    assert style.symbol(name) == printed


def test_units_are_printed_with_raised_powers() -> None:
    assert unit_text("m^2") == "m²"
    assert unit_text("mm N^-1 s^-1") == "mm N⁻¹ s⁻¹"
    assert unit_text("-") == ""


def profile(name: str, top: float, deep: bool) -> Profile:
    p = SPACE.parameters[SPACE.names.index(name)]
    values = SPACE.from_unit(np.repeat(np.linspace(0, 1, 9)[:, None], 5, axis=1))[:, SPACE.names.index(name)]
    drop = -50.0 * (np.linspace(0, 1, 9) - top) ** 2 if deep else np.zeros(9)
    return Profile(name, values, drop, (p.lower, p.upper), not deep, not deep)


def test_profiles_name_what_the_fit_does_not_exclude() -> None:
    some = [profile("E_c", 0.5, True), profile("p_init", 0.5, False)]
    figure = drawn(report.figure_profiles(SPACE, DRAWS, some))
    assert "excludes no value of" in headline(figure)
    assert "init" in headline(figure)
    assert "E_c" not in headline(figure)
    assert "bounds every parameter" in headline(drawn(report.figure_profiles(SPACE, DRAWS, some[:1])))


def test_profiles_of_many_parameters_take_several_rows() -> None:
    names = [f"x{i}" for i in range(10)]
    space = ParameterSpace(tuple(Parameter(name, "Pa", 1.0, 2.0, "uniform") for name in names))
    values = np.linspace(1.0, 2.0, 5)
    some = [Profile(name, values, -values, (1.0, 2.0), False, False) for name in names]
    figure = drawn(report.figure_profiles(space, np.linspace(1.0, 2.0, 40).reshape(4, 10), some))
    assert len([ax for ax in figure.axes if ax.lines]) == 10
    assert len({round(ax.get_position().y0, 3) for ax in figure.axes}) == 2


def test_the_model_check_says_what_moves_most() -> None:
    weights = np.array([0.4, 0.3, 0.2, 0.1])
    weighed = Weighed(SPACE, DRAWS[:4], np.log(weights), weights, 10 / 3, float("nan"), Verdict(True, ("",)))
    quantiles = (0.5, 1.0, 2.0)
    moved = [Corrected(n, quantiles, -0.8 if n == "k_s" else 0.1, 0.05, 1.0) for n in SPACE.names]
    figure = drawn(report.figure_model_check(weighed, moved))
    assert "Of 4 draws with full runs, 3 are effective" in headline(figure)
    assert "k_" in headline(figure)
    assert "0.80 of its sd" in headline(figure)


def test_names_along_a_large_triangle_do_not_run_into_each_other() -> None:
    names = ("sd_rest", "sd_load", "sd_hold", "sd_unload", *(f"E_{letter}" for letter in "abdefgh"))
    parameter = dataclasses.replace(SPACE.parameters[0], unit="N", prior="log-uniform", lower=1e-4, upper=0.3)
    space = ParameterSpace(tuple(dataclasses.replace(parameter, name=name) for name in names))
    draws = 10.0 ** np.random.default_rng(1).uniform(-3.5, -1.0, (400, len(names)))
    figure = drawn(report.figure_posterior(space, draws, {}))
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes if ax.get_ylabel()]
    boxes.sort(key=lambda box: -box.y1)
    assert len(boxes) == 10
    assert all(lower.y1 <= upper.y0 for upper, lower in itertools.pairwise(boxes))
