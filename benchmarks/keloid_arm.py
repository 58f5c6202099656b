"""Fits the stretched arm with a keloid, and locates on the skin where a model without a keloid is wrong.

The data are third-party: the example `bimaterial` of the repository
aflahelouneg/inverse_identification_soft_tissue. The program needs a folder with its files, and no file of it
belongs in this repository. It writes the recording and the tracks as tables, imports them as a user would,
and fits sets of mechanisms by the shipped reduced model. No step of this is told of a keloid. The outline
that the authors of the data drew is used at the end only, to compare.

    python benchmarks/keloid_arm.py FOLDER        # ten minutes of one core

The program prints tables, writes them between the markers of docs/markers.md, and draws
docs/figures/markers-keloid.png.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rows
from matplotlib.path import Path as Polygon

from bayeskin import storage
from bayeskin.design import default_space
from bayeskin.finite_element.mesh_change import mesh_change
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.on_skin import OnSkin, on_skin
from bayeskin.mismatch.trust_region import SetFit, fit_set
from bayeskin.recordings import (
    analyse,
    bin_recording,
    covered_s,
    idealised_motion,
    segment,
    uniform_edges,
)
from bayeskin.report import figure_on_skin, save_figure
from bayeskin.shipped import shipped
from bayeskin.types import Array, Markers, Recording
from bayeskin.workflow.diagnosis_tasks import ContextSource, open_context
from bayeskin.workflow.importing import import_recording, markers_beside

RATE_HZ = 10.0  # assumed by other readers of these data, which have no clock
GAUGE_MM = 36.0  # of the article's device, whose pads are as wide
EDGE_PX = 7.0  # half the distance of two columns of the grid
PAD_HALF_WIDTH_MM = 4.0
EVERY_POINT, EVERY_IMAGE = 2, 4  # of the grid along x and along y, and of the images, for the fits
LOST_MM = 0.5  # a point that moves so far from the others in one image is lost from then on
OUTLINE_PX_A_MM, OUTLINE_CENTRE_MM = 165.0 / 8.0, np.array([50.0, 20.0])  # of the authors' geometry
SHIFTS_MM = tuple(float(shift) for shift in range(-7, 8))
MODEL = shipped("surrogates/article-device-reduced.h5")
PAGE = Path(__file__).parents[1] / "docs" / "markers.md"
START = {"E_c": 100e3, "E_s": 10e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 0.0}
SETS: dict[tuple[str, ...], dict[str, float]] = {
    (): {},
    ("strain-stiffening",): {"fibre_stress": 1e4, "k2": 15.0, "dispersion": 0.1},
    ("fibre-anisotropy", "strain-stiffening"): {
        "fibre_stress": 1e4, "k2": 15.0, "dispersion": 0.1, "langer_ratio": 1.5, "langer_angle": 0.8,
    },
}  # fmt: skip


def tracks(folder: Path) -> Array:
    """Returns the positions (t, p, 2) [px] of the first grid in all images, the first one included."""
    x0, y0, xt, yt = (np.loadtxt(folder / f"dic_1_{name}.dat.gz") for name in ("x0", "y0", "xt", "yt"))
    return np.stack([np.column_stack([x0, xt]), np.column_stack([y0, yt])], axis=-1).transpose(1, 0, 2)


def in_mm(position_px: Array) -> tuple[Array, float]:
    """Returns positions (t, p, 2) [mm] from midway between the pads, and pixels for a millimetre.

    The first and the last column of the grid lie at the pads' inner edges.
    """
    first = position_px[0]
    per_mm = float(np.ptp(first[:, 0])) / GAUGE_MM
    middle_px = 0.5 * (first[:, 1].min() + first[:, 1].max())
    beside_pad = np.abs(first[:, 1] - middle_px) < PAD_HALF_WIDTH_MM * per_mm
    left = beside_pad & (first[:, 0] < first[:, 0].min() + EDGE_PX)
    right = beside_pad & (first[:, 0] > first[:, 0].max() - EDGE_PX)
    pads = 0.5 * (position_px[:, left].mean(axis=1) + position_px[:, right].mean(axis=1))
    return (position_px - pads[:, None]) / per_mm, per_mm


def write_tables(folder: Path, out: Path) -> tuple[Path, Path, Path, float]:
    """Writes the recording, a thin table of tracks and the whole one; returns their files and pixels a mm."""
    opening_mm, force_n = (np.loadtxt(folder / f"{name}_moving_pad.dat") for name in ("u", "f"))
    closed = int(np.argmin(opening_mm))  # the first samples drift towards zero before the pads open
    opening_mm, force_n = opening_mm[closed:], force_n[closed:]
    time_s = np.arange(len(force_n)) / RATE_HZ
    recording = out / "arm.csv"
    np.savetxt(recording, np.column_stack([time_s, opening_mm, force_n]), "%.6f", ",", comments="",
               header="time (s),displacement (mm),force (N)")  # fmt: skip
    position_mm, per_mm = in_mm(tracks(folder))
    images_s = np.linspace(0.0, time_s[-1], len(position_mm))
    columns = len(np.unique(np.round(position_mm[0, :, 0], 3)))
    number = np.arange(position_mm.shape[1])
    across = position_mm.shape[1] // columns
    thin = ((number % across) % EVERY_POINT == 0) & ((number // across) % EVERY_POINT == 0)
    files = []
    for name, chosen, every in (("thin", thin, EVERY_IMAGE), ("whole", np.ones_like(thin), EVERY_IMAGE)):
        files.append(out / f"{name}.csv")
        _write_tracks(files[-1], images_s[::every], position_mm[::every], np.flatnonzero(chosen))
    return recording, files[0], files[1], per_mm


def _write_tracks(file: Path, time_s: Array, position_mm: Array, points: np.ndarray) -> None:
    """Writes the tracks of some points; a track ends where it is lost."""
    moved = position_mm - position_mm[0]
    step = np.linalg.norm(np.diff(moved - np.median(moved, axis=1, keepdims=True), axis=0), axis=2)
    lost = np.concatenate([np.zeros((1, step.shape[1]), bool), np.cumsum(step > LOST_MM, axis=0) > 0])
    with open(file, "w") as out:
        out.write("time,point,x,y\n")
        for image, at_s in enumerate(time_s):
            for point in points:
                if not lost[image, point]:
                    x, y = position_mm[image, point]
                    out.write(f"{at_s:.4f},{point},{x:.5f},{y:.5f}\n")


def opened(recording: Path, table: Path, folder: Path) -> DiagnosisContext:
    """Imports a recording with its tracks, and returns the context of its diagnosis."""
    folder.mkdir()
    out = folder / "arm.h5"
    import_recording(rows.Log(), recording, out, zero=True, markers=table)
    samples = storage.load(out, Recording)
    phases = segment(samples)
    motion = idealised_motion(samples, phases)
    edges_s = uniform_edges(covered_s(samples, motion), 0.5)
    storage.save(folder / "recording.h5", samples)
    storage.save(folder / "motion.h5", motion)
    storage.save(folder / "binned.h5", bin_recording(samples, phases, edges_s, analyse(samples, phases)))
    markers = storage.load(markers_beside(out), Markers)
    markers = replace(markers, mesh_change_m=mesh_change(ModelSpec(), motion, markers))
    storage.save(folder / "markers.h5", markers)
    return open_context(ContextSource(folder, MODEL, ModelSpec(), 1, default_space()))


def fits(context: DiagnosisContext) -> dict[tuple[str, ...], SetFit]:
    """Returns the fits of all sets that finish."""
    done: dict[tuple[str, ...], SetFit] = {}
    start = {**context.noise, **START}
    for names, values in SETS.items():
        result = fit_set(names, {**start, **values}, context.run, context.posterior)
        if isinstance(result, str):
            rows.say(f"{names}: {result}")
            continue
        done[names] = result
        rows.say(f"{names}: {result.fit.log_evidence:.1f}, {dict(result.fit.theta)}")
    return done


def at_all_points(context: DiagnosisContext, fitted: Fit) -> OnSkin | None:
    """Returns the residuals of a fit to some points at all points of a context."""
    run = context.run(fitted.names, fitted.theta)
    if isinstance(run, str):
        raise SystemExit(run)
    return on_skin(context.posterior(fitted.names, [run]), fitted.theta, context.motion)


def outline_mm(file: Path, per_mm: float) -> Array:
    """Returns the outline (k, 2) [mm] that the authors drew, from midway between the pads."""
    found = re.findall(r"^Point\((\d+)\) = \{([-\d.]+), ([-\d.]+), 0, he_keloid\}", file.read_text(), re.M)
    points = np.array([[float(x), float(y)] for _, x, y in found]) - OUTLINE_CENTRE_MM
    return np.concatenate([points, points[:1]]) * OUTLINE_PX_A_MM / per_mm


def quantities(located: OnSkin) -> dict[str, Array]:
    """Returns the quantities (p,) that are compared inside and outside of the outline."""
    outward = np.sign(located.place_m[:, 0]) * located.vector_m[:, 0]
    return {
        "length of the residual [mm]": 1e3 * np.linalg.norm(located.vector_m, axis=1),
        "residual away from the middle [mm]": 1e3 * outward,
        "strain along the pull [%]": 100.0 * located.strain[:, 0],
        "strain across the pull [%]": 100.0 * located.strain[:, 1],
    }


def comparison(located: OnSkin, outline: Array) -> list[list[str]]:
    """Returns table rows that compare residuals inside and outside of an outline.

    The last cell is the shift of the outline across the pull [mm] at which inside and outside differ most, in
    the same direction.
    """
    place_mm, table = 1e3 * located.place_m, []
    for name, values in quantities(located).items():
        cells, by_shift = [name], {}
        for shift in SHIFTS_MM:
            inside = Polygon(outline + np.array([0.0, shift])).contains_points(place_mm)
            by_shift[shift] = ranked_above(values[inside], values[~inside])
        inside = Polygon(outline).contains_points(place_mm)
        cells += [f"{np.mean(values[inside]):.2f}", f"{np.mean(values[~inside]):.2f}", f"{by_shift[0.0]:.2f}"]
        for half in (place_mm[:, 0] < 0.0, place_mm[:, 0] >= 0.0):
            cells.append(f"{ranked_above(values[inside & half], values[~inside & half]):.2f}")
        sign = 1.0 if by_shift[0.0] >= 0.5 else -1.0
        best = max(by_shift, key=lambda shift: sign * by_shift[shift])
        table.append([*cells, f"{best:+.0f} mm: {by_shift[best]:.2f}"])
    return table


def ranked_above(first: Array, second: Array) -> float:
    """Returns the probability that a value of the first array exceeds one of the second."""
    return float(np.mean(np.searchsorted(np.sort(second), first) / len(second)))


def _row(names: tuple[str, ...], fit: Fit, located: OnSkin) -> list[str]:
    """Returns the table row of a set's fit."""
    chain = fit.log_posterior.chain
    rms_n = float(np.sqrt(np.mean((chain.force_n - fit.force_n[chain.bins]) ** 2)))
    return [
        ", ".join(names) or "none", f"{fit.log_evidence:.0f}", f"{1e3 * rms_n:.1f}",
        f"{1e6 * fit.theta['marker_sd']:.0f}", f"{1e3 * located.rms_m:.3f}",
        f"{int(located.significant.sum())} of {len(located.significant)}",
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args(arguments).folder
    with tempfile.TemporaryDirectory() as made:
        recording, thin, whole, per_mm = write_tables(folder, Path(made))
        context = opened(recording, thin, Path(made) / "thin")
        done = fits(context)
        all_points = opened(recording, whole, Path(made) / "whole")
        best = max(done, key=lambda names: done[names].fit.log_evidence)
        located = {names: at_all_points(all_points, done[names].fit) for names in done}
    outline, best_located = outline_mm(folder / "keloid_skin.geo", per_mm), located[best]
    assert best_located is not None
    table = [_row(names, done[names].fit, place) for names, place in located.items() if place is not None]
    fitted = rows.markdown(
        ["mechanisms", "log evidence", "force RMS [mN]", "marker noise [µm]", "residual [mm]", "points"],
        table,
    )
    compared = rows.markdown(
        [
            "recorded minus fitted",
            "inside",
            "outside",
            "P",
            "P left",
            "P right",
            "largest contrast at a shift of",
        ],
        comparison(best_located, outline),
    )
    print(fitted, compared, f"{per_mm:.2f} px/mm", sep="\n\n")
    rows.into_docs(PAGE, "keloid fits", fitted)
    rows.into_docs(PAGE, "keloid outline", compared)
    figure = figure_on_skin(best_located, context.forward.spec.geometry, [1e-3 * outline])
    _, svg = save_figure(figure, PAGE.parent / "figures" / "markers-keloid", "benchmarks/keloid_arm.py")
    svg.unlink()  # it holds every point, and the points are not this project's data


if __name__ == "__main__":
    main()
