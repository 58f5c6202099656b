"""Tests of the inputs of a diagnosis, which starts from a recording alone or from a configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys.small_reduced import hollow

from bayeskin import storage
from bayeskin.config import parameter_space
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.shipped import shipped
from bayeskin.types import Recording
from bayeskin.workflow.diagnosis import STAGE, opened, source_of, stage_of
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.experiment import choose


def recording(path: Path) -> Path:
    """Two ramps and holds, which no shipped surrogate knows."""
    time_s = np.arange(0.0, 60.0, 0.1)
    u_m = np.interp(time_s, [0.0, 5.0, 9.0, 30.0, 34.0, 60.0], [0.0, 0.0, 3e-3, 3e-3, 6e-3, 6e-3])
    noise_n = 1e-3 * np.random.default_rng(1).standard_normal(len(time_s))
    storage.save(path / "a test.h5", Recording(time_s, u_m, 30.0 * u_m + noise_n, "own", "0" * 64))
    return path / "a test.h5"


def test_a_recording_by_itself_takes_the_article_s_reduced_model(tmp_path: Path) -> None:
    run = opened([recording(tmp_path)], Silent())
    assert stage_of(run.config) is STAGE
    assert run.config.geometry(run.config_path).geometry == Geometry()
    assert run.folder == tmp_path / "a test-diagnosis"
    assert list(STAGE.files(run)) == [shipped("surrogates/article-device-reduced.h5")]


def test_a_recording_of_a_stated_device_takes_that_device_s_reduced_model(tmp_path: Path) -> None:
    thin = Geometry(cutis_m=1.5e-3)
    (tmp_path / "device.toml").write_text("[tissue]\ncutis_mm = 1.5\n")
    run = opened([recording(tmp_path)], Silent(), tmp_path / "device.toml")
    assert run.config.geometry(run.config_path).geometry == thin
    own = hollow(tmp_path / "device-reduced.h5", thin)
    assert list(STAGE.files(run)) == [own]


def test_an_uncertain_length_is_a_parameter(tmp_path: Path) -> None:
    recording(tmp_path)
    tissue = "[tissue]\ncutis_mm = { mean = 2.0, sd = 0.2 }\n"
    (tmp_path / "device.toml").write_text(tissue)
    run = opened([tmp_path / "a test.h5"], Silent(), tmp_path / "device.toml")
    assert "cutis_m" in parameter_space(run.config).names
    case = tmp_path / "case.toml"
    case.write_text(f'[recording]\nfile = "a test.h5"\n{tissue}')
    assert opened([case], Silent()).config.geometry(case).sd_m == {"cutis_m": 0.2e-3}


@pytest.mark.parametrize("model", ['observation = "article"\nmesh = "own.msh"', 'mesh = "own.msh"'])
def test_a_model_that_no_reduced_one_stands_for_needs_a_surrogate(tmp_path: Path, model: str) -> None:
    recording(tmp_path)
    (tmp_path / "own.msh").write_text("")
    case = tmp_path / "case.toml"
    case.write_text(f'[recording]\nfile = "a test.h5"\n[model]\n{model}\n')
    run = opened([case], Silent())
    assert stage_of(run.config).needs == ("recording", "design", "train")
    assert list(stage_of(run.config).files(run)) == []
    with pytest.raises(InputError, match=r"on 'own\.msh'; .*'reaction' on 'bricks'"):
        choose([case], Silent())


def test_a_device_stands_beside_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--device: device\.toml cannot be given with a configuration"):
        opened([tmp_path / "case.toml"], Silent(), Path("device.toml"))


def two(path: Path) -> tuple[Path, Path]:
    """Two recordings of one skin in a folder."""
    first = recording(path)
    second = first.with_name("second.h5")
    second.write_bytes(first.read_bytes())
    return first, second


def test_several_recordings_have_their_own_initial_pressures(tmp_path: Path) -> None:
    run = opened(two(tmp_path), Silent())
    assert run.folder == tmp_path / "a test-second-diagnosis"
    assert [recording.file for recording in run.config.each_recording] == ["a test.h5", "second.h5"]
    assert parameter_space(run.config).names[-2:] == ("p_init", "p_init@2")
    case = tmp_path / "case.toml"
    case.write_text(
        '[[recordings]]\nfile = "a test.h5"\n[[recordings]]\nfile = "second.h5"\n[fit]\nshared = ["p_init"]\n'
    )
    assert parameter_space(opened([case], Silent()).config).names[-1] == "p_init"
    assert source_of(opened([case], Silent())).shared == ("p_init",)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", r"recording: there is no recording; write \[recording\], or two or more \[\[recordings\]\]"),
        (
            '[recording]\nfile="b.h5"\n[[recordings]]\nfile="c.h5"\n',
            r"recordings: \[recording\] is there too",
        ),
        ('[[recordings]]\nfile = "b.h5"\n', "recordings: there is a single recording"),
        (
            '[[recordings]]\nfile="b.h5"\n[[recordings]]\nfile="x/b.csv"\n',
            "recordings: 'b' is the name of two files",
        ),
        (
            '[[recordings]]\nfile="b.h5"\n[[recordings]]\nfile="c.h5"\n[fit]\nwindows_s=[[0, 9]]\n',
            "fit.windows_s: a configuration of several recordings cannot have windows",
        ),
    ],
)
def test_a_wrong_list_of_recordings_is_one_line(tmp_path: Path, text: str, line: str) -> None:
    (tmp_path / "case.toml").write_text(text)
    with pytest.raises(InputError, match=line):
        opened([tmp_path / "case.toml"], Silent())


def test_markers_beside_one_of_several_recordings_are_not_used_and_one_line_says_so(tmp_path: Path) -> None:
    class Heard(Silent):
        def log(self, message: str) -> None:
            heard.append(message)

    heard: list[str] = []
    (tmp_path / "second-markers.h5").touch()
    run = opened(two(tmp_path), Heard())
    said = "A joint diagnosis infers from the force alone, so it does not use the markers of second."
    assert heard == [said]
    assert [section.markers for section in run.config.each_recording] == [None, None]
    assert opened([tmp_path / "second.h5"], Heard()).config.each_recording[0].markers == "second-markers.h5"
    assert heard == [said]


def test_what_recordings_may_share_is_listed(tmp_path: Path) -> None:
    two(tmp_path)
    case = tmp_path / "case.toml"
    case.write_text(
        '[[recordings]]\nfile = "a test.h5"\n[[recordings]]\nfile = "second.h5"\n[fit]\nshared = ["skin"]\n'
    )
    with pytest.raises(
        InputError, match=r"fit.shared: skin cannot be shared; use some of p_init, noise, .*backlash"
    ):
        source_of(opened([case], Silent()))


def test_a_configuration_stands_beside_no_other_file(tmp_path: Path) -> None:
    first, _ = two(tmp_path)
    with pytest.raises(InputError, match="a configuration cannot be given with other files"):
        opened([tmp_path / "case.toml", first], Silent())
