"""A configuration is either complete and in range, or refused in one line that names the key."""

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
        ("", "recording", "found nothing"),
        ("colour = 1\n" + SMALLEST, "colour", "unknown key; expected one of name, recording, seed"),
        (SMALLEST + "[fit]\nbin_width = 1\n", "fit.bin_width", "expected one of windows_s, bin_width_s"),
        (
            SMALLEST + "[parameters.E_c]\nlow = 1\n",
            "parameters.E_c.low",
            "one of lower, upper, prior, mean, sd, median, factor, correlations, source, unit",
        ),
        (SMALLEST + "[parameters.E_x]\nlower = 1\n", "parameters.E_x", "one of E_c, E_s, k_c, k_s, p_init"),
        (SMALLEST + "[parameters.E_c]\nlower = 2e6\nupper = 1e4\n", "parameters.E_c", "lower below upper"),
        (SMALLEST + "[parameters.k_c]\nlower = 0.0\n", "parameters.k_c.lower", "above zero"),
        (SMALLEST + "[parameters.k_c]\nupper = inf\n", "parameters.k_c.upper", "finite"),
        (
            SMALLEST + "[model]\nrefinement = -1\n",
            "model.refinement",
            "found -1; expected greater than or equal to 0",
        ),
        (SMALLEST + "[fit]\nbin_width_s = 0.0\n", "fit.bin_width_s", "found 0.0; expected greater than 0"),
        (SMALLEST + "[fit]\nwindows_s = [[75.0, 18.8]]\n", "fit.windows_s", "start below end"),
        (SMALLEST + "[fit]\nwindows_s = [[75.0]]\n", "fit.windows_s.0.1", "found nothing"),
        (
            SMALLEST + "[noise]\nsd_n = [0.3, 1e-4]\n",
            "noise.sd_n",
            "found [0.3, 0.0001]; expected lower below",
        ),
        (SMALLEST + "[design]\npoints = []\n", "design.points", "at least 1 item"),
        (
            SMALLEST + '[design]\npoints = ["many"]\n',
            "design.points.0",
            'found "many"; expected a valid integer',
        ),
        (
            SMALLEST + '[model]\nobservation = "force"\n',
            "model.observation",
            "'reaction', 'article' or 'own'",
        ),
        (SMALLEST + '[model]\nobservation = "article"\n', "model.mesh", "found 'bricks'"),
        (SMALLEST + '[parameters.E_c]\nunit = "kPa"\n', "parameters.E_c.unit", "found 'kPa'; expected 'Pa'"),
        (SMALLEST + '[model]\nforward = "a.py:f"\nobservation = "article"\n', "model.observation", "'own'"),
        ("seed = true\n" + SMALLEST, "seed", "integer"),
        ('name = "../up"\n' + SMALLEST, "name", "pattern"),
        ("recording = 3\n", "recording", "found 3"),
        (SMALLEST + "[parameters]\nE_c = 3\n", "parameters.E_c", "found 3"),
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
    assert re.search(r": found .+; expected .+", line)


def test_what_is_not_toml_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 2"):
        load_config(written(tmp_path, "a = 1\nb = = 2\n"))
    with pytest.raises(InputError, match="no such file"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="expected a TOML configuration"):
        load_config(tmp_path / "binary.toml")
    with pytest.raises(InputError):
        load_config(tmp_path)
