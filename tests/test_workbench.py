"""What a diagnosis works on: the configuration's priors, and of a beginning nothing of what follows it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import toy
from toy_inference import ToySurrogate, empty_recording
from toys.small_reduced import hollow

from bayeskin import storage
from bayeskin.config import config_of, parameter_space
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.binned import estimates_by_name
from bayeskin.pipeline.engine import Silent
from bayeskin.pipeline.model import reduced_files
from bayeskin.pipeline.workbench import Workbench, opened
from bayeskin.proof.cases import shipped_screen
from bayeskin.proof.protocol import MOTION, SURROGATE
from bayeskin.shipped import shipped
from bayeskin.surrogates import effects_beside, effects_in, load_effect
from bayeskin.types import BinnedForce, Jumps, Recording

KNOWN = {"force-offset": catalogue()["force-offset"]}


def bench(binned: BinnedForce, **parameters: Any) -> Workbench:
    """Of the toy."""
    told = {"name": "toy", "recording": {"file": "none.h5"}, "parameters": parameters}
    run: Any = SimpleNamespace(config=config_of(told, "here"))
    jumps: Any = None
    made = Workbench(run, binned, jumps, toy.MOTION, ToySurrogate(), (), KNOWN)
    vars(made)["spec"] = SimpleNamespace(observation="article")  # whose mesh is allowed nothing
    return made


def binned_force() -> BinnedForce:
    """Rising, with noise of 1 mN in each bin."""
    empty = empty_recording()
    count = len(empty.force_n)
    return dataclasses.replace(empty, force_n=np.linspace(0.0, 0.5, count), variance_n2=np.full(count, 1e-6))


def test_the_configuration_s_priors_are_the_diagnosis_s() -> None:
    soft = {"lower": 2e4, "upper": 8e4, "prior": "log-normal", "median": 4e4, "factor": 1.5}
    found = bench(binned_force(), E_c=soft).posterior(None, ["force-offset"])
    free = bench(binned_force()).posterior(None, ["force-offset"])
    assert found.names == free.names
    at = found.names.index("E_c")
    np.testing.assert_allclose(np.exp([bound[at] for bound in found.bounds]), [2e4, 8e4])
    middle = found.from_sampling(0.5 * (found.bounds[0] + found.bounds[1]))

    def told_apart(problem: LogPosterior) -> float:
        """Logarithm of the prior's density at 40 kPa over that at 60 kPa."""
        theta = np.tile(middle, (2, 1))
        theta[:, at] = 4e4, 6e4
        prior = problem.log_prob(problem.to_sampling(theta)) - problem.log_likelihood(theta)
        return float(prior[0] - prior[1])

    assert told_apart(found) == pytest.approx(0.5)  # one factor away
    assert told_apart(free) == pytest.approx(0.0, abs=1e-9)


def test_a_fit_to_the_beginning_knows_nothing_of_what_follows() -> None:
    binned = binned_force()
    split_s = float(binned.edges_s[60])
    later = binned.edges_s[1:] > split_s
    loud = dataclasses.replace(
        binned, force_n=np.where(later, 9.0, binned.force_n), variance_n2=np.where(later, 1e-2, 1e-6)
    )
    first, second = (bench(one).posterior(split_s, []) for one in (binned, loud))
    assert first.noise_priors == second.noise_priors
    assert first.sure_within_n == second.sure_within_n
    whole = bench(loud).posterior(None, [])
    assert whole.sure_within_n is not None
    assert second.sure_within_n is not None
    assert whole.sure_within_n > 10.0 * second.sure_within_n


def test_what_was_learnt_of_a_mechanism_stands_in_its_shortcut_s_place() -> None:
    """Pads that slip act once: by their effect, not by the shortcut on the force as well."""
    files = effects_in(effects_beside(shipped(SURROGATE)))
    estimates = estimates_by_name(catalogue(), MOTION)
    effects = {effect.part: effect for effect in (load_effect(file, estimates) for file in files)}
    names = ["force-offset", "pad-slip", "solid-viscoelasticity"]
    known = {name: catalogue()[name] for name in names}
    made = dataclasses.replace(bench(binned_force()), base=shipped_screen().refit.surrogate, known=known)

    def parts(*learnt: str) -> tuple[list[str], list[str]]:
        surrogate: Any = dataclasses.replace(made, effects=tuple(effects[n] for n in learnt)).surrogate(names)
        return [m.name for m in surrogate.mechanisms], list(surrogate.inner.space.names[5:])

    relaxing = "solid-viscoelasticity-g_1"
    assert parts(relaxing) == (["force-offset", "pad-slip"], ["g_1", "tau_1"])
    assert parts(relaxing, "pad-slip") == (
        ["force-offset"], ["g_1", "tau_1", "slip_rate", "slip_threshold"]
    )  # fmt: skip


@pytest.mark.parametrize("smoother", [None, "amplifier-lag", "clock-delay"])
def test_samples_refute_no_step_beside_what_smooths_or_shifts_it(smoother: str | None) -> None:
    names = ("sensor-events",) if smoother is None else ("sensor-events", smoother)
    binned = binned_force()
    known = {name: catalogue()[name] for name in names}
    none = Jumps(binned.edges_s, *np.zeros((2, len(binned.edges_s))))
    plain = bench(binned)
    made = dataclasses.replace(plain, jumps=none, known=known)
    theta = {name: value for one in known.values() for name, value in one.neutral.items()}
    theta |= {"event_1_step": 0.03}
    found: Any = SimpleNamespace(names=names, theta=theta, log_posterior=plain.posterior(None, []))
    assert made.refuted(found) == ([] if smoother else ["sensor-events"])


def recording(path: Path) -> Path:
    """Two ramps and holds, which no shipped surrogate knows."""
    time_s = np.arange(0.0, 60.0, 0.1)
    u_m = np.interp(time_s, [0.0, 5.0, 9.0, 30.0, 34.0, 60.0], [0.0, 0.0, 3e-3, 3e-3, 6e-3, 6e-3])
    noise_n = 1e-3 * np.random.default_rng(1).standard_normal(len(time_s))
    storage.save(path / "a test.h5", Recording(time_s, u_m, 30.0 * u_m + noise_n, "own", "0" * 64))
    return path / "a test.h5"


def test_a_protocol_that_no_surrogate_knows_takes_the_reduced_model(tmp_path: Path) -> None:
    run = opened(recording(tmp_path), Silent())
    assert (run.config.design.coarse, run.config.surrogate.file) == ("reduced", None)
    assert run.config.geometry(run.config_path).geometry == Geometry()
    assert run.folder == tmp_path / "a test-diagnosis"
    (file,) = reduced_files(run)
    assert file == shipped("surrogates/article-device-reduced.h5")


def test_a_protocol_that_a_surrogate_knows_takes_that(tmp_path: Path) -> None:
    (tmp_path / "mine.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    run = opened(tmp_path / "mine.h5", Silent())
    assert (run.config.design.coarse, run.config.surrogate.file) == (None, "demo.h5")
    assert reduced_files(run) == []


def test_a_recording_of_a_stated_device_takes_that_device_s_reduced_model(tmp_path: Path) -> None:
    """Though its protocol is that of a surrogate, which is of another device."""
    thin = Geometry(cutis_m=1.5e-3)
    (tmp_path / "mine.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    (tmp_path / "device.toml").write_text("[tissue]\ncutis_mm = 1.5\n")
    run = opened(tmp_path / "mine.h5", Silent(), tmp_path / "device.toml")
    assert (run.config.design.coarse, run.config.surrogate.file) == ("reduced", None)
    assert run.config.geometry(run.config_path).geometry == thin
    own = hollow(tmp_path / "device-reduced.h5", thin)
    assert reduced_files(run) == [own]


def test_an_uncertain_length_asks_for_the_reduced_model(tmp_path: Path) -> None:
    recording(tmp_path)
    tissue = "[tissue]\ncutis_mm = { mean = 2.0, sd = 0.2 }\n"
    (tmp_path / "device.toml").write_text(tissue)
    run = opened(tmp_path / "a test.h5", Silent(), tmp_path / "device.toml")
    assert "cutis_m" in parameter_space(run.config).names
    case = tmp_path / "case.toml"
    case.write_text(f'[recording]\nfile = "a test.h5"\n{tissue}')
    with pytest.raises(InputError, match=r"tissue\.cutis_mm: found a mean and an sd; expected a number"):
        opened(case, Silent())
    case.write_text(case.read_text() + '[design]\ncoarse = "reduced"\n')
    assert opened(case, Silent()).config.geometry(case).sd_m == {"cutis_m": 0.2e-3}


def test_a_device_stands_beside_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--device: found device\.toml beside a configuration"):
        opened(tmp_path / "case.toml", Silent(), Path("device.toml"))
