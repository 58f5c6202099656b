"""Figures of fields on the skin's surface."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.quiver import Quiver
from toys.figure_inputs import drawn, headline, surface

from bayeskin import report
from bayeskin.errors import InputError

pytestmark = pytest.mark.filterwarnings("error")


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
    figure = drawn(report.figure_fields(ROWS, points, quads, part, [], columns, "Nothing"))
    ranges = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert [text for text in ranges if text.startswith("0 to 0")] == ["0 to 0 kPa", "0 to 0 m/s"] * 2
    assert not [c for ax in figure.axes for c in ax.collections if isinstance(c, Quiver)]
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
