"""Every result has a figure: complete for typical input, sound for degenerate input, the same bytes twice."""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.quiver import Quiver
from toy import EDGES_S, MOTION, SPACE, toy_bin_means, toy_force

from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.inference import Corrected, Profile, ResidualCheck, Weighed
from bayeskin.inference.convergence import Limits, Verdict
from bayeskin.report import posterior, style, timeline, traces, triangle, validation
from bayeskin.types import BinnedForce, Design, Parameter, ParameterSpace, Phase, Prediction, Recording

pytestmark = pytest.mark.filterwarnings("error")

TRUTH = np.array([1.2e5, 1.8e4, 3e-14, 4e-13, 300.0])
EDGES = EDGES_S[::4]
BINS = len(EDGES) - 1
PHASES = tuple(
    Phase(kind, cycle, start, end)
    for kind, cycle, start, end in [
        ("rest", 0, 0.0, 5.0), ("load", 1, 5.0, 15.0), ("hold", 1, 15.0, 45.0), ("unload", 1, 45.0, 55.0),
        ("rest", 1, 55.0, 65.0), ("load", 2, 65.0, 75.0), ("hold", 2, 75.0, 105.0),
        ("unload", 2, 105.0, 115.0), ("rest", 2, 115.0, 130.0),
    ]
)  # fmt: skip
TIME_S = 0.5 * (EDGES[1:] + EDGES[:-1])
DISPLACEMENT_M = MOTION.at(TIME_S)


@pytest.fixture(scope="module")
def force_n() -> np.ndarray:
    return 1e-3 * toy_bin_means(TRUTH, EDGES)[0]


@pytest.fixture(scope="module")
def binned(force_n: np.ndarray) -> BinnedForce:
    starts = np.array([p.start_s for p in PHASES])
    phase = np.searchsorted(starts, TIME_S, side="right") - 1
    noisy = force_n + 0.006 * np.random.default_rng(2).normal(size=BINS)
    return BinnedForce(EDGES, noisy, np.full(BINS, 0.006**2), np.full(BINS - 1, 0.3), phase, PHASES)


@pytest.fixture(scope="module")
def recording() -> Recording:
    time_s = np.arange(0.0, 130.0, 0.02)
    noise = 0.02 * np.random.default_rng(3).normal(size=len(time_s))
    return Recording(time_s, MOTION.at(time_s), 1e-3 * toy_force(TRUTH, time_s)[0] + noise, "arm", "0" * 64)


@pytest.fixture(scope="module")
def draws() -> np.ndarray:
    """2,000 points: E_c, E_s and k_s narrow and correlated, k_c and p_init spread over the prior."""
    rng = np.random.default_rng(4)
    unit = rng.random((2000, 5))
    ridge = rng.normal(size=2000)
    unit[:, 0] = 0.5 + 0.02 * ridge
    unit[:, 1] = 0.5 - 0.04 * ridge + 0.005 * rng.normal(size=2000)
    unit[:, 3] = 0.6 + 0.05 * rng.normal(size=2000)
    return SPACE.from_unit(unit)


def labels(figure: Figure) -> list[str]:
    return [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]


def headline(figure: Figure) -> str:
    return figure.get_suptitle().replace("\n", " ")


def drawn(figure: Figure) -> Figure:
    figure.draw_without_rendering()
    return figure


# --- what holds for every figure ------------------------------------------------------------------


def one_panel(draws: np.ndarray) -> Figure:
    return report.figure_posterior(SPACE, draws[:300], {}, names=("E_s",))


def test_both_formats_are_written_with_their_provenance(tmp_path: Path, draws: np.ndarray) -> None:
    figure = one_panel(draws)
    png, svg = report.save_figure(figure, tmp_path / "deep" / "prior.v2", "bayeskin 0.1 seed 7")
    assert (png.name, svg.name) == ("prior.v2.png", "prior.v2.svg")
    assert imread(png).shape[1] == 700  # 3.5 in at 200 dpi
    assert b"bayeskin 0.1 seed 7" in png.read_bytes()
    assert "bayeskin 0.1 seed 7" in svg.read_text()
    assert "dc:date" not in svg.read_text()
    assert sorted(p.name for p in png.parent.iterdir()) == ["prior.v2.png", "prior.v2.svg"]


@pytest.mark.parametrize("kind", ["prior", "posterior", "fields"])
def test_the_same_input_gives_the_same_bytes(
    tmp_path: Path, kind: str, binned: BinnedForce, draws: np.ndarray
) -> None:
    def figure() -> Figure:
        if kind == "prior":
            return report.figure_prior_predictive(binned, np.tile(binned.force_n, (4, 1)))
        if kind == "posterior":
            return report.figure_posterior(SPACE, draws[:300], {}, names=("E_c", "E_s"))
        points, quads = surface()
        field = report.SurfaceField("u", "mm", points[:1, quads[:, 0], 0])
        return report.figure_fields(["5 s"], points[:1], quads, 0 * quads[:, 0], [], [field], "")

    one = figure()
    written = [report.save_figure(f, tmp_path / str(i), "x") for i, f in enumerate((one, figure(), one))]
    assert len({tuple(path.read_bytes() for path in paths) for paths in written}) == 1


def test_a_failed_rendering_leaves_the_earlier_files(tmp_path: Path, draws: np.ndarray) -> None:
    good = one_panel(draws)
    before = [p.read_bytes() for p in report.save_figure(good, tmp_path / "a", "x")]
    bad = Figure()
    bad.text(0.5, 0.5, r"$\unknowncommand$")
    with pytest.raises(ValueError, match="unknowncommand"):
        report.save_figure(bad, tmp_path / "a", "x")
    assert [(tmp_path / f"a.{form}").read_bytes() for form in ("png", "svg")] == before
    assert len(list(tmp_path.iterdir())) == 2


def test_the_callers_settings_neither_matter_nor_change(tmp_path: Path, draws: np.ndarray) -> None:
    def svg(name: str) -> bytes:
        return report.save_figure(one_panel(draws), tmp_path / name, "x")[1].read_bytes()

    plain = svg("plain")
    before = dict(rcParams)
    try:
        rcParams.update({"font.size": 23.0, "axes.grid": True, "text.usetex": True})
        altered = svg("altered")
        assert rcParams["font.size"] == 23.0
    finally:
        rcParams.update({key: before[key] for key in ("font.size", "axes.grid", "text.usetex")})
    assert altered == plain


# --- recording ------------------------------------------------------------------------------------


def test_recording_shows_phases_cycles_and_loops(recording: Recording, binned: BinnedForce) -> None:
    figure = drawn(report.figure_recording(recording, binned))
    assert labels(figure) == ["displacement [mm]", "time [s]", "force [N]", "displacement [mm]", "force [N]"]
    motion, force, loops = figure.axes
    assert {t.get_text() for t in motion.texts} == {"cycle 1", "cycle 2"}
    assert len(force.patches) == sum(p.kind != "rest" for p in PHASES)
    assert [line.get_label() for line in loops.get_lines()] == ["cycle 1", "cycle 2"]
    assert np.ptp(motion.get_lines()[0].get_ydata()) == pytest.approx(9.0)
    assert headline(figure).startswith("arm: 2 cycles to 9 mm")


@pytest.mark.parametrize("name", ["arm_$1_left_$2_.csv", "P$03_$S1.xlsx", "$", "a$b_c", r"c:\\$x_{1}$.csv"])
def test_a_files_name_is_no_markup(
    recording: Recording, binned: BinnedForce, name: str, tmp_path: Path
) -> None:
    figure = report.figure_recording(dataclasses.replace(recording, name=name), binned)
    _, svg = report.save_figure(figure, tmp_path / "recording", "x")
    shown = re.sub(r"\s", "", "".join(re.findall(r"<!-- (.*?) -->", svg.read_text())))
    assert name in shown  # as it stands, each sign of it


def test_recording_of_nothing_but_rest(recording: Recording, binned: BinnedForce) -> None:
    still = dataclasses.replace(recording, displacement_m=np.zeros_like(recording.time_s))
    rest = dataclasses.replace(
        binned, phase=np.zeros(BINS, dtype=int), phases=(Phase("rest", 0, 0.0, 130.0),)
    )
    assert headline(drawn(report.figure_recording(still, rest))).startswith("arm: 0 cycles to 0 mm")


# --- fit ------------------------------------------------------------------------------------------


def test_fit_tells_the_parts_of_the_uncertainty_apart(binned: BinnedForce, force_n: np.ndarray) -> None:
    rng = np.random.default_rng(5)
    ensemble = force_n * (1 + 0.01 * rng.normal(size=(50, 1)))
    fitted = TIME_S < 60
    predictive = {
        "mean_n": ensemble,
        "surrogate_sd_n": 0.01 * np.abs(ensemble),
        "noise_sd_n": np.full(BINS, 0.006),
        "force_n": ensemble + 0.008 * rng.normal(size=ensemble.shape),
    }
    figure = drawn(report.figure_fit(binned, DISPLACEMENT_M, fitted, **predictive))
    force, residual, parts, loop, _ = figure.axes
    assert {line.get_label() for line in parts.get_lines()} == {"model", "surrogate", "noise", "all"}
    assert residual.get_ylabel() == "residual [mN]"
    assert len(residual.collections) == 2  # the 50 % and the 90 % band
    shown = next(line for line in residual.get_lines() if line.get_label() == "recorded")
    expected = 1e3 * (binned.force_n - np.median(ensemble, axis=0))[fitted]
    np.testing.assert_allclose(shown.get_ydata(), expected)
    bar = next(line for line in force.get_lines() if line.get_linewidth() == 3)
    np.testing.assert_allclose(bar.get_xdata(), [0.0, 60.0])
    assert {line.get_label() for line in loop.get_lines()} == {"recorded", "posterior median"}
    assert "where it was fitted" in headline(figure)


def test_fit_of_one_draw_without_surrogate_error_or_fitted_bins(
    binned: BinnedForce, force_n: np.ndarray
) -> None:
    figure = report.figure_fit(
        binned, DISPLACEMENT_M, np.zeros(BINS, dtype=bool),
        mean_n=force_n, surrogate_sd_n=np.zeros(BINS), noise_sd_n=np.full(BINS, 0.006), force_n=force_n,
    )  # fmt: skip
    assert headline(drawn(figure)).startswith("Predicted without fitting")


def test_fit_without_any_uncertainty_and_with_a_phase_kind_missing(
    binned: BinnedForce, force_n: np.ndarray
) -> None:
    no_hold = tuple(dataclasses.replace(p, kind="rest") if p.kind == "hold" else p for p in PHASES)
    bins = dataclasses.replace(binned, phases=no_hold)
    exact = np.tile(force_n, (3, 1))
    nothing = np.zeros(BINS)
    figure = drawn(
        report.figure_fit(
            bins,
            DISPLACEMENT_M,
            np.ones(BINS, dtype=bool),
            mean_n=exact,
            surrogate_sd_n=nothing,
            noise_sd_n=nothing,
            force_n=exact,
        )
    )
    kinds = [line.get_label() for line in figure.axes[4].get_lines() if not line.get_label().startswith("_")]
    assert kinds == ["rest", "load", "unload"]
    assert "elsewhere" not in headline(figure)


def test_predictive_bands_hold_what_they_promise() -> None:
    """Model and noise, both normal: sd 5 and 12 add to 13."""
    rng = np.random.default_rng(6)
    mean = 5.0 * rng.normal(size=(20_000, 1))
    force = mean + 12.0 * rng.normal(size=mean.shape)
    bands = timeline.predictive_bands(mean, np.array([4.0]), np.full_like(mean, 12.0), force)
    half = 0.5 * (bands.high_n - bands.low_n)[:, 0]
    np.testing.assert_allclose(half, [0.6745 * 13, 1.6449 * 13], rtol=0.03)
    parts = [float(bands.parts_n[name][0]) for name in ("model", "surrogate", "noise", "all")]
    np.testing.assert_allclose(parts, 1.6449 * np.array([5.0, 4.0, 12.0, 13.0]), rtol=0.03)


def test_runs_of_true_cover_the_mask_exactly() -> None:
    assert timeline.runs_of([True, True, False, True]) == [(0, 2), (3, 4)]
    assert timeline.runs_of([False, False]) == []


# --- posterior ------------------------------------------------------------------------------------


def test_posterior_says_what_the_recording_leaves_open(draws: np.ndarray) -> None:
    figure = drawn(report.figure_posterior(SPACE, draws, dict(zip(SPACE.names, TRUTH, strict=True))))
    assert len(figure.axes) == 15
    assert "log$_{10}$ $E_{c}$ / Pa" in labels(figure)
    assert "$p_{\\mathrm{init}}$ [Pa]" in labels(figure)
    narrowed, left = headline(figure).split("leaves")
    assert "E_{s}" in narrowed
    assert "k_{c}" in left
    assert "init" in left
    flat = next(ax for ax in figure.axes if ax.get_subplotspec().get_geometry()[2:] == (22, 22))
    assert not flat.collections  # p_init over k_c: tinted evenly, no contour of sampling scatter


def test_posterior_of_a_chosen_pair_and_of_one(draws: np.ndarray) -> None:
    assert len(drawn(report.figure_posterior(SPACE, draws, {}, names=("E_s", "k_s"))).axes) == 3
    assert len(drawn(report.figure_posterior(SPACE, draws, {}, names=("p_init",))).axes) == 1
    with pytest.raises(InputError, match="E_q"):
        report.figure_posterior(SPACE, draws, {}, names=("E_q",))


def test_posterior_that_does_not_move() -> None:
    constant = np.tile(TRUTH, (50, 1))
    assert len(drawn(report.figure_posterior(SPACE, constant, {"E_c": 1.2e5})).axes) == 15


def test_posterior_of_eleven_parameters(draws: np.ndarray) -> None:
    further = tuple(Parameter(f"gap_{c}_length", "m", 1e-6, 3e-4, "uniform") for c in "abcdef")
    wide = np.column_stack([draws, np.random.default_rng(7).uniform(1e-6, 3e-4, (2000, 6))])
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
    """Of exp(-r^2/2) the region that holds a share s of the mass is bounded at the height 1 - s."""
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
    assert style.unit_text("m^2") == "m²"
    assert style.unit_text("mm N^-1 s^-1") == "mm N⁻¹ s⁻¹"
    assert style.unit_text("-") == ""


# --- traces ---------------------------------------------------------------------------------------


TRUSTED = Verdict(True, ("60 autocorrelation lengths; 50 needed",))
DOUBTED = Verdict(False, ("R-hat across 4 ensembles 1.2 of k_s; at most 1.01 allowed", "all else in order"))


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
    assert headline(figure) == "Trusted: 60 autocorrelation lengths; 50 needed"


def test_an_untrusted_run_is_headed_by_its_first_reason(chains: np.ndarray) -> None:
    figure = report.figure_traces(SPACE, chains, DOUBTED, Limits())
    assert headline(figure).startswith("Not trusted: R-hat across 4 ensembles 1.2 of k_s")


def test_traces_of_chains_that_are_constant_or_too_short(chains: np.ndarray) -> None:
    pair = ParameterSpace(SPACE.parameters[:2])
    still = drawn(report.figure_traces(pair, np.broadcast_to(TRUTH[:2], (2, 40, 6, 2)), DOUBTED, Limits()))
    assert [t.get_text() for ax in still.axes[1:3] for t in ax.texts] == ["does not move", "undefined"]
    assert drawn(report.figure_traces(pair, chains[:1, :3, :, :2], DOUBTED, Limits()))
    assert drawn(report.figure_traces(pair, chains[:1, :30, :, :2], DOUBTED, Limits()))


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


# --- Sobol ----------------------------------------------------------------------------------------


def interval(values: np.ndarray) -> np.ndarray:
    return np.stack([values - 0.02, values, values + 0.02])


def test_sobol_names_the_leading_and_the_inert_parameters() -> None:
    share = np.array([0.53, 0.41, 0.0, 0.06, 0.0])
    series = interval(np.tile(share, (BINS, 1)))
    series[:, :3] = np.nan  # no force before the test, no variance
    figure = drawn(
        report.figure_sobol(
            SPACE.names, TIME_S, DISPLACEMENT_M, series, series, interval(share), interval(share),
            "posterior",
        )
    )  # fmt: skip
    assert "Inputs: posterior." in figure.get_supxlabel()
    assert "E_{c}" in headline(figure)
    assert "53 %" in headline(figure)
    assert "below 0.5 %" in headline(figure)
    first, total, bars = figure.axes
    assert (first.get_ylabel(), total.get_ylabel()) == ("first-order index", "total index")
    assert [t.get_text() for t in bars.get_yticklabels()] == [style.symbol(n) for n in SPACE.names]
    assert len(bars.patches) == 10


def test_sobol_of_a_force_that_never_varies() -> None:
    nothing = np.full((3, BINS, 5), np.nan)
    figure = report.figure_sobol(
        SPACE.names, TIME_S, 0 * DISPLACEMENT_M, nothing, nothing, nothing[:, 0], nothing[:, 0], "prior"
    )
    assert headline(drawn(figure)).startswith("The force does not vary")


# --- surrogate ------------------------------------------------------------------------------------


def calibrated(true_n: np.ndarray, rng: np.random.Generator) -> Prediction:
    """A prediction whose errors are exactly what it claims: 2 % common to a run, 1 % a bin of its own."""
    factor = 0.02 * np.abs(true_n)[..., None]
    own = 0.01 * np.abs(true_n)
    error = factor[..., 0] * rng.normal(size=(len(true_n), 1)) + own * rng.normal(size=true_n.shape)
    return Prediction(true_n + error, factor, own**2)


def held_out(n: int) -> np.ndarray:
    return 1e-3 * toy_bin_means(SPACE.from_unit(np.random.default_rng(12).random((n, 5))), EDGES)


def test_validation_shows_amplitude_coverage_waves_and_noise_floor() -> None:
    true = held_out(40)
    errors = np.random.default_rng(13).lognormal(-3.0, 0.3, (3, 40))
    prediction = calibrated(true, np.random.default_rng(14))
    figure = drawn(report.figure_validation(EDGES, true, prediction, np.full(BINS, 0.006), errors))
    assert "peak of the full model [N]" in labels(figure)
    assert "nominal coverage" in labels(figure)
    assert "error [mN]" in labels(figure)
    names = {line.get_label() for line in figure.axes[3].get_lines()}
    assert {"RMS error", "noise floor of the recording"} <= names
    assert "90 % intervals hold" in headline(figure)


def test_validation_of_one_run_in_one_wave_without_error() -> None:
    true = held_out(1)
    exact = Prediction(true, np.zeros((*true.shape, 1)), np.zeros_like(true))
    assert drawn(report.figure_validation(EDGES, true, exact, np.zeros(BINS), np.zeros((1, 1))))


def test_coverage_of_a_calibrated_prediction_is_nominal() -> None:
    true = held_out(400)
    nominal = np.array([0.5, 0.9])
    share, error = validation.coverage(true, calibrated(true, np.random.default_rng(15)), nominal)
    assert np.all(np.abs(share - nominal) < 3 * error)
    assert np.all(error < 0.03)
    half = calibrated(true, np.random.default_rng(15))
    narrow = Prediction(half.mean, 0.5 * half.factor, 0.25 * half.diagonal)
    assert validation.coverage(true, narrow, nominal)[0][1] == pytest.approx(
        0.589, abs=0.04
    )  # 0.5 x 1.645 sd


def test_map_check_is_in_millinewton_and_in_sd(binned: BinnedForce, force_n: np.ndarray) -> None:
    sd = 0.002 * (TIME_S > 5)
    figure = drawn(report.figure_map_check(binned, force_n, force_n + 0.004 * (TIME_S > 5), sd))
    assert [ax.get_ylabel() for ax in figure.axes] == ["force [N]", "error [mN]", "error [surrogate sd]"]
    assert "at most 2 of its sd" in headline(figure)
    assert drawn(report.figure_map_check(binned, force_n, force_n, np.zeros(BINS)))


# --- design, prior --------------------------------------------------------------------------------


def design(waves: int, space: ParameterSpace = SPACE) -> Design:
    rng = np.random.default_rng(16)
    wave = np.repeat(np.arange(waves), 30)
    n = len(wave)
    unit = 0.5 + (rng.random((n, space.dim)) - 0.5) * 0.5 ** wave[:, None]
    ok = np.arange(n) != 7
    return Design(
        space, EDGES, space.from_unit(unit), np.zeros((n, BINS)), wave, rng.random(n) < 0.2, ok, ("",) * n,
        np.ones(n), 0, "toy",
    )  # fmt: skip


def test_waves_show_every_pair_and_the_volume_kept() -> None:
    figure = drawn(report.figure_waves(design(3), [1.0, 0.1, 0.008]))
    assert len(figure.axes) == 10 + 1
    assert figure.axes[-1].get_ylabel() == "volume kept [%]"
    assert headline(figure) == "90 runs in 3 waves close in on 0.8 % of the prior box; 1 failed"
    key = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert key == ["wave 0", "wave 1", "wave 2", "held out", "failed"]


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_one_wave_of_any_dimension(dim: int) -> None:
    space = ParameterSpace(SPACE.parameters[:dim])
    assert "1 wave fill the prior box" in headline(drawn(report.figure_waves(design(1, space), [1.0])))


def profile(name: str, top: float, deep: bool) -> Profile:
    p = SPACE.parameters[SPACE.names.index(name)]
    values = SPACE.from_unit(np.repeat(np.linspace(0, 1, 9)[:, None], 5, axis=1))[:, SPACE.names.index(name)]
    drop = -50.0 * (np.linspace(0, 1, 9) - top) ** 2 if deep else np.zeros(9)
    return Profile(name, values, drop, (p.lower, p.upper), not deep, not deep)


def test_profiles_name_what_the_fit_does_not_exclude(draws: np.ndarray) -> None:
    some = [profile("E_c", 0.5, True), profile("p_init", 0.5, False)]
    figure = drawn(report.figure_profiles(SPACE, draws, some))
    assert "excludes no value of" in headline(figure)
    assert "init" in headline(figure)
    assert "E_c" not in headline(figure)
    assert "bounds every parameter" in headline(drawn(report.figure_profiles(SPACE, draws, some[:1])))


def test_profiles_of_many_parameters_take_several_rows(draws: np.ndarray) -> None:
    names = [f"x{i}" for i in range(10)]
    space = ParameterSpace(tuple(Parameter(name, "Pa", 1.0, 2.0, "uniform") for name in names))
    values = np.linspace(1.0, 2.0, 5)
    some = [Profile(name, values, -values, (1.0, 2.0), False, False) for name in names]
    figure = drawn(report.figure_profiles(space, np.linspace(1.0, 2.0, 40).reshape(4, 10), some))
    assert len([ax for ax in figure.axes if ax.lines]) == 10
    assert len({round(ax.get_position().y0, 3) for ax in figure.axes}) == 2


def test_the_model_check_says_what_moves_most(draws: np.ndarray) -> None:
    weights = np.array([0.4, 0.3, 0.2, 0.1])
    found = Weighed(SPACE, draws[:4], np.log(weights), weights, 10 / 3, float("nan"), Verdict(True, ("",)))
    quantiles = (0.5, 1.0, 2.0)
    moved = [Corrected(n, quantiles, -0.8 if n == "k_s" else 0.1, 0.05, 1.0) for n in SPACE.names]
    figure = drawn(report.figure_model_check(found, moved))
    assert "By 4 full runs 3 draws remain effective" in headline(figure)
    assert "k_" in headline(figure)
    assert "0.80 of its sd" in headline(figure)


def left(scores: np.ndarray, p_correlation: float) -> ResidualCheck:
    return ResidualCheck(scores, np.linspace(0.3, -0.1, 10), 0.5, p_correlation, ())


def test_what_is_left_is_drawn_against_the_assumed_noise() -> None:
    scores = np.random.default_rng(5).normal(size=200)
    figure = drawn(report.figure_residuals(left(scores, 0.2)))
    assert headline(figure) == "What the fit leaves looks like the assumed noise"
    points = figure.axes[0].lines[-1]
    assert np.array_equal(points.get_ydata(), np.sort(scores))
    assert np.all(np.diff(points.get_xdata()) > 0)
    assert figure.axes[1].patches[0].get_y() == pytest.approx(-1.96 / np.sqrt(200), rel=1e-3)
    outside = [line.get_ydata() for line in figure.axes[1].lines if line.get_color() == style.ACCENT]
    assert np.concatenate(outside) == pytest.approx(np.linspace(0.3, -0.1, 10)[:4])
    figure = drawn(report.figure_residuals(left(scores, 1e-9)))
    assert headline(figure) == "What the fit leaves is not the assumed noise"
    assert "correlated otherwise" in figure.get_supxlabel().replace("\n", " ")
    assert drawn(report.figure_residuals(ResidualCheck(scores[:1], np.empty(0), 0.5, np.nan, ())))


def test_prior_predictive_places_the_recorded_peak(binned: BinnedForce) -> None:
    scale = np.array([0.5, 0.5, 0.5, 2.0])[:, None]
    figure = drawn(report.figure_prior_predictive(binned, scale * binned.force_n))
    assert "above 75 % of the prior's" in headline(figure)
    assert figure.axes[0].get_yscale() == "symlog"
    silent = dataclasses.replace(binned, force_n=np.zeros(BINS))
    assert drawn(report.figure_prior_predictive(silent, np.zeros((3, BINS))))


# --- fields ---------------------------------------------------------------------------------------


def surface() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 0.105, 8), np.linspace(0, 0.084, 7), indexing="ij")
    points = np.stack([x, 0.058 * np.sin(y / 0.058), 0.058 * np.cos(y / 0.058)], axis=-1).reshape(-1, 3)
    node = np.arange(56).reshape(8, 7)
    quads = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.stack([points, points + np.array([1e-3, 0, 0])]), quads


ROWS = ["5 s", "15 s"]


@pytest.mark.parametrize("corners", [3, 4])
def test_fields_are_small_multiples_with_one_scale_a_column(corners: int) -> None:
    points, quads = surface()
    ramp = np.stack([0 * points[0, quads[:, 0], 0], points[0, quads[:, 0], 0]])
    columns = [
        report.SurfaceField("displacement", "mm", ramp),
        report.SurfaceField("pressure", "kPa", 5 * ramp, signed=True),
    ]
    part = np.arange(len(quads)) % 3
    figure = drawn(report.figure_fields(ROWS, points, quads[:, :corners], part, [2], columns, "It moves"))
    assert headline(figure) == "It moves"
    assert [ax.texts[0].get_text() for ax in figure.axes[:6:3]] == ROWS
    displacement, pressure = (ax for ax in figure.axes if ax.get_xlabel())
    assert displacement.get_xlabel() == "displacement [mm]"
    assert displacement.get_xlim() == (0.0, pytest.approx(ramp.max()))
    assert pressure.get_xlim() == pytest.approx((-5 * ramp.max(), 5 * ramp.max()))


def test_the_view_shows_x_to_the_right_y_away_and_z_up() -> None:
    points, quads = surface()
    field = report.SurfaceField("u", "mm", np.zeros((1, len(quads))))
    figure = drawn(report.figure_fields(["5 s"], points[:1], quads, 0 * quads[:, 0], [], [field], ""))
    x, y, z = (line.get_xydata()[1] - line.get_xydata()[0] for line in figure.axes[1].lines[-3:])
    assert x[0] > 4 > abs(x[1])
    assert y[1] > 0 > y[0]
    assert z == pytest.approx([0.0, z[1]])
    assert z[1] > 0


def test_vectors_are_arrows_of_one_length_where_their_logarithmic_scale_reaches() -> None:
    points, quads = surface()
    along_x = np.zeros((2, len(quads), 3))
    along_x[0, :, 0], along_x[1, :, 0] = 1.0, -1e-3
    along_x[0, 0, 0] = 20.0
    speed = np.linalg.norm(along_x, axis=-1)
    field = report.SurfaceField("velocity", "µm/s", speed, directions=along_x)
    figure = drawn(report.figure_fields(ROWS, points, quads, 0 * quads[:, 0], [], [field], "Flow"))
    fast, slow = figure.axes[1], figure.axes[3]
    arrows = next(c for c in fast.collections if isinstance(c, Quiver))
    assert np.ptp(arrows.U) == np.ptp(arrows.V) == 0
    assert arrows.U[0] > 0
    assert not [c for c in slow.collections if isinstance(c, Quiver)], "below the scale no direction is drawn"
    bar = next(ax for ax in figure.axes if ax.get_xlabel() == "velocity [µm/s]")
    assert bar.get_xlim() == pytest.approx((0.2, 20.0))


def test_fields_that_are_zero_and_shapes_that_do_not_fit() -> None:
    points, quads = surface()
    part, none = 0 * quads[:, 0], np.zeros((2, len(quads)))
    columns = [
        report.SurfaceField("pressure", "kPa", none, signed=True),
        report.SurfaceField("velocity", "m/s", none, directions=np.zeros((2, len(quads), 3))),
    ]
    assert drawn(report.figure_fields(ROWS, points, quads, part, [], columns, "Nothing"))
    wrong = report.SurfaceField("pressure", "kPa", np.zeros((2, 3)))
    flat = report.SurfaceField("velocity", "m/s", none, directions=np.zeros((2, len(quads), 2)))
    for field in (wrong, flat):
        with pytest.raises(InputError, match=field.label):
            report.figure_fields(ROWS, points, quads, part, [], [field], "")
    with pytest.raises(InputError, match="points"):
        report.figure_fields(ROWS[:1], points, quads, part, [], columns, "")
    with pytest.raises(InputError, match="faces"):
        report.figure_fields(ROWS, points, quads + 40, part, [], columns, "")
    with pytest.raises(InputError, match="parts"):
        report.figure_fields(ROWS, points, quads, part[:3], [], columns, "")


def test_names_along_a_large_triangle_do_not_run_into_each_other() -> None:
    names = ("sd_rest", "sd_load", "sd_hold", "sd_unload", *(f"E_{letter}" for letter in "abdefgh"))
    one = dataclasses.replace(SPACE.parameters[0], unit="N", prior="log-uniform", lower=1e-4, upper=0.3)
    space = ParameterSpace(tuple(dataclasses.replace(one, name=name) for name in names))
    draws = 10.0 ** np.random.default_rng(1).uniform(-3.5, -1.0, (400, len(names)))
    figure = drawn(report.figure_posterior(space, draws, {}))
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes if ax.get_ylabel()]
    boxes.sort(key=lambda box: -box.y1)
    assert len(boxes) == 10
    assert all(lower.y1 <= upper.y0 for upper, lower in itertools.pairwise(boxes))
