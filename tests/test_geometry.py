"""Lengths of a test: the article's by default, others refused where they cannot be, and what follows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayeskin.config import load_config
from bayeskin.config.device import load_device
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry, Guard

DEVICE = """
[device]
gauge_mm = 20
pad_mm = [10, 20.5]
guard_mm = false
[tissue]
cutis_mm = { mean = 1.8, sd = 0.2 }
arm_radius_mm = "flat"
"""


def test_the_default_is_the_article_s_device_in_its_box():
    geometry = Geometry()
    assert geometry.along_m == (18e-3, 26e-3, 27e-3, 35e-3)
    assert geometry.across_m == (4e-3, 5e-3, 12e-3)
    assert geometry.box_m == (105e-3, 84e-3, 10e-3)
    assert geometry.measured_width_m == 8e-3


def test_the_box_is_as_many_times_the_device_as_the_article_s():
    twice = Geometry(
        gauge_m=72e-3, pad_length_m=16e-3, pad_width_m=16e-3, guard=Guard(2e-3, 16e-3), arm_radius_m=96e-3
    )
    np.testing.assert_allclose(twice.box_m[:2], (210e-3, 168e-3))
    assert Geometry(gauge_m=4e-3, subcutis_m=98e-3, arm_radius_m=None).box_m[0] == pytest.approx(0.3)


def test_no_two_geometries_share_a_hash():
    changes = [
        {}, {"gauge_m": 37e-3}, {"pad_length_m": 9e-3}, {"pad_width_m": 9e-3}, {"guard": None},
        {"guard": Guard(2e-3)}, {"guard": Guard(1e-3, 9e-3)}, {"force_on": "pad and guard"},
        {"cutis_m": 1.9e-3}, {"subcutis_m": 8.1e-3}, {"arm_radius_m": None}, {"arm_radius_m": 50e-3},
    ]  # fmt: skip
    assert len({Geometry(**change).hash for change in changes}) == len(changes)
    assert Geometry().hash == Geometry(cutis_m=2e-3).hash


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"gauge_m": 0.0}, "gauge_m: it is 0 mm, so the pads overlap"),
        ({"gauge_m": -1e-3}, "the pads overlap"),
        ({"gauge_m": 36.0}, "gauge_m: it is 36000 mm, probably 1000 times too large"),
        ({"cutis_m": 2e-6}, "cutis_m: it is 0.002 mm, probably 1000 times too small"),
        ({"subcutis_m": 0.0}, "subcutis_m: it is 0 mm; it must be above zero, 0.5 to 100 mm"),
        ({"cutis_m": float("nan")}, "cutis_m: it is nan mm"),
        ({"guard": Guard(gap_m=-1e-3)}, "guard.gap_m: it is -1 mm, so the guard lies inside the pad"),
        ({"guard": Guard(gap_m=9e-3)}, "guard.width_m: it is 8 mm with a gap of 9 mm"),
        ({"arm_radius_m": 25e-3}, "arm_radius_m: it is 25 mm; it must be at least 26.738 mm"),
        ({"force_on": "guard"}, "force_on: 'guard'"),
        ({"force_on": "pad and guard", "guard": None}, "force_on: 'pad and guard' needs a guard"),
    ],
)
def test_lengths_that_cannot_be_are_refused_in_one_line(change, says):
    with pytest.raises(InputError) as caught:
        Geometry(**change)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_states_device_and_tissue_in_millimetres(tmp_path: Path):
    path = tmp_path / "device.toml"
    path.write_text(DEVICE)
    stated = load_device(path)
    assert stated.geometry == Geometry(
        gauge_m=20e-3, pad_length_m=10e-3, pad_width_m=20.5e-3, guard=None, cutis_m=1.8e-3, arm_radius_m=None
    )
    assert stated.sd_m == {"cutis_m": 0.2e-3}
    path.write_text("")
    assert load_device(path).geometry == Geometry()


def test_a_configuration_has_the_same_sections(tmp_path: Path):
    path = tmp_path / "case.toml"
    path.write_text('[recording]\nfile = "a.h5"\n' + DEVICE)
    config = load_config(path)
    (tmp_path / "device.toml").write_text(DEVICE)
    assert config.geometry() == load_device(tmp_path / "device.toml")
    path.write_text('[recording]\nfile = "a.h5"\n')
    plain = load_config(path)
    path.write_text('[recording]\nfile = "a.h5"\n[device]\nforce_on = "pad and guard"\n')
    assert plain.sha256 != load_config(path).sha256


@pytest.mark.parametrize(
    ("line", "changed"),
    [
        ("[device]\ngauge_mm = 40", {"gauge_m": 40e-3}),
        ("[device]\npad_mm = [9, 8]", {"pad_length_m": 9e-3}),
        ("[device]\npad_mm = [8, 9]", {"pad_width_m": 9e-3}),
        ("[device]\nguard_mm = { gap = 2, width = 8 }", {"guard": Guard(gap_m=2e-3)}),
        ("[device]\nguard_mm = { gap = 1, width = 6 }", {"guard": Guard(width_m=6e-3)}),
        ("[device]\nguard_mm = false", {"guard": None}),
        ('[device]\nforce_on = "pad and guard"', {"force_on": "pad and guard"}),
        ("[tissue]\ncutis_mm = 1.5", {"cutis_m": 1.5e-3}),
        ("[tissue]\nsubcutis_mm = 9", {"subcutis_m": 9e-3}),
        ("[tissue]\narm_radius_mm = 60", {"arm_radius_m": 60e-3}),
    ],
)
def test_each_key_is_one_length(line: str, changed: dict[str, object], tmp_path: Path):
    path = tmp_path / "device.toml"
    path.write_text(line)
    assert load_device(path).geometry == Geometry(**changed)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (
            "[device]\nguage_mm = 36",
            "device.guage_mm: this key is not known; use one of gauge_mm, pad_mm",
        ),
        ("[devise]", "devise: this key is not known; use one of device, tissue"),
        ("[device]\ngauge_mm = 0.036", "device.gauge_mm: it is 0.036 mm, probably 1000 times too small"),
        ("[device]\npad_mm = [8]", "device.pad_mm.1: this entry is missing"),
        ("[device]\npad_mm = [8, 0]", "device.pad_mm: it is 0 mm"),
        ("[device]\nguard_mm = true", "device.guard_mm: true is not allowed; it must be false"),
        ("[device]\nguard_mm = { gap = 1 }", "device.guard_mm.width: there is no value"),
        ("[device]\nguard_mm = { gap = 1, width = 8, side = 7 }", "use one of gap, width"),
        ('[tissue]\ncutis_mm = "thin"', 'tissue.cutis_mm: "thin" is not allowed; it must be a valid number'),
        ("[tissue]\ncutis_mm = { mean = 2 }", "tissue.cutis_mm.sd: there is no value"),
        ("[tissue]\ncutis_mm = { mean = 2, sd = 1.0 }", "an sd of 1 mm is too large for a mean of 2 mm"),
        (
            '[tissue]\narm_radius_mm = "round"',
            "tissue.arm_radius_mm: \"round\" is not allowed; it must be 'flat'",
        ),
        ("[tissue", "device.toml"),
    ],
)
def test_a_file_that_is_wrong_is_one_line(line: str, says: str, tmp_path: Path):
    path = tmp_path / "device.toml"
    path.write_text(line)
    with pytest.raises(InputError) as caught:
        load_device(path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
