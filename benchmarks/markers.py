"""Measures what 25 markers between the pads add to the force, on concealed recordings of the full model.

Each case is a run of the full model on the article's device: 6 mm of opening, a hold of 30 s, a return. The
force gets noise as in `noisy_recordings`. The markers are a grid of 5 x 5 points, seen every 2 s, with noise
of 0.02 mm and a random motion of the camera. Fits by the shipped reduced model start at the true skin, and
fits of the concealed mechanism at its true values. Their Laplace approximation gives the widths and the
evidence, with and without markers.

Data and fits are on the mesh of 448 bricks, so the correction for the mesh is left out. Its uncertainty is
allowed for. In the case "finer mesh" the data are from 1,540 bricks, and the correction is used.

    python benchmarks/markers.py        # half an hour of one core, the first time

The program stores finished fits in results/markers.csv, prints tables, writes them between the markers of
docs/markers.md, and draws docs/figures/markers.{png,svg}.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import rows
from markers_figure import figure_markers_add
from noisy_recordings import RATE_HZ, correlated_noise

from bayeskin import storage
from bayeskin.design import default_space
from bayeskin.finite_element.accepted import AcceptedSteps
from bayeskin.finite_element.formulation import RunRequest
from bayeskin.finite_element.mesh_change import mesh_change
from bayeskin.finite_element.problem import Problem, material
from bayeskin.finite_element.reaction import Reaction
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.finite_element.surface_points import SurfaceTracks, surface_displacement
from bayeskin.forward.interface import ModelRun
from bayeskin.forward.reduced import ReducedForward
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import catalogue, laws
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.trust_region import fit_set
from bayeskin.recordings import analyse, bin_recording, covered_s, segment, uniform_edges
from bayeskin.reduced.files import load_reduced
from bayeskin.report import save_figure
from bayeskin.shipped import shipped
from bayeskin.types import Array, Markers, PadMotion, Recording, Simulation
from bayeskin.workflow.diagnosis_tasks import ContextSource, open_context

MOTION = PadMotion(np.array([0.0, 5.0, 10.0, 40.0, 45.0, 60.0]), 1e-3 * np.array([0, 0, 6, 6, 0, 0.0]))
TICKS_M = 1e-3 * np.linspace(-12.0, 12.0, 5)
PLACES_M = np.stack(np.meshgrid(TICKS_M, TICKS_M, indexing="ij"), axis=-1).reshape(-1, 2)
IMAGES_S = np.arange(0.0, 60.1, 2.0)
SD_M, CAMERA_M, CAMERA_RAD = 2e-5, 1e-4, 2e-3
MODEL = shipped("surrogates/article-device-reduced.h5")
PAGE = Path(__file__).parents[1] / "docs" / "markers.md"
SKINS = {
    "usual": {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0},
    "demo": {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 700.0},
    "stiff": {"E_c": 600e3, "E_s": 20e3, "k_c": 3e-15, "k_s": 3e-14, "p_init": 0.0},
}
# Effects on the usual skin: mechanism, its concealed values, and where fits of it to other effects start.
EFFECTS: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "fibre-anisotropy": (
        {"langer_ratio": 2.0, "langer_angle": np.pi / 2},
        {"langer_ratio": 1.5, "langer_angle": 0.8},
    ),
    "pre-stretch": ({"opening": 0.05}, {"opening": 0.03}),
    "bottom-adherence": ({"adherence": 1e7}, {"adherence": 1e6}),
    "skeleton-compressibility": ({"nu_c": 0.35, "nu_s": 0.3}, {"nu_c": 0.42, "nu_s": 0.28}),
    "strain-stiffening": (
        {"fibre_stress": 2e4, "k2": 5.0, "dispersion": 0.1},
        {"fibre_stress": 1e4, "k2": 4.0, "dispersion": 0.15},
    ),
}  # fmt: skip
TABLE = rows.Rows(
    rows.RESULTS / "markers.csv",
    ("case", "set", "markers", "model"),
    ("log_evidence", "settled", "force_rms_n", "marker_sd_m", "values", "sds"),
)


@dataclass(frozen=True)
class Case:
    """A concealed recording.

    slip : share of the pads' motion that the guard lacks; refinement : of the bricks of the full model
    """

    skin: str = "usual"
    effect: str = ""
    slip: float = 0.0
    refinement: int = 1

    @property
    def theta(self) -> dict[str, float]:
        return {**SKINS[self.skin], **(EFFECTS[self.effect][0] if self.effect else {})}


CASES = {
    "usual": Case(), "demo": Case("demo"), "stiff": Case("stiff"), "finer mesh": Case(refinement=2),
    **{effect: Case(effect=effect) for effect in EFFECTS},
    "guard that slips, 2 %": Case(slip=0.02), "guard that slips, 10 %": Case(slip=0.1),
}  # fmt: skip


@dataclass(frozen=True)
class SlippingGuard(Problem):
    """A test in which the guard moves by a share less than the pad."""

    slip: float = 0.0

    def prescribe(self, x: Array, pad_displacement_m: float) -> Array:
        out = super().prescribe(x, pad_displacement_m)
        out[3 * np.setdiff1d(self.pads, self.pad)] = (1.0 - self.slip) * pad_displacement_m
        return out


def full_run(case: Case) -> tuple[Simulation, Array]:
    """Returns a full run, and the displacements of the markers (t - 1, p, 2) [m]."""
    problem = problem_of("bricks", case.refinement)
    if case.slip:
        parts = (problem.mesh, problem.space, problem.pattern, problem.pad, problem.pads)
        problem = SlippingGuard(*parts, case.slip)
    tracks = SurfaceTracks(surface_displacement(problem, PLACES_M))
    bound = laws([catalogue()[case.effect]]) if case.effect else ()
    request = RunRequest(MOTION, case.theta, lambda _: problem, "", on_state=tracks.on_state, laws=bound)
    solid = material(case.theta, problem.mesh.cutis)
    simulation = Reaction(ModelSpec.tolerance).run_on(problem, solid, AcceptedSteps(request))
    if simulation.status != "ok":
        raise SystemExit(simulation.message)
    return simulation, tracks.since_first(simulation, IMAGES_S)


@cache
def change_of_mesh() -> Array:
    """Returns the change (t - 1, p, 2) [m] of the displacements from the coarse to the usual mesh."""
    markers = Markers(IMAGES_S, np.repeat(PLACES_M[None], len(IMAGES_S), axis=0), (), "", "")
    return mesh_change(ModelSpec(), MOTION, markers)


@cache
def concealed(name: str) -> Path:
    """Returns a folder with the noisy recording of a case, as the stage `recording` leaves it."""
    rows.say(f"{name}: full run")
    folder, (simulation, moved_m) = Path(tempfile.mkdtemp()), full_run(CASES[name])
    rng = np.random.default_rng([list(CASES).index(name), 61])
    time_s = np.arange(0.0, MOTION.time_s[-1] + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    force_n = simulation.at(time_s) + correlated_noise(rng, len(time_s))
    recording = Recording(time_s, MOTION.at(time_s), force_n, name, "0")
    phases = segment(recording)
    edges_s = uniform_edges(covered_s(recording, MOTION), 0.5)
    binned = bin_recording(recording, phases, edges_s, analyse(recording, phases))
    shape = (len(IMAGES_S) - 1, 1)
    moved_m = moved_m + CAMERA_M * rng.standard_normal((*shape, 2))
    moved_m = moved_m + CAMERA_RAD * rng.standard_normal((*shape, 1)) * PLACES_M[:, ::-1] * [-1.0, 1.0]
    moved_m = moved_m + SD_M * rng.standard_normal(moved_m.shape)
    position_m = PLACES_M + np.concatenate([np.zeros((1, *PLACES_M.shape)), moved_m])
    names = tuple(f"p{number}" for number in range(len(PLACES_M)))
    storage.save(folder / "recording.h5", recording)
    storage.save(folder / "motion.h5", MOTION)
    storage.save(folder / "binned.h5", binned)
    markers = Markers(IMAGES_S, position_m, names, name, "0")
    storage.save(folder / "markers.h5", replace(markers, mesh_change_m=change_of_mesh()))
    return folder


def context_of(name: str, markers: bool) -> DiagnosisContext:
    """Returns the context of a case's diagnosis, with its markers or without them."""
    context = open_context(ContextSource(concealed(name), MODEL, ModelSpec(), 1, default_space()))
    if markers:
        return context
    assert isinstance(context.forward, ReducedForward)
    return replace(context, markers=None, forward=replace(context.forward, markers=None))


def fitted(name: str, mechanism: str, markers: bool) -> rows.Row:
    """Returns the row of a fit of a set with one mechanism, or with none, to a case."""
    key = {"case": name, "set": mechanism, "markers": markers, "model": load_reduced(MODEL).hash[:12]}
    known = TABLE.find(**key)
    if known is not None:
        return known
    context, case = context_of(name, markers), CASES[name]

    def local(names: Sequence[str], runs: Sequence[ModelRun]) -> LogPosterior:
        """Returns the posterior; data of the usual mesh have none of the error that is corrected for."""
        posterior = context.posterior(names, runs)
        if posterior.markers is None or case.refinement > 1:
            return posterior
        nothing_m = np.zeros_like(posterior.markers.correction_m)
        return replace(posterior, markers=replace(posterior.markers, correction_m=nothing_m))

    values = EFFECTS[mechanism][mechanism != case.effect] if mechanism else {}
    start = {**context.noise, **SKINS[case.skin], **values}
    result = fit_set((mechanism,) if mechanism else (), start, context.run, local)
    if isinstance(result, str):
        rows.say(f"{key}: {result}")
        return TABLE.append(**key, log_evidence=float("-inf"), settled=False, force_rms_n=float("nan"),
                            marker_sd_m=float("nan"), values="{}", sds="{}")  # fmt: skip
    fit, posterior = result.fit, result.fit.log_posterior
    low, high = posterior.bounds
    sds = dict(zip(posterior.names, np.sqrt(np.diag(fit.covariance)) * (high - low), strict=True))
    residual_n = posterior.chain.force_n - fit.force_n[posterior.chain.bins]
    rows.say(f"{key}: {fit.log_evidence:.1f}, {result.runs} runs")
    return TABLE.append(
        **key, log_evidence=fit.log_evidence, settled=result.settled,
        force_rms_n=float(np.sqrt(np.mean(residual_n**2))),
        marker_sd_m=float(fit.theta.get("marker_sd", np.nan)),
        values=json.dumps(dict(fit.theta)), sds=json.dumps({k: float(v) for k, v in sds.items()}),
    )  # fmt: skip


def widths() -> list[list[str]]:
    """Returns a table row of each parameter of each skin: its sd in decades without and with markers."""
    table = []
    for name in ("usual", "demo", "stiff", "finer mesh"):
        alone, both = fitted(name, "", False), fitted(name, "", True)
        for parameter in ("E_c", "E_s", "k_c", "k_s"):
            truth, cells = CASES[name].theta[parameter], []
            for row in (alone, both):
                value, sd = json.loads(row["values"])[parameter], json.loads(row["sds"])[parameter]
                cells += [f"{sd / np.log(10):.3f}", f"{np.log(value / truth) / sd:+.1f}"]
            table.append([name, parameter, *cells])
    return table


def margins() -> list[list[str]]:
    """Returns a table row of each effect: the nats by which its set beats none, and the best wrong one."""
    table = []
    for effect in EFFECTS:
        cells = []
        for markers in (False, True):
            nats = {name: float(fitted(effect, name, markers)["log_evidence"]) for name in ("", *EFFECTS)}
            wrong = max((name for name in EFFECTS if name != effect), key=lambda name: nats[name])
            cells += [
                f"{nats[effect] - nats['']:.1f}", f"{nats[effect] - nats[wrong]:.1f}",
                wrong if np.isfinite(nats[wrong]) else "none",
            ]  # fmt: skip
        values = json.loads(fitted(effect, effect, True)["values"])
        concealed_values = EFFECTS[effect][0]
        cells.append(
            ", ".join(f"{k} {values[k]:.3g} ({v:.3g})" for k, v in concealed_values.items() if k in values)
        )
        table.append([effect, *cells])
    return table


def guard() -> list[list[str]]:
    """Returns a table row of the fits without mechanisms to the usual skin, and to a guard that slips."""
    table = []
    for name in ("usual", "guard that slips, 2 %", "guard that slips, 10 %"):
        for markers in (False, True):
            row = fitted(name, "", markers)
            values, sds = json.loads(row["values"]), json.loads(row["sds"])
            off = [f"{np.log(values[p] / SKINS['usual'][p]) / sds[p]:+.1f}" for p in ("E_c", "E_s")]
            noise = f"{1e6 * float(row['marker_sd_m']):.1f}" if markers else "–"
            table.append(
                [name, "yes" if markers else "no", f"{1e3 * float(row['force_rms_n']):.2f}", noise, *off]
            )
    return table


def main() -> None:
    tables = {
        "widths": rows.markdown(
            ["skin", "", "sd without", "off by", "sd with", "off by"], widths()
        ),
        "look-alikes": rows.markdown(
            ["concealed", "over none, without", "over the next, without", "next", "over none, with",
             "over the next, with", "next", "values with markers (true)"], margins(),
        ),
        "guard": rows.markdown(
            ["recording", "markers", "force RMS, mN", "marker noise, µm", "E_c off by", "E_s off by"], guard()
        ),
    }  # fmt: skip
    for name, table in tables.items():
        print(table, end="\n\n")
        rows.into_docs(PAGE, f"markers {name}", table)
    figure = figure_markers_add(TABLE.read(), {name: case.theta for name, case in CASES.items()})
    save_figure(figure, PAGE.parent / "figures" / "markers", "benchmarks/markers.py")


if __name__ == "__main__":
    main()
