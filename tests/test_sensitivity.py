"""Sobol' indices against closed forms (Ishigami, Sobol' g), and on a relaxing spring."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from toys.closed_form_model import SPACE
from toys.ishigami import ONE_BIN, box, ishigami, ishigami_indices

from bayeskin.errors import InputError
from bayeskin.number_format import interval
from bayeskin.sensitivity.estimators import pick_freeze, projection
from bayeskin.sensitivity.result import sentence, uninformed
from bayeskin.sensitivity.sobol import ErrorDrawSettings, error_draws, sobol
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import ParameterSpace, Prediction

METHODS = [pick_freeze, projection]


G_WEIGHTS = np.array([0.0, 1.0, 4.5, 9.0, 99.0])


def sobol_g(x):
    return np.prod((np.abs(4 * x - 2) + G_WEIGHTS) / (1 + G_WEIGHTS), axis=1)[:, None]


def sobol_g_indices():
    part = 1 / (3 * (1 + G_WEIGHTS) ** 2)
    variance = np.prod(1 + part) - 1
    return part / variance, part * np.prod(1 + part) / (1 + part) / variance


def relaxing_force(theta, time_s):
    """Force [N] (n, m) of two springs, of which one relaxes at a rate that k_s sets; k_c, p_init inert."""
    e_c, e_s, _, k_s, _ = np.atleast_2d(theta).T
    rate = 0.05 * (1.0 + np.log10(k_s * 1e16))
    stiffness = 0.3 * e_c[:, None] + 3.0 * e_s[:, None] * (0.3 + 0.7 * np.exp(-rate[:, None] * time_s))
    return 1e-6 * stiffness * np.minimum(time_s, 1.0)


@dataclass(frozen=True)
class KnownSurrogate:
    """`relaxing_force`, with an error of `share` of it."""

    share: float
    space = SPACE
    edges_s = np.linspace(0.0, 20.0, 21)
    provenance = {}  # noqa: RUF012

    def predict(self, theta):
        mean = relaxing_force(theta, self.edges_s[1:])
        return Prediction(mean, self.share * mean[:, :, None], np.zeros_like(mean))

    def predict_mean(self, theta):
        return relaxing_force(theta, self.edges_s[1:])


@pytest.mark.parametrize("estimate", METHODS)
def test_ishigami(estimate):
    result = estimate(ishigami, box(3, -np.pi, np.pi), ONE_BIN, np.random.default_rng(1), 4096)
    first, total = ishigami_indices()
    tolerance = {"pick-freeze": 0.02, "projection": 1e-6}[result.method]
    np.testing.assert_allclose(result.first[:, 0], first, atol=tolerance)
    np.testing.assert_allclose(result.total[:, 0], total, atol=tolerance)
    np.testing.assert_allclose(result.first_aggregated, result.first[:, 0])


@pytest.mark.parametrize("estimate", METHODS)
def test_second_order_of_ishigami_is_its_one_interaction(estimate):
    result = estimate(ishigami, box(3, -np.pi, np.pi), ONE_BIN, np.random.default_rng(1), 4096)
    first, total = ishigami_indices()
    assert result.pairs == (("x0", "x1"), ("x0", "x2"), ("x1", "x2"))
    tolerance = {"pick-freeze": 0.03, "projection": 1e-6}[result.method]
    exact = [0.0, total[0] - first[0], 0.0]
    np.testing.assert_allclose(result.second[:, 0], exact, atol=tolerance)
    np.testing.assert_allclose(result.second_aggregated, exact, atol=tolerance)
    if result.method == "pick-freeze":
        low, high = result.second_aggregated_interval
        assert np.all((low <= result.second_aggregated) & (result.second_aggregated <= high))


def test_indices_of_a_skin_like_force_agree_with_salib():
    """First, total and second order, by an independent package with samples of its own."""
    pytest.importorskip("SALib", reason="SALib is not installed")
    from SALib.analyze import sobol as analyze
    from SALib.sample import sobol as sample

    edges = np.linspace(0.0, 20.0, 5)
    whole = {"num_vars": 5, "names": list(SPACE.names), "bounds": [[0.0, 1.0]] * 5}
    points = sample.sample(whole, 2048, calc_second_order=True, seed=1)
    force = relaxing_force(SPACE.from_unit(points), edges[1:])
    result = pick_freeze(
        lambda theta: relaxing_force(theta, edges[1:]), SPACE, edges, np.random.default_rng(2), 2048
    )
    for column in range(4):
        theirs = analyze.analyze(whole, force[:, column], calc_second_order=True, seed=1)
        np.testing.assert_allclose(result.first[:, column], theirs["S1"], atol=0.04)
        np.testing.assert_allclose(result.total[:, column], theirs["ST"], atol=0.04)
        upper = theirs["S2"][np.triu_indices(5, 1)]
        np.testing.assert_allclose(result.second[:, column], upper, atol=0.06)


@pytest.fixture(scope="module")
def by_salib():
    """The indices that SALib computes of the demo's force over the whole prior, by the bin of each phase."""
    pytest.importorskip("SALib", reason="SALib is not installed")
    from SALib.analyze import sobol as analyze
    from SALib.sample import sobol as sample

    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    names = list(surrogate.space.names)
    whole = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    points = sample.sample(whole, 4096, calc_second_order=True, seed=1)
    bins = np.linspace(0, len(surrogate.edges_s) - 2, 9).astype(int)[1:]  # at rest there is no force
    force = surrogate.predict_mean(surrogate.space.from_unit(points))[:, bins]
    rows = (analyze.analyze(whole, row, calc_second_order=True, seed=1) for row in force.T)
    return surrogate, dict(zip(bins, rows, strict=True))


@pytest.mark.parametrize("method", [pytest.param("pick-freeze", marks=pytest.mark.slow), "projection"])
def test_indices_of_the_shipped_surrogate_agree_with_salib(by_salib, method):
    """First, total and second order, within what SALib says of its own error.

    Few samples say much of rests, where rare points have all.
    """
    surrogate, known = by_salib
    result = sobol(surrogate, np.random.default_rng(2), 4096, method=method)
    pairs = np.triu_indices(len(surrogate.space.names), 1)
    for column, theirs in known.items():
        assert np.all(np.abs(result.first[:, column] - theirs["S1"]) < 0.01 + 1.5 * theirs["S1_conf"])
        assert np.all(np.abs(result.total[:, column] - theirs["ST"]) < 0.01 + 1.5 * theirs["ST_conf"])
        off = np.abs(result.second[:, column] - theirs["S2"][pairs])
        assert np.all(off < 0.01 + 1.5 * theirs["S2_conf"][pairs])


@pytest.mark.parametrize("estimate", METHODS)
def test_one_parameter_has_all_the_variance(estimate):
    result = estimate(lambda x: np.sin(3 * x), box(1, 0.0, 1.0), ONE_BIN, np.random.default_rng(2), 2048)
    assert result.first[:, 0] == pytest.approx([1.0], abs=0.01)
    assert result.total[:, 0] == pytest.approx([1.0], abs=0.01)


def test_samples_that_carry_nothing_but_a_constant_are_refused():
    with pytest.raises(InputError, match=r"sobol\.samples: 8 .* at least 20 with 4 parameters"):
        projection(sobol_g, box(4, 0.0, 1.0), ONE_BIN, np.random.default_rng(2), 8)


@pytest.mark.parametrize("estimate", METHODS)
def test_sobol_g(estimate):
    """Kinked, so that a polynomial converges slowly: it says so in `unexplained`."""
    result = estimate(sobol_g, box(5, 0.0, 1.0), ONE_BIN, np.random.default_rng(2), 4096)
    first, total = sobol_g_indices()
    np.testing.assert_allclose(result.first[:, 0], first, atol=0.03)
    np.testing.assert_allclose(result.total[:, 0], total, atol=0.03)
    if result.method == "projection":
        assert 1e-4 < result.unexplained < 0.1


def test_intervals_hold_the_truth_and_narrow_as_the_root_of_the_samples():
    first, total = ishigami_indices()
    widths = []
    for samples in (1024, 4096):
        result = pick_freeze(ishigami, box(3, -np.pi, np.pi), ONE_BIN, np.random.default_rng(3), samples)
        for truth, (low, high) in ((first, result.first_interval), (total, result.total_interval)):
            assert np.all((low[:, 0] <= truth) & (truth <= high[:, 0]))
        widths.append(np.mean(result.first_interval[1] - result.first_interval[0]))
    assert widths[0] / widths[1] == pytest.approx(2.0, rel=0.25)


def test_ninety_percent_intervals_cover_about_ninety_percent_of_independent_runs():
    """Bootstrap treats scrambled Sobol' points as independent, which is on the safe side; 0.85 is 1.6
    standard errors of 90 indices below."""
    first, _ = ishigami_indices()
    results = [
        pick_freeze(ishigami, box(3, -np.pi, np.pi), ONE_BIN, np.random.default_rng(seed), 256)
        for seed in range(30)
    ]
    covered = [(r.first_interval[0, :, 0] <= first) & (first <= r.first_interval[1, :, 0]) for r in results]
    assert np.mean(covered) >= 0.85


def test_bins_without_variance_are_not_a_number():
    def function(x):
        return np.column_stack([np.ones(len(x)), ishigami(x)[:, 0], 3.0 + 1e-6 * x[:, 0]])

    for estimate in METHODS:
        result = estimate(function, box(3, -np.pi, np.pi), np.arange(4.0), np.random.default_rng(0), 256)
        assert np.isnan(result.first[:, [0, 2]]).all()
        assert np.isnan(result.total[:, [0, 2]]).all()
        assert np.isfinite(result.first[:, 1]).all()
        assert np.isfinite(result.total_aggregated).all()


def test_a_constant_function_informs_nothing():
    result = pick_freeze(
        lambda x: np.ones((len(x), 2)), box(2, 0.0, 1.0), np.arange(3.0), np.random.default_rng(0), 64
    )
    assert np.isnan(result.total_aggregated).all()
    assert uninformed(result) == ()
    assert "none of them" in sentence(result)


def test_aggregated_indices_weigh_bins_by_variance_and_width():
    def function(x):
        return np.column_stack([x[:, 0], 2.0 * x[:, 1]])

    result = projection(function, box(2, 0.0, 1.0), np.array([0.0, 1.0, 4.0]), np.random.default_rng(0), 256)
    np.testing.assert_allclose(result.first, np.eye(2), atol=1e-10)
    np.testing.assert_allclose(result.first_aggregated, [1 / 13, 12 / 13], rtol=1e-8)  # 1 * 1 : 4 * 3


def test_the_two_methods_agree_on_a_relaxing_spring():
    surrogate = KnownSurrogate(0.0)
    by_freezing = sobol(surrogate, np.random.default_rng(0), 1024, method="pick-freeze")
    by_projection = sobol(surrogate, np.random.default_rng(0), 1024, method="projection")
    np.testing.assert_allclose(by_freezing.total_aggregated, by_projection.total_aggregated, atol=0.02)
    assert by_projection.unexplained < 1e-3
    assert uninformed(by_freezing) == uninformed(by_projection) == ("k_c", "p_init")
    assert sentence(by_freezing).startswith(
        "The force does not inform k_c and p_init: their total Sobol' indices"
    )


def test_inert_parameters_have_a_total_index_of_zero():
    result = sobol(KnownSurrogate(0.0), np.random.default_rng(0), 128)
    assert np.nanmax(np.abs(result.total[[2, 4]])) < 1e-12


@pytest.mark.parametrize("method", ["pick-freeze", "projection"])
def test_intervals_widen_with_the_surrogates_error(method):
    widths = []
    for share in (0.0, 0.1):
        result = sobol(KnownSurrogate(share), np.random.default_rng(0), 4096, method=method)
        widths.append(np.max(result.total_aggregated_interval[1] - result.total_aggregated_interval[0]))
    assert widths[1] > widths[0] + 0.005
    assert method == "pick-freeze" or widths[0] < 1e-10  # a projection has no sampling error


def test_error_draws_have_the_predicted_spread_and_are_smooth():
    surrogate = KnownSurrogate(0.1)
    unit = np.full((2, 5), 0.5)
    unit[1, 0] += 1e-3
    theta = SPACE.from_unit(unit)
    mean = surrogate.predict(theta).mean
    many, rng = ErrorDrawSettings(draws=200), np.random.default_rng(1)
    draws = np.array([f(theta) for f in error_draws(surrogate, rng, many)])
    spread = (draws[:, :, 12] - mean[:, 12]) / mean[:, 12]
    assert spread[:, 0].std() == pytest.approx(0.1, rel=0.15)
    assert np.abs(spread[:, 1] - spread[:, 0]).max() < 0.01


def test_the_input_distribution_is_stated_and_can_be_narrower():
    narrow = ParameterSpace(
        tuple(replace(p, lower=float(a), upper=float(b)) for p, a, b in zip(
            SPACE.parameters, SPACE.from_unit(np.full(5, 0.4)), SPACE.from_unit(np.full(5, 0.6)), strict=True
        ))
    )  # fmt: skip
    surrogate = KnownSurrogate(0.0)
    result = sobol(surrogate, np.random.default_rng(0), 64, space=narrow)
    assert f"E_c log-uniform, {interval(narrow.lower[0], narrow.upper[0], 'Pa')}" in result.distribution
    wide = ParameterSpace((replace(SPACE.parameters[0], upper=1e7), *SPACE.parameters[1:]))
    with pytest.raises(InputError, match="sobol: space"):
        sobol(surrogate, np.random.default_rng(0), 64, space=wide)


def test_the_same_seed_gives_the_same_numbers():
    first, second = (sobol(KnownSurrogate(0.01), np.random.default_rng(0), 64) for _ in range(2))
    assert np.array_equal(first.total_interval, second.total_interval, equal_nan=True)
    other = sobol(KnownSurrogate(0.01), np.random.default_rng(1), 64)
    assert not np.array_equal(first.total_aggregated, other.total_aggregated)
