"""Instrument mechanisms: off at their neutral values, else what their equation says."""

from __future__ import annotations

import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from bayeskin.errors import InputError
from bayeskin.mechanisms import bin_means, catalogue, observed
from bayeskin.mechanisms.lines import interpolated
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.types import Jumps, PadMotion, ParameterSpace

MOTION = PadMotion(
    np.array([0.0, 5.0, 14.4, 45.0, 54.4, 65.0, 74.4, 105.0, 114.4, 130.0]),
    1e-3 * np.array([0.0, 0.0, 9.4, 9.4, 0.0, 0.0, 9.4, 9.4, 0.0, 0.0]),
)
TIMES_S = np.linspace(0.0, 130.0, 1301)
ALL = {name: m for name, m in catalogue().items() if isinstance(m.act, Instrument)}


def skin(time_s: np.ndarray) -> np.ndarray:
    """A force that follows the displacement, one row."""
    return np.atleast_2d(40.0 * MOTION.at(time_s) * (1.0 + 20.0 * MOTION.at(time_s)))


def nothing(time_s: np.ndarray) -> np.ndarray:
    """No force, one row."""
    return np.zeros((1, np.shape(time_s)[-1]))


def straight(time_s: np.ndarray) -> np.ndarray:
    """A force in proportion to the displacement, one row."""
    return np.atleast_2d(50.0 * MOTION.at(time_s))


def values_of(*names: str, **chosen: float) -> dict[str, np.ndarray]:
    """Parameters of mechanisms at the middle of their priors, but for those chosen; one sample."""
    space = ParameterSpace(tuple(p for name in names for p in ALL[name].parameters))
    middle = dict(zip(space.names, space.from_unit([0.5] * space.dim), strict=True))
    return {name: np.array([value]) for name, value in (middle | chosen).items()}


def reported(*names: str, time_s: np.ndarray = TIMES_S, **chosen: float) -> np.ndarray:
    """Returns the force (t,) that the load cell reports in excess of the skin's force."""
    force = observed([ALL[n] for n in names], values_of(*names, **chosen), MOTION, skin)
    return (force(time_s) - skin(time_s))[0]


@pytest.mark.parametrize("name", ALL)
def test_a_neutral_mechanism_changes_nothing(name):
    neutral = {key: np.full(3, value) for key, value in ALL[name].neutral.items()}
    assert set(neutral) == {p.name for p in ALL[name].parameters}
    force = observed([ALL[name]], neutral, MOTION, skin)(TIMES_S)
    np.testing.assert_allclose(force, np.repeat(skin(TIMES_S), len(force), axis=0), rtol=0, atol=1e-15)


OFF_NEUTRAL = {
    "F0": 0.03, "drift": 1e-4, "delay": 0.3, "event_1_step": 0.02, "friction_start": 0.5, "cell_bend": 0.1,
}  # fmt: skip


@pytest.mark.parametrize("name", ALL)
def test_a_mechanism_off_its_neutral_value_shows_and_can_be_told(name):
    base = ALL[name].needs
    values = values_of(*base, name)
    chosen = {key: value for key, value in OFF_NEUTRAL.items() if key in values}
    without = reported(*base, friction_start=0.5) if base else 0.0
    assert np.abs(reported(*base, name, **chosen) - without).max() > 1e-3
    assert name in ALL[name].group
    told = ALL[name].statement({key: float(value[0]) for key, value in values.items()})
    assert told.endswith(".")


@pytest.mark.parametrize("pair", list(combinations(ALL, 2)), ids="+".join)
def test_any_two_run_together_row_by_row_and_in_any_order(pair):
    rng = np.random.default_rng(1)
    values = {p.name: rng.uniform(p.lower, p.upper, 4) for name in pair for p in ALL[name].parameters}
    together = observed([ALL[n] for n in pair], values, MOTION, skin)(TIMES_S)
    assert np.isfinite(together).all()
    np.testing.assert_array_equal(
        together, observed([ALL[n] for n in reversed(pair)], values, MOTION, skin)(TIMES_S)
    )
    for i in range(4):
        row = {name: column[i : i + 1] for name, column in values.items()}
        alone = observed([ALL[n] for n in pair], row, MOTION, skin)(TIMES_S)
        np.testing.assert_allclose(alone[0], together[i], rtol=1e-12, atol=1e-15)


def test_friction_makes_a_loop_of_twice_its_sliding_value_and_holds_keep_it():
    """Dahl's loop: after a presliding length or ten, the branch of each direction lies Fc from the middle."""
    force_n = reported("device-friction", Fc=0.05, presliding=2e-5, friction_start=0.0)
    up = force_n[(TIMES_S > 8) & (TIMES_S < 14)]
    down = force_n[(TIMES_S > 48) & (TIMES_S < 54)]
    np.testing.assert_allclose(up, 0.05, rtol=1e-6)
    np.testing.assert_allclose(down, -0.05, rtol=1e-6)
    held = force_n[(TIMES_S > 14.5) & (TIMES_S < 44.9)]
    np.testing.assert_allclose(held, 0.05, rtol=1e-6)
    np.testing.assert_allclose(force_n[TIMES_S < 5], 0.0, atol=1e-15)


@settings(max_examples=8, deadline=None)
@given(
    st.floats(0.0, 0.1),
    st.floats(5e-6, 3e-4),
    st.floats(-1.0, 1.0),
    st.floats(3.0, 1000.0),
)
def test_friction_and_its_creep_solve_their_equation(sliding, length, start, tau):
    force_n = reported(
        "device-friction", "friction-creep",
        Fc=sliding, presliding=length, friction_start=start, friction_tau=tau,
    )  # fmt: skip
    force, expected = start * sliding, []
    for (a, b), (low, high) in zip(
        zip(MOTION.time_s[:-1], MOTION.time_s[1:], strict=True),
        zip(MOTION.displacement_m[:-1], MOTION.displacement_m[1:], strict=True),
        strict=True,
    ):
        v = (high - low) / (b - a)
        at = TIMES_S[np.logical_and(a <= TIMES_S, b > TIMES_S)]
        solved = solve_ivp(
            lambda t, f, v=v: (sliding * v - f * abs(v)) / length - f / tau,
            (a, b), [force], method="Radau", t_eval=[*at, b], rtol=1e-9, atol=1e-12,
        )  # fmt: skip
        expected += list(solved.y[0][: len(at)])
        force = solved.y[0][-1]
    np.testing.assert_allclose(force_n[: len(expected)], expected, rtol=0, atol=2e-6)


def test_drag_is_proportional_to_the_speed():
    force_n = reported("viscous-drag", drag=20.0)
    np.testing.assert_allclose(force_n, 20.0 * np.gradient(MOTION.at(TIMES_S), TIMES_S), atol=0.011)
    assert force_n[100] == pytest.approx(0.02)
    assert force_n[300] == 0.0


def test_ripple_repeats_with_the_position_and_only_while_moving():
    force_n = reported("position-ripple", ripple_period=4e-4, ripple_amplitude=0.01, ripple_phase=0.3)
    moving = (TIMES_S > 5) & (TIMES_S < 14.4)
    expected = 0.01 * np.sin(2 * np.pi * MOTION.at(TIMES_S) / 4e-4 + 0.3)
    np.testing.assert_allclose(force_n[moving], expected[moving], atol=1e-15)
    assert np.all(force_n[(TIMES_S > 14.5) & (TIMES_S < 44)] == 0.0)


@pytest.mark.parametrize("period", [1e-4, 1.7e-4, 3.1e-4, 1e-3])
def test_bins_mean_a_ripple_over_all_its_cycles(period):
    """The integral of the sine over each second of even motion, from 1 to 10 cycles of it."""
    chosen = {"ripple_period": period, "ripple_amplitude": 0.01, "ripple_phase": 0.3}
    edges_s = np.arange(5.0, 15.0)
    values = values_of("position-ripple", **chosen)
    force = observed([ALL["position-ripple"]], values, MOTION, nothing)
    means_n = bin_means(force, MOTION, edges_s, [ALL["position-ripple"]])[0]
    phase = 2 * np.pi * MOTION.at(edges_s) / period + 0.3
    expected = -0.01 * np.diff(np.cos(phase)) / np.diff(phase)
    np.testing.assert_allclose(means_n, expected, atol=2e-5)


def test_a_delayed_force_is_that_of_before():
    before_s = TIMES_S - 0.45
    kept = before_s > 0.0  # and never on a corner, where the drag jumps
    late = reported("clock-delay", delay=0.45) + skin(TIMES_S)[0]
    np.testing.assert_allclose(late[kept], skin(before_s)[0, kept], atol=1e-12)
    both = reported("clock-delay", "viscous-drag", delay=0.45, drag=20.0) + skin(TIMES_S)[0]
    drag = reported("viscous-drag", drag=20.0, time_s=np.maximum(before_s, 0.0))
    np.testing.assert_allclose(both[kept], (late + drag)[kept], atol=1e-12)  # the clock comes last


@pytest.mark.parametrize("tau", [1e-4, 0.01, 0.3, 2.0, 500.0])
@pytest.mark.parametrize("every_s", [0.004, 0.07, 3.1])
def test_a_lagging_amplifier_solves_its_equation_for_straight_stretches(tau, every_s):
    """The response of a first-order filter to each stretch, whatever its grid and the times asked for."""
    time_s = np.arange(0.0, 130.0, every_s)
    force = observed([ALL["amplifier-lag"]], {"amplifier_time": np.array([tau])}, MOTION, straight)
    expected, lag = straight(time_s)[0], 0.0
    for start_s, end_s in zip(MOTION.time_s[:-1], MOTION.time_s[1:], strict=True):
        slope = float(np.diff(straight(np.array([start_s, end_s])))[0, 0] / (end_s - start_s))
        here = (time_s >= start_s) & (time_s < end_s)
        expected[here] += -tau * slope + (lag + tau * slope) * np.exp(-(time_s[here] - start_s) / tau)
        lag = -tau * slope + (lag + tau * slope) * np.exp(-(end_s - start_s) / tau)
    np.testing.assert_allclose(force(time_s)[0], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("tau", [0.01, 0.04, 0.2])
def test_a_jump_passes_a_lagging_amplifier_exponentially_and_bins_mean_that(tau):
    values = values_of("amplifier-lag", "viscous-drag", amplifier_time=tau, drag=20.0)
    both = [ALL["amplifier-lag"], ALL["viscous-drag"]]
    force = observed(both, values, MOTION, nothing)
    after_s = np.array([0.0, 0.003, 0.01, 0.1, 0.7])
    np.testing.assert_allclose(force(5.0 + after_s)[0], -0.02 * np.expm1(-after_s / tau), atol=1e-6)
    edges_s = np.array([4.5, 5.0, 5.5, 6.0, 8.0])
    ends = np.maximum(edges_s - 5.0, 0.0)
    expected = 0.02 * np.diff(ends + tau * np.exp(-ends / tau)) / np.diff(edges_s)
    np.testing.assert_allclose(bin_means(force, MOTION, edges_s, both)[0], expected, atol=2e-5)


def test_the_amplifier_smooths_steps_of_the_cell_s_zero():
    after_s = np.array([0.3, 0.8])
    force_n = reported(
        "amplifier-lag", "sensor-events", time_s=65.0 + after_s,
        amplifier_time=0.5, event_1_at=0.5, event_1_step=0.03, event_2_step=0.0,
    ) - reported("amplifier-lag", time_s=65.0 + after_s, amplifier_time=0.5)  # fmt: skip
    np.testing.assert_allclose(force_n, -0.03 * np.expm1(-after_s / 0.5), atol=1e-6)


def test_a_bent_cell_adds_the_square_of_the_force_that_acts_on_it():
    force_n = reported("cell-nonlinearity", "force-offset", cell_bend=-0.3, F0=0.04)
    np.testing.assert_allclose(force_n, 0.04 - 0.3 * skin(TIMES_S)[0] ** 2, atol=1e-15)
    force = observed([ALL["cell-nonlinearity"]], {"cell_bend": np.array([0.4])}, MOTION, straight)
    edges_s = np.arange(5.0, 14.0)
    ends = straight(edges_s)[0]
    expected = np.diff(ends**2 / 2 + 0.4 * ends**3 / 3) / np.diff(ends)
    np.testing.assert_allclose(bin_means(force, MOTION, edges_s)[0], expected, atol=1e-12)


@pytest.mark.parametrize("period", [0.6, 0.83, 4.0, 8.0])
@pytest.mark.parametrize("bin_s", [0.5, 2.35])
def test_bins_mean_a_moving_arm_over_all_its_cycles(period, bin_s):
    """The integral of (a + s F) sin in closed form, over even loading and at rest."""
    moving = ALL["periodic-motion"]
    chosen = {"motion_amplitude": 0.02, "motion_share": 0.05, "motion_period": period, "motion_phase": 0.3}
    values = {name: np.array([value]) for name, value in chosen.items()}
    force = observed([moving], values, MOTION, straight)
    rate = 2 * np.pi / period
    np.testing.assert_allclose(
        force(TIMES_S), straight(TIMES_S) * (1 + 0.05 * np.sin(rate * TIMES_S + 0.3))
        + 0.02 * np.sin(rate * TIMES_S + 0.3), atol=1e-15,
    )  # fmt: skip
    for edges_s in (np.arange(5.0, 14.4, bin_s), np.arange(14.4, 45.0, bin_s)):
        at, pull = rate * edges_s + 0.3, straight(edges_s)[0]
        slope = (pull[-1] - pull[0]) / (edges_s[-1] - edges_s[0])
        swung = -(0.02 + 0.05 * pull) * np.cos(at) / rate + 0.05 * slope * np.sin(at) / rate**2
        expected = (np.diff(swung) / np.diff(edges_s)) + 0.5 * (pull[1:] + pull[:-1])
        np.testing.assert_allclose(bin_means(force, MOTION, edges_s, [moving])[0], expected, atol=6e-5)


def test_the_arm_swings_the_skin_s_force_and_not_the_drive_s():
    chosen = {"motion_amplitude": 0.0, "motion_share": 0.1, "motion_period": 4.0}
    rubbing = {"Fc": 0.05, "presliding": 2e-5, "friction_start": 0.5}
    both = reported("device-friction", "periodic-motion", **chosen, **rubbing)
    apart = reported("periodic-motion", **chosen) + reported("device-friction", **rubbing)
    np.testing.assert_allclose(both, apart, atol=1e-15)


def test_events_are_refuted_where_samples_show_no_step():
    act = ALL["sensor-events"].act
    assert isinstance(act, Instrument)
    assert act.refuted is not None
    end_s = MOTION.time_s[-1]
    jumps = Jumps(np.array([0.5, 1.0]) * end_s, np.array([-0.01, -np.inf]), np.array([0.02, np.inf]))
    steps = {f"event_{i}_at": np.full(4, 0.4 * i) for i in (1, 2)}
    steps |= {"event_1_step": np.array([0.01, 0.03, -0.02, 0.03])}
    steps |= {"event_2_step": np.array([0.005, 0.005, 0.01, 0.04])}  # of which samples say nothing
    assert act.refuted(steps, MOTION, jumps).tolist() == [False, True, True, False]


def test_events_and_drift_add_what_they_say():
    force_n = reported(
        "sensor-events", event_1_at=0.25, event_1_step=0.03, event_2_at=0.5, event_2_step=-0.01
    )
    np.testing.assert_allclose(force_n[[324, 326, 649, 651]], [0.0, 0.03, 0.03, 0.02], atol=1e-15)
    np.testing.assert_allclose(reported("sensor-drift", drift=1e-4), 1e-4 * TIMES_S)
    np.testing.assert_allclose(reported("force-offset", F0=-0.02), -0.02)


def test_lines_are_numpys_whatever_the_order_of_the_times():
    rng = np.random.default_rng(2)
    grid, values = np.cumsum(rng.uniform(0.1, 1.0, 40)), rng.normal(size=(5, 40))
    times = np.concatenate([rng.uniform(-1.0, grid[-1] + 1.0, (5, 300)), np.tile(grid, (5, 1))], axis=1)
    for at_s in (times, np.sort(times), times[0]):
        rows = np.broadcast_to(at_s, times.shape)
        expected = [np.interp(time_s, grid, row) for time_s, row in zip(rows, values, strict=True)]
        np.testing.assert_allclose(interpolated(grid, values, at_s), expected, rtol=0, atol=1e-13)


def test_bin_means_are_exact_across_corners():
    edges = np.arange(0.0, 130.5, 0.5)
    fine = np.union1d(np.linspace(0.0, 130.0, 130_001), MOTION.time_s)
    integral = np.concatenate(
        [[0.0], np.cumsum(0.5 * np.diff(fine) * (skin(fine)[0, 1:] + skin(fine)[0, :-1]))]
    )
    expected = np.diff(np.interp(edges, fine, integral)) / 0.5
    np.testing.assert_allclose(bin_means(skin, MOTION, edges)[0], expected, atol=1e-9)


PLUGIN = """
from bayeskin.mechanisms.mechanism import Instrument, Mechanism, Place, added
from bayeskin.types import Parameter
MECHANISM = Mechanism(
    name="{name}",
    parameters=(
        Parameter("{parameter}", "N", 0.0, 1.0, "uniform"),
        Parameter("rust", "-", {lower}, 1.0, "log-uniform"),
    ),
    neutral={{"{neutral}": 0.0}},
    statement=lambda v: "A magnet.",
    act=Instrument(
        Place.CELL,
        lambda values, motion, force: added(force, lambda t: values["{parameter}"][:, None] + 0 * t),
    ),
    {more}
)
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Installs a package beside bayeskin that brings a mechanism of its own."""

    def install(name: str, parameter: str, more: str = "", neutral: str = "", lower: float = 0.01) -> None:
        text = PLUGIN.format(
            name=name, parameter=parameter, more=more, neutral=neutral or parameter, lower=lower
        )
        (tmp_path / "magnet.py").write_text(text)
        info = tmp_path / "magnet-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: magnet\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[bayeskin.mechanisms]\nmagnet = magnet:MECHANISM\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    yield install
    sys.modules.pop("magnet", None)


def test_another_package_adds_a_mechanism(plugin):
    plugin("magnet", "pull")
    assert "magnet" in catalogue()
    force = observed([catalogue()["magnet"]], {"pull": np.array([0.2])}, MOTION, skin)
    np.testing.assert_allclose(force(TIMES_S), skin(TIMES_S) + 0.2)


def test_a_need_of_what_there_is_not_is_refused(plugin):
    plugin("magnet", "pull", "needs=('iron',),")
    with pytest.raises(InputError, match="magnet: it needs iron"):
        catalogue()


@pytest.mark.parametrize(
    ("name", "parameter", "message"),
    [
        ("force-offset", "pull", "the name force-offset"),
        ("magnet", "F0", "force-offset and magnet have a parameter F0"),
    ],
)
def test_two_of_one_name_are_refused(plugin, name, parameter, message):
    plugin(name, parameter)
    with pytest.raises(InputError, match=message):
        catalogue()


def test_a_parameter_without_a_neutral_value_gets_the_median_of_its_prior(plugin):
    plugin("magnet", "pull")
    assert catalogue()["magnet"].neutral == {"rust": pytest.approx(0.1), "pull": 0.0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"neutral": "pul"}, "magnet: `neutral` names pul; it must name at least one .* pull, rust"),
        ({"lower": 0.0}, "magnet: rust: its prior is log-uniform from 0 to 1; the lower bound"),
        ({"lower": 2.0}, "magnet: rust: its prior is log-uniform from 2 to 1; the lower bound"),
        (
            {"more": "coil=3"},
            r"entry point magnet = magnet:MECHANISM: it cannot be imported \(TypeError.*import magnet",
        ),
        ({"more": "); MECHANISM = dict("}, "magnet:MECHANISM: it is an object of the type dict"),
    ],
)
def test_a_mechanism_of_another_package_that_cannot_work_is_refused_in_one_line(plugin, changes, message):
    plugin("magnet", "pull", **changes)
    with pytest.raises(InputError, match=message):
        catalogue()
