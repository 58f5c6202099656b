"""What is made of a posterior: its maximum, the check there, bands, sentences, InferenceData."""

import dataclasses
import json
from pathlib import Path

import arviz as az
import matplotlib as mpl
import nlopt
import numpy as np
import pytest
import toy
from numpy.typing import ArrayLike
from scipy import stats
from toy_inference import (
    EDGES_S,
    NOISE,
    SCALE,
    TRUTH,
    LineSurrogate,
    ToySurrogate,
    empty_recording,
    full_run,
    line_problem,
    toy_problem,
)

from bayeskin.errors import InputError
from bayeskin.inference import (
    Convergence,
    Posterior,
    Verdict,
    bands,
    check_map,
    coverage,
    draws_of,
    find_map,
    identifiability,
    load_inference_data,
    noise_remarks,
    optimise,
    polish_map,
    predictive_draws,
    refine_map,
    rmse,
    save_inference_data,
    to_inference_data,
)
from bayeskin.inference.identify import information_gain_nats, parts
from bayeskin.inference.inference_data import _attributes
from bayeskin.inference.model_error import ModelError
from bayeskin.inference.noise_model import draw_noise, noise_chain
from bayeskin.types import (
    Array,
    Correlation,
    Parameter,
    ParameterSpace,
    Prediction,
    Provenance,
    Simulation,
)

mpl.use("Agg")
HOLDS = ((15.0, 45.0), (75.0, 105.0))


def around_truth(n: int, spread: float, seed: int = 0) -> Array:
    """Draws (n, D) about the truth in SI, for what takes draws as they come."""
    problem = toy_problem()
    rng = np.random.default_rng(seed)
    centre = problem.vector({**TRUTH, **NOISE})
    return problem.from_sampling(centre + spread * rng.standard_normal((n, problem.dim)))


def test_the_toy_surrogate_is_the_toy() -> None:
    theta = toy.SPACE.from_unit(np.random.default_rng(0).uniform(size=(30, 5)))
    error = ToySurrogate().predict(theta).mean - SCALE * toy.toy_bin_means(theta, EDGES_S)
    assert np.abs(error).max() < 1e-4


def test_the_maximum_of_a_line_is_its_least_squares() -> None:
    problem = line_problem()
    found = find_map(problem, seed=0, starts=2, evaluations=4000)
    x = problem.surrogate.columns
    covariance = 2.5e-3 * np.eye(40) + 1e-6 * np.eye(40) + 1e-4 * np.outer(x[1], x[1])
    information = x @ np.linalg.solve(covariance, x.T)
    exact = np.linalg.solve(information, x @ np.linalg.solve(covariance, problem.binned.force_n))
    assert [found.theta["a"], found.theta["b"]] == pytest.approx(exact, abs=1e-3)
    assert found.agreement == 1.0
    assert found == find_map(problem, seed=0, starts=2, evaluations=4000)


def test_starts_on_the_ridge_agree_on_its_height() -> None:
    problem = toy_problem(windows=HOLDS)
    found = find_map(problem, seed=1, starts=2, evaluations=4000)
    truth = problem.vector({k: v for k, v in {**TRUTH, **NOISE}.items() if k in problem.names})
    assert found.value > problem.log_prob(truth)[0]
    assert found.value == max(s.value for s in found.starts)
    assert all(s.value > found.value - 2.0 for s in found.starts)
    assert problem.log_prob(problem.vector(found.theta))[0] == pytest.approx(found.value, abs=1e-6)
    assert "of 2 starts" in found.message


class Folded(LineSurrogate):
    """force = |a| + b t: one maximum for each sign of a, the lower one on the prior's bound."""

    def __init__(self) -> None:
        super().__init__()
        a, b = self.space.parameters
        self.space = ParameterSpace((dataclasses.replace(a, lower=-0.19), b))

    def predict(self, theta: ArrayLike) -> Prediction:
        return super().predict(np.atleast_2d(theta) * [0.0, 1.0] + np.abs(np.atleast_2d(theta)) * [1.0, 0.0])


def test_three_kinds_of_search_end_at_one_maximum() -> None:
    problem = dataclasses.replace(line_problem(1), surrogate=Folded())
    found = find_map(problem, seed=1, starts=6, evaluations=4000)
    assert min(start.value for start in found.starts) < found.value - 0.3  # there is a lower one besides
    assert list(found.by_search) == list(optimise.SEARCHES)
    assert all(found.value - value < 0.1 for value in found.by_search.values())
    assert "by controlled random search, differential evolution, Gauss-Newton" in found.message


def test_no_more_starts_are_made_where_every_kind_of_search_agrees() -> None:
    found = find_map(line_problem(), seed=0, starts=8, evaluations=4000)
    assert [start.search for start in found.starts] == list(optimise.SEARCHES)
    assert found.agreement == 1.0
    folded = dataclasses.replace(line_problem(1), surrogate=Folded())
    assert len(find_map(folded, seed=1, starts=5, evaluations=4000).starts) == 5


@pytest.mark.parametrize("kind", optimise.SEARCHES)
def test_each_kind_of_search_climbs_before_the_polish(kind: str) -> None:
    problem = toy_problem(windows=HOLDS)
    search = optimise._Search(optimise._SearchSpace(problem))
    optimise.SEARCHES[kind](search, 3, 2000)
    middle = problem.log_prob(np.mean(problem.bounds, axis=0)[None])[0]
    best = find_map(problem, seed=1, starts=3, evaluations=4000).value
    assert best - search.value < 0.2 * (best - middle)


def test_a_failing_optimiser_is_a_status(monkeypatch: pytest.MonkeyPatch) -> None:
    class Failing(nlopt.opt):
        def optimize(self, start: Array) -> Array:
            raise nlopt.RoundoffLimited("roundoff")

    monkeypatch.setattr(optimise.nlopt, "opt", Failing)
    found = find_map(line_problem(), seed=0, starts=2, evaluations=100)
    assert all(s.status.startswith("failed") for s in found.starts)
    with pytest.raises(InputError, match="at least 1 start"):
        find_map(line_problem(), seed=0, starts=0)


def test_an_honest_surrogate_passes_the_check_and_a_moved_one_does_not() -> None:
    honest = check_map(ToySurrogate(), full_run, {**TRUTH, **NOISE})
    assert honest.passes
    assert honest.rms_n < 1e-4
    moved = check_map(ToySurrogate(bias_n=3e-3), full_run, TRUTH)  # six of its own sd
    assert not moved.passes
    assert moved.rms_n == pytest.approx(3e-3, rel=0.05)
    sd = ToySurrogate().predict([list(TRUTH.values())]).sd()[0]
    assert moved.rms_z == pytest.approx(np.sqrt(np.mean((3e-3 / sd) ** 2)), rel=0.05)
    assert "add the point to the design" in moved.message
    assert check_map(ToySurrogate(bias_n=3e-3), full_run, TRUTH, noise_sd_n=0.05).passes
    assert set(moved.theta) == set(TRUTH)


def test_a_maximum_where_the_surrogate_is_off_by_more_than_the_noise_does_not_pass() -> None:
    sd_n = ToySurrogate().predict(np.array([list(TRUTH.values())])).sd()[0]
    bias_n = float(np.sqrt(np.mean(sd_n**2)))
    assert check_map(ToySurrogate(bias_n=bias_n), full_run, TRUTH, noise_sd_n=1.1 * bias_n).passes
    off = check_map(ToySurrogate(bias_n=bias_n), full_run, TRUTH, noise_sd_n=0.9 * bias_n)
    assert not off.passes
    assert off.rms_z < 2.0
    assert "more than the noise's" in off.message


def test_the_mahalanobis_distance_takes_correlations_in() -> None:
    surrogate = ToySurrogate(bias_n=3e-3)
    check = check_map(surrogate, full_run, TRUTH)
    prediction = surrogate.predict([list(TRUTH.values())])
    total = prediction.factor[0] @ prediction.factor[0].T + np.diag(prediction.diagonal[0])
    exact = check.error_n @ np.linalg.solve(total, check.error_n)
    assert check.mahalanobis == pytest.approx(np.sqrt(exact / 130), rel=1e-6)


def test_the_loop_repairs_a_moved_surrogate() -> None:
    problem = toy_problem(windows=HOLDS, surrogate=ToySurrogate(bias_n=0.02))
    points: list[dict[str, float]] = []

    def retrain(theta, simulation: Simulation) -> ToySurrogate:  # type: ignore[no-untyped-def]
        points.append(dict(theta))
        wrong = problem.surrogate.predict([list(theta.values())]).mean[0]
        return ToySurrogate(bias_n=0.02 - float(np.mean(wrong - simulation.bin_means(EDGES_S))))

    result = refine_map(problem, full_run, retrain, seed=1, starts=1, evaluations=2000)
    assert [c.passes for c in result.checks] == [False, True]
    assert result.passes
    assert abs(result.log_posterior.surrogate.bias_n) < 1e-4
    assert points == [dict(result.checks[0].theta)]


def test_the_loop_ends_after_a_failed_run_and_after_its_rounds() -> None:
    problem = toy_problem(windows=HOLDS, surrogate=ToySurrogate(bias_n=0.02))

    def failing(theta: dict[str, float]) -> Simulation:
        return dataclasses.replace(full_run(theta), status="failed", message="halve the step")

    def stubborn(theta: dict[str, float], simulation: Simulation) -> ToySurrogate:
        return ToySurrogate(bias_n=0.02)

    failed = refine_map(problem, failing, stubborn, seed=1, starts=1, evaluations=200)
    assert (len(failed.checks), failed.passes) == (1, False)
    assert "halve the step" in failed.checks[0].message
    assert np.isnan(failed.checks[0].rms_n)
    tried = refine_map(problem, full_run, stubborn, seed=1, starts=1, evaluations=200, max_rounds=3)
    assert (len(tried.checks), tried.passes) == (3, False)


@pytest.mark.parametrize("sd_n", [5e-4, 1e-2])  # a surrogate far better and far worse than the noise
def test_the_parts_of_the_bands_are_what_they_are_called(sd_n: float) -> None:
    problem = toy_problem(surrogate=ToySurrogate(sd_n=sd_n))
    draws = around_truth(600, 0.01)
    draws[:, -1] = 100.0
    found = bands(problem, draws, np.random.default_rng(0))
    drawn = predictive_draws(problem, draws, np.random.default_rng(0))
    assert found.sd_model_n == pytest.approx(drawn.mean_n.std(axis=0))
    assert found.sd_surrogate_n == pytest.approx(problem.predict(draws).sd()[0])
    kinds = np.array([p.kind for p in problem.binned.phases])[problem.binned.phase]
    hold = found.sd_noise_n[kinds == "hold"]
    assert hold == pytest.approx(np.sqrt(NOISE["sd_hold"] ** 2 + 1e-6), rel=0.01)
    whole = np.diff(found.interval(0.9), axis=0)[0] / (2 * 1.645)
    assert whole.mean() == pytest.approx(found.sd_total_n.mean(), rel=0.05)
    with pytest.raises(InputError, match=r"0\.5 or 0\.9"):
        found.interval(0.8)


def test_bands_cover_further_recordings_of_the_same_skin_as_often_as_they_say() -> None:
    """Its error, which is that of the first recording, is known from that one only."""
    rng, covered = np.random.default_rng(2), []
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (500, 1))
    surrogate = ToySurrogate(sd_n=1e-2)
    prediction = surrogate.predict(theta[:1])
    for _ in range(20):
        truth = prediction.mean[0] + prediction.factor[0] @ rng.standard_normal(3)
        chain = noise_chain(empty_recording())
        first, *others = truth + draw_noise(
            chain, theta[:6, 5:], np.repeat(prediction.diagonal, 6, axis=0), rng
        )
        problem = toy_problem(surrogate=surrogate)
        problem = dataclasses.replace(problem, binned=dataclasses.replace(problem.binned, force_n=first))
        low, high = bands(problem, theta, rng).interval(0.9)
        covered += [coverage(dataclasses.replace(problem.binned, force_n=f), low, high) for f in others]
    assert np.mean(covered) == pytest.approx(0.9, abs=0.02)


def test_an_error_of_the_model_is_in_the_bands_as_the_recording_shows_it() -> None:
    """A model that pulls two hundredths too hard: the bands are about the recording, and narrow."""
    problem = toy_problem(surrogate=ToySurrogate(sd_n=1e-9))
    error = ModelError(toy.MOTION, problem.binned.edges_s, 0.02)
    mean = problem.predict([list(TRUTH.values())]).mean[0]
    binned = dataclasses.replace(problem.binned, force_n=1.02 * mean)
    problem = dataclasses.replace(problem, binned=binned, model_error=error)
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (200, 1))
    found = bands(problem, theta, np.random.default_rng(1))
    np.testing.assert_allclose(found.mean_n, 1.02 * mean, atol=2e-3)
    assert found.sd_model_n.max() < 0.2 * 0.02 * mean.max()
    assert found.sd_surrogate_n.max() < 1e-6


def test_kinds_that_were_not_fitted_take_the_largest_noise() -> None:
    problem = toy_problem(windows=HOLDS)
    theta = np.array([[*TRUTH.values(), 3e-3, 2.0, 6.0]])
    drawn = predictive_draws(problem, theta, np.random.default_rng(0))
    assert drawn.noise_sd_n[0] == pytest.approx(np.full(130, np.sqrt(9e-6 + 1e-6)))


def test_rmse_is_told_by_window_and_kind() -> None:
    problem = toy_problem()
    residual = np.where(problem.binned.phase == 2, 3.0, 1.0)
    found = rmse(problem.binned, problem.binned.force_n - residual, [(15.0, 45.0), (45.0, 55.0), (0.2, 0.4)])
    assert found.by_window_n[:2] == (3.0, 1.0)
    assert np.isnan(found.by_window_n[2])
    assert found.by_kind_n["hold"] == pytest.approx(np.sqrt(5.0))
    assert found.whole_n == pytest.approx(np.sqrt((30 * 9 + 100) / 130))


SPACE = ParameterSpace(
    (
        Parameter("E", "Pa", 1.0, np.exp(10.0), "log-uniform"),
        Parameter("F", "Pa", 1.0, np.exp(10.0), "log-uniform"),
        Parameter("p_init", "Pa", -10.0, 10.0, "uniform"),
    )
)


def ridge_draws(n: int = 4000) -> Array:
    rng = np.random.default_rng(0)
    along = rng.standard_normal(n)
    across = 0.1 * rng.standard_normal((n, 2))
    return np.column_stack(
        [np.exp(5 + along + across[:, 0]), np.exp(5 - along + across[:, 1]), rng.uniform(-10, 10, n)]
    )


def test_a_parameter_with_its_prior_back_is_said_to_be_uninformed() -> None:
    found = identifiability(SPACE, ridge_draws())
    assert found.parameters[2].statement == "p_init: the data does not inform it (posterior = prior)"
    assert found.parameters[2].contraction == pytest.approx(0.0, abs=0.05)
    e = found.parameters[0]
    assert e.contraction == pytest.approx(1 - 12 * 1.01 / 100, abs=0.02)
    assert e.quantiles == pytest.approx(np.exp(5 + np.array([-1.645, 0, 1.645])), rel=0.1)
    assert e.statement.startswith("E: the data informs it: median")


def test_a_sentence_without_statistics_says_what_the_test_taught() -> None:
    sentences = {one.name: one.sentence for one in identifiability(SPACE, ridge_draws()).parameters}
    assert sentences["p_init"].startswith("This test says nothing of the")
    assert "what was assumed" in sentences["p_init"]
    assert "times narrower than assumed" in sentences["E"]


def test_two_separate_ranges_are_said_and_one_of_any_shape_is_not() -> None:
    rng = np.random.default_rng(3)
    two = np.concatenate([0.2 + 0.03 * rng.standard_normal(1500), 0.7 + 0.05 * rng.standard_normal(500)])
    found = parts(two)
    assert len(found) == 2
    np.testing.assert_allclose(found, [(0.15, 0.25), (0.62, 0.78)], atol=0.02)
    one = (rng.uniform(size=3000), rng.beta(2, 9, 3000), np.full(50, 0.3), 1 - rng.exponential(0.02, 3000))
    assert [len(parts(draws)) for draws in one] == [1, 1, 1, 1]
    few = np.concatenate([0.2 + 0.03 * rng.standard_normal(1970), 0.7 + 0.03 * rng.standard_normal(30)])
    assert len(parts(few)) == 1
    space = ParameterSpace((Parameter("E", "Pa", 1.0, np.exp(10.0), "log-uniform"),))
    statement = identifiability(space, space.from_unit(two[:, None])).parameters[0].statement
    assert "2 separate ranges fit: " in statement


def test_noise_parameters_at_their_bounds_are_remarked_on() -> None:
    noise = ParameterSpace(
        (
            Parameter("tau_noise", "s", 0.1, 100.0, "log-uniform"),
            Parameter("nu_noise", "1", 2.0, 100.0, "log-uniform"),
        )
    )
    unit = np.random.default_rng(0).beta(1.0, 60.0, (2000, 2))
    at_bounds = noise.from_unit(np.column_stack([1.0 - unit[:, 0], unit[:, 1]]))
    said = noise_remarks(identifiability(noise, at_bounds))
    assert len(said) == 1
    assert "as long as its prior allows and with the heaviest tails" in said[0]
    assert noise_remarks(identifiability(noise, noise.from_unit(0.3 + 0.2 * unit))) == ()
    other_ends = noise.from_unit(np.column_stack([unit[:, 0], 1.0 - unit[:, 1]]))  # white and Gaussian
    assert noise_remarks(identifiability(noise, other_ends)) == ()


def test_a_ridge_is_named() -> None:
    found = identifiability(SPACE, ridge_draws()).ridges
    assert [(r.first, r.second) for r in found] == [("E", "F")]
    assert found[0].correlation == pytest.approx(-0.99, abs=0.01)
    assert "E and F form a ridge" in found[0].statement


def test_a_curved_ridge_is_named() -> None:
    """Two moduli whose weighted sum is what the force hangs on: in logarithms that is a bend, no line."""
    rng = np.random.default_rng(4)
    share = rng.uniform(0.004, 0.996, 4000) ** rng.choice([0.2, 1.0, 5.0], 4000)
    draws = np.column_stack([np.exp(9.0) * share, np.exp(9.0) * (1.0 - share), rng.uniform(-10, 10, 4000)])
    assert abs(np.corrcoef(np.log(draws[:, :2]), rowvar=False)[0, 1]) < 0.8
    assert [(r.first, r.second) for r in identifiability(SPACE, draws).ridges] == [("E", "F")]


def test_a_posterior_on_a_bound_is_said_to_lean_on_it() -> None:
    draws = ridge_draws()
    draws[:, 0] = np.exp(np.random.default_rng(1).exponential(0.3, len(draws)))
    assert "leans on the prior's lower bound, 1 Pa" in identifiability(SPACE, draws).parameters[0].statement


@pytest.mark.parametrize("sd", [0.1, 0.01, 0.001])
def test_the_information_gain_of_a_normal_is_its_closed_form(sd: float) -> None:
    draws = 0.5 + sd * np.random.default_rng(0).standard_normal(5000)
    exact = -stats.norm.entropy(scale=sd)
    assert information_gain_nats(draws) == pytest.approx(exact, abs=0.05)
    assert information_gain_nats(np.random.default_rng(1).uniform(size=5000)) < 0.02


def some_posterior(n: int = 120) -> Posterior:
    problem = toy_problem()
    draws = around_truth(2 * n, 0.02).reshape(2, n, -1)
    log_prob = problem.log_prob(problem.to_sampling(draws.reshape(2 * n, -1))).reshape(2, n)
    dim = problem.dim
    convergence = Convergence(
        500, 100, 4, np.full((2, dim), 4.0), np.full(dim, 200.0), np.ones(dim), np.full(2, 0.3), (),
        Verdict(False, ("200 effective samples of E_c; 5000 needed",)),
    )  # fmt: skip
    return Posterior(problem.space, draws, log_prob, convergence, 3)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Posterior, az.InferenceData]:
    problem, posterior = toy_problem(), some_posterior()
    made = to_inference_data(
        problem, posterior, Provenance("1.2", recording_sha256="abc"), np.random.default_rng(0), 100
    )
    path = tmp_path_factory.mktemp("nc") / "posterior.nc"
    save_inference_data(path, made)
    assert [p.name for p in path.parent.iterdir()] == ["posterior.nc"]
    return posterior, load_inference_data(path)


def test_inference_data_survives_its_file(stored: tuple[Posterior, az.InferenceData]) -> None:
    posterior, idata = stored
    space, draws = draws_of(idata)
    assert space == posterior.space
    tied = ParameterSpace(
        tuple(dataclasses.replace(p, prior="normal", centre=p.lower) for p in space.parameters[:2]),
        (Correlation(*space.names[:2], 0.5),),
    )
    c = posterior.convergence
    c = dataclasses.replace(c, ess=c.ess[:2], rhat=c.rhat[:2], tau_steps=c.tau_steps[:, :2])
    attributes = _attributes(dataclasses.replace(posterior, space=tied, convergence=c), Provenance("1"))
    assert draws_of(az.InferenceData(posterior=idata.posterior, attrs=attributes))[0] == tied
    assert np.array_equal(draws, posterior.flat)
    assert {"sample_stats", "log_likelihood", "posterior_predictive", "prior", "observed_data",
            "constant_data"} <= set(idata.groups())  # fmt: skip
    assert idata.posterior["E_c"].attrs["units"] == "Pa"
    assert idata.sample_stats["lp"].values == pytest.approx(posterior.log_prob)
    assert idata.posterior_predictive["force"].shape == (2, 50, 130)
    assert idata.attrs["recording_sha256"] == "abc"
    assert int(idata.attrs["trusted"]) == 0
    assert json.loads(idata.attrs["verdict"]) == ["200 effective samples of E_c; 5000 needed"]
    assert list(idata.log_likelihood["phase"].values[:3]) == ["rest 0", "load 1", "hold 1"]


def test_arviz_works_on_it(stored: tuple[Posterior, az.InferenceData]) -> None:
    _, idata = stored
    table = az.summary(idata)
    assert set(table.index) == {*TRUTH, *NOISE}
    loo = az.loo(idata)
    assert loo.n_data_points == 9
    assert np.isfinite(loo.elpd_loo)
    assert az.plot_trace(idata, var_names=["E_c", "sd_hold"]).shape == (2, 2)
    az.plot_ppc(idata, num_pp_samples=5)


def test_a_broken_write_leaves_the_earlier_file(
    tmp_path: Path, stored: tuple[Posterior, az.InferenceData], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "posterior.nc"
    path.write_bytes(b"earlier")

    def broken(self: az.InferenceData, filename: str, **_: object) -> None:
        Path(filename).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(az.InferenceData, "to_netcdf", broken)
    with pytest.raises(OSError, match="disk full"):
        save_inference_data(path, stored[1])
    assert path.read_bytes() == b"earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]
    for bad in (path, tmp_path / "none.nc"):
        with pytest.raises(InputError):
            load_inference_data(bad)


def full_run_with_derivatives(theta):
    """The toy with its derivatives by central differences of logarithms."""
    run, names, h = full_run(theta), ("E_c", "E_s", "k_c", "k_s"), 1e-4

    def shifted(name, sign):
        return full_run({**theta, name: theta[name] * np.exp(sign * h)}).force_n

    columns = [(shifted(name, 1) - shifted(name, -1)) / (2 * h) for name in names]
    return dataclasses.replace(run, gradient_names=names, gradient_n=np.stack(columns, axis=1))


def test_polish_climbs_the_full_model_from_where_a_wrong_surrogate_left_it():
    wrong = toy_problem(surrogate=ToySurrogate(bias_n=5e-3))
    start = dict(find_map(wrong, seed=1, starts=1, evaluations=4000).theta)
    polished = polish_map(wrong, full_run_with_derivatives, start, rounds=12)
    assert polished.gained > 5.0, polished.message
    assert "converged" in polished.message
    right = find_map(toy_problem(surrogate=ToySurrogate(sd_n=1e-7)), seed=1, starts=2, evaluations=8000)
    exact = toy_problem(surrogate=ToySurrogate(sd_n=1e-7))
    values = exact.log_prob(np.stack([exact.vector(polished.theta), exact.vector(right.theta)]))
    assert values[0] > values[1] - 0.5


def test_polish_ends_at_a_full_run_that_fails():
    problem = toy_problem()
    start = dict(find_map(problem, seed=1, starts=1, evaluations=4000).theta)
    failing = dataclasses.replace(full_run(TRUTH), status="failed", message="step 3")
    polished = polish_map(problem, lambda theta: failing, start)
    assert polished.theta == start
    assert "step 3" in polished.message
