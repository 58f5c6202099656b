"""A configuration is either complete and in range, or refused in one line that names the key."""

import os
import re
from pathlib import Path

import pytest

from bayeskin.config import load_config, parameter_space
from bayeskin.design import default_space
from bayeskin.errors import InputError

SMALLEST = '[recording]\nfile = "a.h5"\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "case.toml"
    path.write_text(text)
    return path


def test_a_recording_is_all_that_a_configuration_must_name(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, SMALLEST))
    assert config.name == "case"
    assert config.model.observation == "reaction"
    assert parameter_space(config) == default_space()


def test_a_prior_is_changed_only_where_the_configuration_says_so(tmp_path: Path) -> None:
    space = parameter_space(load_config(written(tmp_path, SMALLEST + "[parameters.E_c]\nupper = 4000000\n")))
    assert space.parameters[0].upper == 4e6
    assert space.parameters[0].lower == default_space().parameters[0].lower
    assert space.parameters[1:] == default_space().parameters[1:]


def test_the_hash_follows_the_content_and_ignores_the_workers(tmp_path: Path) -> None:
    first = load_config(written(tmp_path, SMALLEST))
    workers = load_config(written(tmp_path, SMALLEST + "[design]\nworkers = 7\n"))
    seed = load_config(written(tmp_path, "seed = 2\n" + SMALLEST))
    order = load_config(written(tmp_path, '[fit]\nbin_width_s = 0.5\n[recording]\nfile = "a.h5"\n'))
    assert first.sha256 == workers.sha256 == order.sha256 != seed.sha256


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("", "recording", "there is no recording"),
        ("colour = 1\n" + SMALLEST, "colour", "not known; use one of name, recording, recordings"),
        (SMALLEST + "[fit]\nbin_width = 1\n", "fit.bin_width", "use one of windows_s, bin_width_s"),
        (
            SMALLEST + "[parameters.E_c]\nlow = 1\n",
            "parameters.E_c.low",
            "one of lower, upper, prior, mean, sd, median, factor, correlations, source, unit",
        ),
        (SMALLEST + "[parameters.E_x]\nlower = 1\n", "parameters.E_x", "one of E_c, E_s, k_c, k_s, p_init"),
        (SMALLEST + "[parameters.E_c]\nlower = 2e6\nupper = 1e4\n", "parameters.E_c", "the lower bound"),
        (SMALLEST + "[parameters.k_c]\nlower = 0.0\n", "parameters.k_c.lower", "above zero"),
        (SMALLEST + "[parameters.k_c]\nupper = inf\n", "parameters.k_c.upper", "finite"),
        (
            SMALLEST + "[model]\nrefinement = -1\n",
            "model.refinement",
            "-1 is not allowed; it must be greater than or equal to 0",
        ),
        (
            SMALLEST + "[fit]\nbin_width_s = 0.0\n",
            "fit.bin_width_s",
            "0.0 is not allowed; it must be greater than 0",
        ),
        (SMALLEST + "[fit]\nwindows_s = [[75.0, 18.8]]\n", "fit.windows_s", "does not start before it ends"),
        (SMALLEST + "[fit]\nwindows_s = [[75.0]]\n", "fit.windows_s.0.1", "this entry is missing"),
        (SMALLEST + "[noise]\nnu = [1, 2, 3]\n", "noise.nu", "at most 2"),
        ("fit = 3\n" + SMALLEST, "fit", "3 is not allowed; it must be a table"),
        (
            SMALLEST + "[noise]\nsd_n = [0.3, 1e-4]\n",
            "noise.sd_n",
            "[0.3, 0.0001]; the lower bound must be below",
        ),
        (SMALLEST + "[design]\npoints = []\n", "design.points", "at least 1"),
        (
            SMALLEST + '[design]\npoints = ["many"]\n',
            "design.points.0",
            '"many" is not allowed; it must be a valid integer',
        ),
        (
            SMALLEST + '[model]\nobservation = "force"\n',
            "model.observation",
            "'reaction', 'article' or 'own'",
        ),
        (SMALLEST + '[model]\nobservation = "article"\n', "model.mesh", "it is 'bricks'"),
        (
            SMALLEST + '[parameters.E_c]\nunit = "kPa"\n',
            "parameters.E_c.unit",
            "'kPa' is not the unit of this parameter; it must be 'Pa'",
        ),
        (SMALLEST + '[model]\nforward = "a.py:f"\nobservation = "article"\n', "model.observation", "'own'"),
        ("seed = true\n" + SMALLEST, "seed", "integer"),
        ('name = "../up"\n' + SMALLEST, "name", "pattern"),
        ("recording = 3\n", "recording", "3 is not allowed"),
        (SMALLEST + "[parameters]\nE_c = 3\n", "parameters.E_c", "3 is not allowed"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path: Path, text: str, key: str, says: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_config(path)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{path}: {key}: ")
    assert says in line
    assert re.search(r": .+; .+", line)


def test_what_is_not_toml_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 2"):
        load_config(written(tmp_path, "a = 1\nb = = 2\n"))
    with pytest.raises(InputError, match="no such file"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="needs a TOML configuration"):
        load_config(tmp_path / "binary.toml")
    with pytest.raises(InputError):
        load_config(tmp_path)


FILE = "recording.file = 'a'\n"
DEEP, MANY_DIGITS = "[" * 20_000, "9" * 5_000


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"a = {DEEP}", "nested too deeply"),
        (".".join("a" * 3_000) + " = 1", "nested too deeply"),
        (f"seed = {MANY_DIGITS}", "digits"),
        (f"seed = 0x{'f' * 5_000}", "digits"),
        (
            FILE + "seed = 9223372036854775808",
            "seed: 9223372036854775808 is not allowed; it must be less than",
        ),
        (
            FILE + "[design]\npoints = [10000000000]",
            "points.0: 10000000000 is not allowed; it must be less",
        ),
        (FILE + "[model]\nrefinement = 40", "model.refinement: 40 is not allowed; it must be less than"),
        (FILE + "[sobol]\nsamples = 1000000000", "sobol.samples: 1000000000"),
        ("#" * 1_000_001, "1000001 bytes; bayeskin needs a TOML"),
        ("time,force\n0,1\n", r"line 1.*; bayeskin needs a TOML configuration, as `bayeskin new RECORDING`"),
    ],
    ids=lambda value: value[-12:],
)
def test_what_would_take_all_memory_or_the_stack_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        load_config(written(tmp_path, text))
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


def test_the_mark_that_notepad_puts_before_a_text_is_no_part_of_it(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbf[recording]\r\nfile = 'a.csv'\r\n")
    assert load_config(path).recording.file == "a.csv"


def test_a_recording_is_told_from_a_configuration(tmp_path: Path) -> None:
    (tmp_path / "good.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"not text in UTF-8; .*`bayeskin new RECORDING`"):
        load_config(tmp_path / "good.h5")


def test_what_is_no_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for path, message in (
        (tmp_path, "it is a folder"),
        (tmp_path / "pipe.toml", "it is a pipe or a device instead of a file"),
        (Path(os.devnull), "it is a pipe or a device instead of a file"),
    ):
        with pytest.raises(InputError, match=f": {message}; bayeskin needs a TOML"):
            load_config(path)
