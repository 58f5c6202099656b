"""Moves of walkers that keep their target, and coordinates in which a ridge is straight."""

import emcee
import numpy as np
import pytest
from scipy import stats
from toys.inference_problems import NOISE, TRUTH, line_problem, toy_problem

from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.moves import SnookerMove, SubspaceMove, TriesMove, mixed_moves
from bayeskin.inference.proposal import Mixture, Product
from bayeskin.inference.reparametrisation import Shear, find_shear


def unit_normal_variance(moves: object, dim: int, steps: int) -> tuple[float, float]:
    """Mean variance of a unit normal as the moves leave it, with its standard error from 20 batches."""
    random = np.random.RandomState(1)
    sampler = emcee.EnsembleSampler(30, dim, lambda x: -0.5 * (x**2).sum(axis=1), moves=moves, vectorize=True)
    sampler.run_mcmc(emcee.State(random.randn(30, dim), random_state=random.get_state()), steps)
    square = (sampler.get_chain()[steps // 10 :] ** 2).mean(axis=(1, 2))
    batches = [b.mean() for b in np.array_split(square, 20)]
    return float(square.mean()), float(np.std(batches, ddof=1) / np.sqrt(20))


def curved_shear(dim: int) -> Shear:
    group = np.arange(dim) < 2
    weight = np.where(group, 0.3, -np.inf)
    powers = np.zeros((1, dim), dtype=np.int64)
    powers[0, -1] = 2
    return Shear(group, weight, powers, np.array([0.7]), np.zeros(dim), np.full(dim, 2.0))


def walled(shear: Shear | None) -> MoveCoordinates:
    return MoveCoordinates(shear, np.full(5, -9.0), np.full(5, 9.0))


def learnt(shear: Shear | None) -> Product:
    """Learns from draws of another distribution than the unit normal, so that tries are weighted."""
    rng = np.random.default_rng(3)
    draws = 0.3 + 1.2 * rng.standard_normal((3000, 5))
    return Product.of(walled(shear).forward(draws), (slice(0, 2), slice(2, 5)), rng)


@pytest.mark.parametrize(
    "moves",
    [
        SnookerMove(),
        SubspaceMove(),
        TriesMove(walled(curved_shear(5))),
        TriesMove(walled(None)),
        TriesMove(walled(None), learnt(None)),
        TriesMove(walled(curved_shear(5)), learnt(curved_shear(5))),
        mixed_moves(walled(curved_shear(5)), 30),
        mixed_moves(walled(None), 30),
        mixed_moves(walled(None), 14),
        mixed_moves(walled(curved_shear(5)), 30, learnt(curved_shear(5))),
    ],
    ids=[
        "snooker",
        "subspace",
        "tries, straightened",
        "tries, normal scores",
        "learnt tries, normal scores",
        "learnt tries, straightened",
        "all, straightened",
        "all, normal scores",
        "without tries",
        "all, learnt tries",
    ],
)
def test_a_move_keeps_a_unit_normal(moves: object) -> None:
    mean, error = unit_normal_variance(moves, 5, 600)
    assert abs(mean - 1.0) < 4 * error + 0.005
    assert error < 0.04


def test_tries_are_made_where_the_walkers_tell_a_distribution() -> None:
    for walkers, tries in ((15, True), (14, False)):
        moves = mixed_moves(walled(None), walkers)
        assert any(isinstance(move, TriesMove) for move, _ in moves) == tries
        assert sum(share for _, share in moves) == pytest.approx(1.0)


def test_tries_keep_the_shares_of_two_modes_between_walls() -> None:
    def log_prob(x: np.ndarray) -> np.ndarray:
        low, high = (-0.5 * np.sum(((x - centre) / 0.3) ** 2, axis=1) for centre in (1.0, 3.0))
        inside = np.all((x > 0.0) & (x < 4.0), axis=1)
        return np.where(inside, np.logaddexp(np.log(0.8) + low, np.log(0.2) + high), -np.inf)

    move = TriesMove(MoveCoordinates(None, np.zeros(3), np.full(3, 4.0)))
    random = np.random.RandomState(2)
    sampler = emcee.EnsembleSampler(30, 3, log_prob, moves=move, vectorize=True)
    sampler.run_mcmc(emcee.State(random.uniform(0.0, 4.0, (30, 3)), random_state=random.get_state()), 900)
    means = [batch.mean() for batch in np.array_split(sampler.get_chain()[200:], 20)]
    error = np.std(means, ddof=1) / np.sqrt(20)
    assert abs(np.mean(means) - 1.4) < 4 * error
    assert error < 0.03


def test_a_mixture_s_density_is_that_of_its_draws() -> None:
    """E_q[p / q] is 1 for a density p that q covers; and components follow two parts of unequal share."""
    rng = np.random.default_rng(4)
    left = rng.random(4000) < 0.3
    draws = rng.standard_normal((4000, 3)) * 0.2 + np.where(left, -2.0, 1.0)[:, None]
    mixture = Mixture.of(draws, rng)
    points = mixture.draw(40000, np.random.RandomState(5))
    ratio = np.exp(stats.multivariate_normal(np.ones(3), 0.04).logpdf(points) - mixture.log_density(points))
    assert np.mean(ratio) == pytest.approx(1.0, abs=4 * np.std(ratio) / 200)
    assert np.mean(points[:, 0] < -0.5) == pytest.approx(np.mean(left), abs=0.02)


def test_a_walker_on_top_of_its_anchor_stays_where_it_is() -> None:
    walkers, others = np.zeros((3, 2)), [np.zeros((4, 2))]
    with np.errstate(all="raise"):
        proposal, factor = SnookerMove().get_proposal(walkers, others, np.random.RandomState(1))
    assert np.all(proposal == walkers)
    assert np.all(factor == -np.inf)


def test_a_shear_is_undone_by_its_inverse_and_keeps_volumes_in_proportion() -> None:
    shear = curved_shear(4)
    x = np.random.default_rng(0).standard_normal((50, 4))
    assert shear.back(shear.straight(x)) == pytest.approx(x, abs=1e-12)
    step = 1e-6
    volumes = []
    for point in x[:10]:
        moved = shear.straight(point + step * np.vstack([np.eye(4), -np.eye(4)]))
        volumes.append(np.linalg.det((moved[:4] - moved[4:]) / (2 * step)))
    assert np.abs(volumes) == pytest.approx(abs(volumes[0]), rel=1e-6)


def test_the_ridge_of_the_moduli_is_straight() -> None:
    problem = toy_problem()
    shear = find_shear(problem)
    assert shear is not None
    assert [n for n, g in zip(problem.names, shear.group, strict=True) if g] == ["E_c", "E_s"]
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (5, 1))
    theta[:, 1] = [2e3, 5e3, 2e4, 4e4, 5e4]
    theta[:, 0] = 1e5 + 2.6 * (2e4 - theta[:, 1])
    recorded = problem.binned.force_n
    amplitude = problem.predict(theta).mean @ recorded / (recorded @ recorded)
    x = problem.to_sampling(theta)
    assert np.ptp(x[:, 0]) > 1.0
    assert shear.straight(x)[:, 0] == pytest.approx(np.log(amplitude), abs=0.01)


def test_nothing_is_straightened_where_no_two_parameters_share_the_force() -> None:
    assert find_shear(line_problem()) is None
