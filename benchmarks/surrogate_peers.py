"""Measures surrogates of other packages on the problem of surrogate_benchmark.py.

    PYTHON benchmarks/surrogate_peers.py PACKAGE PROBLEM.npz

The program prints one JSON line for each method. PYTHON needs numpy and the package, so each package may have
an environment of its own. All packages are given the inputs on the unit cube, in logarithms where the prior
is log-uniform. Packages without field outputs are given the principal components of the outputs. The noise is
white, which is the cheapest case for all. The settings of OpenTURNS are those with the smallest error of a
few tried on the first design. The other packages have one setting each.
"""

from __future__ import annotations

import json
import logging
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version

import numpy as np

Array = np.ndarray
# The arguments are inputs (n, d), and True if the error is needed.
Predict = Callable[[Array, bool], tuple[Array, Array]]
Fit = Callable[[Array, Array], Predict]
KEPT = 1e-7  # components with a smaller share of the outputs' variance are left out
NOISE_N = 1e-2
STRATA = 9  # the sparse chaos chooses terms from these first strata of the hyperbolic norm


def scores_of(force_n: Array) -> tuple[Array, Array, Array]:
    """Returns mean (m,), principal components (q, m) and scores (n, q) of forces (n, m)."""
    mean = force_n.mean(axis=0)
    left, size, right = np.linalg.svd(force_n - mean, full_matrices=False)
    kept = size**2 > KEPT * np.sum(size**2)
    return mean, right[kept], left[:, kept] * size[kept]


def openturns_gp(unit: Array, scores: Array) -> Predict:
    """Fits one GP for each score.

    The kernel is squared exponential with a length for each input, over a linear trend.
    """
    import openturns as ot

    fitted = []
    for column in scores.T:
        scale, dim = float(column.std()), unit.shape[1]
        target = ot.Sample((column / scale)[:, None])
        kernel, trend = ot.SquaredExponential([1.0] * dim), ot.LinearBasisFactory(dim).build()
        first = ot.GaussianProcessFitter(ot.Sample(unit), target, kernel, trend)
        first.setOptimizationAlgorithm(ot.NLopt("LD_LBFGS"))
        first.setOptimizationBounds(ot.Interval([0.05] * dim, [20.0] * dim))
        first.run()
        second = ot.GaussianProcessRegression(first.getResult())
        second.run()
        result = second.getResult()
        fitted.append((scale, result.getMetaModel(), ot.GaussianProcessConditionalCovariance(result)))

    def predict(at: Array, error: bool) -> tuple[Array, Array]:
        points = ot.Sample(at)
        mean = np.stack([scale * np.asarray(model(points))[:, 0] for scale, model, _ in fitted], axis=1)
        if not error:
            return mean, np.zeros_like(mean)
        spread = [scale**2 * np.ravel(c.getConditionalMarginalVariance(points)) for scale, _, c in fitted]
        return mean, np.stack(spread, axis=1)

    return predict


def openturns_chaos(unit: Array, scores: Array) -> Predict:
    """Fits sparse chaos by least-angle regression with corrected leave-one-out; it states no error."""
    import openturns as ot

    dim = unit.shape[1]
    cube = ot.JointDistribution([ot.Uniform(0.0, 1.0)] * dim)
    terms = ot.HyperbolicAnisotropicEnumerateFunction(dim, 0.75)
    basis = ot.OrthogonalProductPolynomialFactory([ot.LegendreFactory()] * dim, terms)
    strategy = ot.FixedStrategy(basis, terms.getStrataCumulatedCardinal(STRATA))
    selection = ot.LeastSquaresMetaModelSelectionFactory(ot.LARS(), ot.CorrectedLeaveOneOut())
    projection = ot.LeastSquaresStrategy(selection)
    algorithm = ot.FunctionalChaosAlgorithm(ot.Sample(unit), ot.Sample(scores), cube, strategy, projection)
    algorithm.run()
    model = algorithm.getResult().getMetaModel()
    return lambda at, error: (np.asarray(model(ot.Sample(at))), np.zeros((len(at), scores.shape[1])))


def bayesvalidrox(kind: str) -> Fit:
    """Returns a fit of the scores by GPs with a length for each input, or by sparse chaos.

    The chaos uses fast ARD and degrees up to 5.
    """
    import bayesvalidrox as bvr

    def fit(unit: Array, scores: Array) -> Predict:
        inputs = bvr.Input()
        for i in range(unit.shape[1]):
            inputs.add_marginals(name=f"x{i}", dist_type="uniform", parameters=[0.0, 1.0])
        if kind == "gp":
            model = bvr.GPESkl(inputs, kernel_type="RBF", isotropy=False, noisy=True, n_restarts=2)
        else:
            degrees = list(range(1, 6))
            model = bvr.PCE(inputs, pce_reg_method="fastard", pce_deg=degrees, pce_q_norm=0.75)
        scale = scores.std(axis=0)
        model.fit(unit, {"score": scores / scale})

        def predict(at: Array, error: bool) -> tuple[Array, Array]:
            mean, sd = model.eval_metamodel(at)
            return scale * mean["score"], (scale * sd["score"]) ** 2

        return predict

    return fit


def surmise_forces(unit: Array, force_n: Array) -> Predict:
    """Fits PCGP (Higdon et al. 2008), which computes principal components itself.

    Its predictions are mean (n, m) and factor (n, q, m) of the forces.
    """
    from surmise.emulation import emulator
    from surmise.set_RNG import set_RNG

    set_RNG(np.random.default_rng(0))
    times = np.arange(float(force_n.shape[1]))[:, None]
    model = emulator(x=times, theta=unit, f=force_n.T, method="PCGP", args={"epsilon": KEPT})

    def predict(at: Array, error: bool) -> tuple[Array, Array]:
        prediction = model.predict(x=times, theta=at, args={"computecov": error})
        mean = prediction.mean().T
        return mean, prediction.covxhalf().transpose(1, 2, 0) if error else mean[:, :0, None]

    return predict


def log_likelihood(residual: Array, factor: Array | None) -> Array:
    """Returns the log-likelihoods (n,) of residuals (n, m) with white noise.

    factor (n, q, m) : factor of the surrogate's own error, or None
    """
    weight, m = NOISE_N**-2, residual.shape[1]
    square = weight * np.sum(residual**2, axis=1) + m * np.log(2.0 * np.pi / weight)
    if factor is None:
        return -0.5 * square
    lower = np.linalg.cholesky(np.eye(factor.shape[1]) + weight * factor @ factor.transpose(0, 2, 1))
    whitened = np.linalg.solve(lower, weight * (factor @ residual[:, :, None]))[:, :, 0]
    logs = 2.0 * np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), axis=1)
    return -0.5 * (square - np.sum(whitened**2, axis=1) + logs)


def of_scores(fit: Fit) -> Fit:
    """Returns a fit for forces from a fit for scores."""

    def fitted(unit: Array, force_n: Array) -> Predict:
        mean, components, scores = scores_of(force_n)
        predict = fit(unit, scores)

        def of_forces(at: Array, error: bool) -> tuple[Array, Array]:
            score, variance = predict(at, error)
            force = mean + score @ components
            if not error:
                return force, force[:, :0, None]
            return force, np.sqrt(np.maximum(variance, 0.0))[:, :, None] * components

        return of_forces

    return fitted


def methods(package: str) -> Iterator[tuple[str, Fit]]:
    """Yields the names and fits of one package's methods."""
    if package == "openturns":
        yield "GP", of_scores(openturns_gp)
        yield "sparse chaos", of_scores(openturns_chaos)
    elif package == "bayesvalidrox":
        yield "GP", of_scores(bayesvalidrox("gp"))
        yield "sparse chaos", of_scores(bayesvalidrox("chaos"))
    elif package == "surmise":
        yield "PCGP", surmise_forces


def rate(action: Callable[[], object], points: int) -> float:
    """Returns points per CPU second, the median of three rounds."""
    rates = []
    for _ in range(3):
        start = time.process_time()
        action()
        rates.append(points / (time.process_time() - start))
    return float(np.median(rates))


def measured(fit: Fit, problem: dict[str, Array]) -> dict[str, float | None]:
    """Returns error, training time and rates of one method."""
    unit, force_n, at, truth = (problem[name] for name in ("unit", "force_n", "test_unit", "test_force_n"))
    start = time.process_time()
    predict = fit(unit, force_n)
    seconds = time.process_time() - start
    mean, factor = predict(at, True)
    observed = truth[-1]
    states_error = bool(np.any(factor > 0.0))

    def with_covariance() -> Array:
        mean, factor = predict(at, True)
        return log_likelihood(observed - mean, factor)

    return {
        "held_out_error": float(np.linalg.norm(mean - truth) / np.linalg.norm(truth - truth.mean(axis=0))),
        "training_s": seconds,
        "log_likelihoods_per_s": rate(with_covariance, len(at)) if states_error else None,
        "without_covariance_per_s": rate(
            lambda: log_likelihood(observed - predict(at, False)[0], None), len(at)
        ),
    }


def main() -> None:
    package, file = sys.argv[1:]
    warnings.filterwarnings("ignore")
    logging.disable(logging.WARNING)
    with np.load(file) as stored:
        problem = dict(stored)
    for name, fit in methods(package):
        row = {"method": f"{package} {version(package)}, {name}", **measured(fit, problem)}
        print("ROW " + json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
