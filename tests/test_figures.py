"""Every figure: both formats with their provenance, the same bytes twice, no settings of the caller."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.figure import Figure
from matplotlib.image import imread
from toys.closed_form_model import SPACE
from toys.figure_inputs import BINNED, DRAWS, surface

from bayeskin import report

pytestmark = pytest.mark.filterwarnings("error")


def one_panel() -> Figure:
    return report.figure_posterior(SPACE, DRAWS[:300], {}, names=("E_s",))


def test_both_formats_are_written_with_their_provenance(tmp_path: Path) -> None:
    figure = one_panel()
    png, svg = report.save_figure(figure, tmp_path / "deep" / "prior.v2", "bayeskin 0.1 seed 7")
    assert (png.name, svg.name) == ("prior.v2.png", "prior.v2.svg")
    assert imread(png).shape[1] == 700  # 3.5 in at 200 dpi
    assert b"bayeskin 0.1 seed 7" in png.read_bytes()
    assert "bayeskin 0.1 seed 7" in svg.read_text()
    assert "dc:date" not in svg.read_text()
    assert sorted(p.name for p in png.parent.iterdir()) == ["prior.v2.png", "prior.v2.svg"]


@pytest.mark.parametrize("kind", ["prior", "posterior", "fields"])
def test_the_same_input_gives_the_same_bytes(tmp_path: Path, kind: str) -> None:
    def figure() -> Figure:
        if kind == "prior":
            return report.figure_prior_predictive(BINNED, np.tile(BINNED.force_n, (4, 1)))
        if kind == "posterior":
            return report.figure_posterior(SPACE, DRAWS[:300], {}, names=("E_c", "E_s"))
        points, quads = surface()
        field = report.SurfaceField("u", "mm", points[:1, quads[:, 0], 0])
        return report.figure_fields(["5 s"], points[:1], quads, 0 * quads[:, 0], [], [field], "")

    drawn = figure()
    written = [report.save_figure(f, tmp_path / str(i), "x") for i, f in enumerate((drawn, figure(), drawn))]
    assert len({tuple(path.read_bytes() for path in paths) for paths in written}) == 1


def test_a_failed_rendering_leaves_the_earlier_files(tmp_path: Path) -> None:
    good = one_panel()
    before = [p.read_bytes() for p in report.save_figure(good, tmp_path / "a", "x")]
    bad = Figure()
    bad.text(0.5, 0.5, r"$\unknowncommand$")
    with pytest.raises(ValueError, match="unknowncommand"):
        report.save_figure(bad, tmp_path / "a", "x")
    assert [(tmp_path / f"a.{form}").read_bytes() for form in ("png", "svg")] == before
    assert len(list(tmp_path.iterdir())) == 2


def test_the_callers_settings_neither_matter_nor_change(tmp_path: Path) -> None:
    def svg(name: str) -> bytes:
        return report.save_figure(one_panel(), tmp_path / name, "x")[1].read_bytes()

    plain = svg("plain")
    before = dict(rcParams)
    try:
        rcParams.update({"font.size": 23.0, "axes.grid": True, "text.usetex": True})
        altered = svg("altered")
        assert rcParams["font.size"] == 23.0
    finally:
        rcParams.update({key: before[key] for key in ("font.size", "axes.grid", "text.usetex")})
    assert altered == plain
