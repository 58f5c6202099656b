"""Figures of chains: traces under their verdict, and running diagnostics."""

from __future__ import annotations

import numpy as np
import pytest
from toys.closed_form_model import SPACE
from toys.figure_inputs import TRUTH, drawn, headline, labels

from bayeskin import report
from bayeskin.inference.convergence import Limits, Verdict
from bayeskin.report import traces
from bayeskin.types import ParameterSpace

pytestmark = pytest.mark.filterwarnings("error")


TRUSTED = Verdict(True, ("60 autocorrelation lengths; 50 are needed",))
DOUBTED = Verdict(
    False, ("R-hat across 4 ensembles is 1.2 for k_s; at most 1.01 is allowed", "all else in order")
)


def autoregressive(rho: float, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Stationary AR(1) (4 ensembles, steps, 12 walkers); its autocorrelation time is (1+rho)/(1-rho)."""
    x = np.empty((4, steps, 12))
    x[:, 0] = rng.normal(size=(4, 12))
    for k in range(1, steps):
        x[:, k] = rho * x[:, k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=(4, 12))
    return x


@pytest.fixture(scope="module")
def chains() -> np.ndarray:
    rng = np.random.default_rng(9)
    unit = np.stack(
        [0.5 + 0.05 * autoregressive(rho, 300, rng) for rho in (0.5, 0.6, 0.3, 0.2, 0.0)], axis=-1
    )
    return SPACE.from_unit(unit)


def test_traces_by_ensemble_under_the_verdict(chains: np.ndarray) -> None:
    figure = drawn(report.figure_traces(SPACE, chains, TRUSTED, Limits()))
    assert len(figure.axes) == 15
    assert [line.get_label() for line in figure.axes[0].get_lines()] == ["1", "2", "3", "4"]
    assert labels(figure).count("step") == 3
    assert headline(figure) == "Trusted: 60 autocorrelation lengths; 50 are needed"


def test_an_untrusted_run_is_headed_by_its_first_reason(chains: np.ndarray) -> None:
    figure = report.figure_traces(SPACE, chains, DOUBTED, Limits())
    assert headline(figure).startswith("Not trusted: R-hat across 4 ensembles is 1.2 for k_s")


def test_traces_of_chains_that_are_constant_or_too_short(chains: np.ndarray) -> None:
    pair = ParameterSpace(SPACE.parameters[:2])
    still = drawn(report.figure_traces(pair, np.broadcast_to(TRUTH[:2], (2, 40, 6, 2)), DOUBTED, Limits()))
    assert [t.get_text() for ax in still.axes[1:3] for t in ax.texts] == ["does not move", "undefined"]
    for steps in (3, 30):
        short = drawn(report.figure_traces(pair, chains[:1, :steps, :, :2], DOUBTED, Limits()))
        assert len(short.axes[0].lines[0].get_xdata()) == steps


def test_running_diagnostics_end_at_those_of_the_whole_run() -> None:
    x = autoregressive(0.8, 3000, np.random.default_rng(10))[..., None]
    x[2] += 0.5
    running = traces.running_convergence(x)
    assert running.step[-1] == 3000
    np.testing.assert_allclose(running.tau_steps[-1, :, 0], 9.0, rtol=0.2)
    assert running.rhat[-1, 0] == pytest.approx(np.sqrt(1 + 0.5**2 * (1 / 4 - 1 / 16) * 8 / 7), abs=0.01)


def test_a_disagreement_at_the_start_fades_from_the_running_rhat() -> None:
    x = autoregressive(0.2, 800, np.random.default_rng(17))[..., None]
    x[2, :100] += 2.0
    rhat = traces.running_convergence(x).rhat[:, 0]
    assert rhat[0] > 1.2 > 1.05 > rhat[-1]
