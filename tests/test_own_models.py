"""A model of one's own in the full model's place: a function in a file, a UM-Bridge server; ours served."""

from __future__ import annotations

import dataclasses
import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import umbridge
from own_models import PARAMETERS, SPRING, TRUE, spring
from toy import MOTION

from bayeskin import cli, report, storage
from bayeskin.design import Wave
from bayeskin.errors import InputError, Unavailable
from bayeskin.execution.local import local
from bayeskin.external.model import identity, simulate_own, simulate_server, simulate_with
from bayeskin.external.umbridge import Client, server
from bayeskin.finite_element import ModelSpec
from bayeskin.mechanisms import bin_means, catalogue, observed
from bayeskin.runner import load_design, run_design
from bayeskin.types import PadMotion, Parameter, ParameterSpace, Recording
from bayeskin.workflow import stages
from bayeskin.workflow.diagnosis import diagnose
from bayeskin.workflow.doctor import FULL_MODEL_N, THETA
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.serve import Asked, ServedModel, open_server

CONFIG = """
[recording]
file = "measured.h5"
[model]
forward = "{forward}"
[fit]
bin_width_s = 1.0
[design]
points = [32]
held_out = 8
workers = 1
[map]
starts = 2
evaluations = 2000
"""
SPACE = ParameterSpace(
    tuple(
        Parameter(name, "", low, high, "uniform")
        for name, low, high in (("stiffness", 10.0, 800.0), ("share", 0.0, 1.0), ("tau", 1.0, 50.0))
    )
)
NOISE_N = 0.002


@pytest.fixture
def case(tmp_path: Path) -> Path:
    """A configuration of the spring with a recording that it made."""
    time_s = np.arange(0.0, 130.001, 0.1)
    pulled = MOTION.at(time_s)
    noise_n = NOISE_N * np.random.default_rng(5).standard_normal(len(time_s))
    force_n = spring()(TRUE, time_s, pulled) + noise_n
    storage.save(tmp_path / "measured.h5", Recording(time_s, pulled, force_n, "spring", "0" * 64))
    (tmp_path / "spring.py").write_text(SPRING)
    return configured(tmp_path / "case.toml", "spring.py:force")


def configured(path: Path, forward: str, more: str = PARAMETERS) -> Path:
    path.write_text(CONFIG.format(forward=forward) + more)
    return path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, provenance: None)


@pytest.fixture(scope="module")
def umbridge_url() -> Iterator[str]:
    """A server of the package `umbridge` with two models, in a process of its own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = [sys.executable, str(Path(__file__).with_name("own_models.py")), str(port)]
    process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    for _ in range(600):
        try:
            umbridge.supported_models(url)
            break
        except OSError:
            time.sleep(0.1)
    yield url
    process.terminate()
    process.wait()


@pytest.fixture
def served(case: Path) -> Iterator[str]:
    """`bayeskin serve` on the spring."""
    yield from serving(case)


def serving(config: Path | None) -> Iterator[str]:
    listening, said = open_server(config, "127.0.0.1", 0, Silent())
    threading.Thread(target=listening.serve_forever, daemon=True).start()
    yield said["url"]
    listening.shutdown()
    listening.server_close()


def test_a_function_in_a_file_is_fitted_with_parameters_of_its_own(case: Path, undrawn: None) -> None:
    answer = stages.run(case, "map", Silent())
    assert answer["ok"], answer["text"]
    assert answer["polished"] is None
    assert list(answer["theta"])[:3] == list(TRUE)
    for name, value in TRUE.items():
        assert answer["theta"][name] == pytest.approx(value, rel=0.05), name
    assert answer["rmse_of_full_model"]["fitted_n"] < NOISE_N


@pytest.mark.slow
def test_a_diagnosis_solves_what_acts_on_the_force_beside_a_model_of_one_s_own(case: Path) -> None:
    file = case.parent / "measured.h5"
    measured = storage.load(file, Recording)
    storage.save(file, dataclasses.replace(measured, force_n=measured.force_n - 0.03))
    said = diagnose(case, Silent())
    (one,) = said["mechanisms"]
    assert one["name"] == "force-offset"
    offset = one["parameters"]["F0"]
    assert abs(offset["mean"] + 0.03) < 4.0 * offset["sd"] < 0.01
    assert said["full_model"]["rmse"] < NOISE_N
    for name, value in TRUE.items():
        low, high = said["fit"]["after"]["theta"][name]["interval90"]
        assert 0.9 * low < value < 1.1 * high, name


def test_a_change_of_what_the_file_does_makes_the_runs_again_and_nothing_else(
    case: Path, undrawn: None
) -> None:
    assert stages.run(case, "design", Silent())["skipped"] == []
    assert stages.run(case, "design", Silent())["skipped"] == ["recording", "design"]
    before = load_design(case.parent / "case" / "design" / "design.h5")
    reworded = SPRING.replace("parallel.", "parallel:").replace("    pull =", "    # Hooke\n    pull =")
    (case.parent / "spring.py").write_text(reworded)
    assert stages.run(case, "design", Silent())["skipped"] == ["recording", "design"]
    assert identity(f"{case.parent / 'spring.py'}:force") == before.model_hash
    (case.parent / "spring.py").write_text(SPRING.replace("return pull", "return 2 * pull"))
    assert stages.run(case, "design", Silent())["skipped"] == ["recording"]
    after = load_design(case.parent / "case" / "design" / "design.h5")
    assert before.model_hash != after.model_hash
    np.testing.assert_array_equal(before.theta, after.theta)
    assert not np.allclose(before.force_n, after.force_n)


def test_any_callable_runs_through_the_runner(tmp_path: Path) -> None:
    edges_s, theta = (
        np.arange(0.0, 130.5, 1.0),
        SPACE.from_unit(np.random.default_rng(1).uniform(size=(3, 3))),
    )
    wave = Wave(SPACE, theta, np.zeros(3, bool), 0, 1)
    run = partial(simulate_with, hooke, MOTION, model_hash="mine")
    design = run_design(tmp_path / "d.h5", wave, edges_s, run, "mine", local(1))
    middle_s = edges_s[:-1] + 0.5
    assert design.ok.all()
    np.testing.assert_allclose(
        design.force_n[:, 20:40], np.outer(theta[:, 0], MOTION.at(middle_s[20:40])), rtol=1e-9
    )


def hooke(theta: dict[str, float], time_s: np.ndarray, displacement_m: np.ndarray) -> np.ndarray:
    return theta["stiffness"] * displacement_m


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a command that ends with exit code 2."""
    with pytest.raises(SystemExit) as stop:
        cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("bayeskin: ")]
    assert lines == [captured.err.splitlines()[-1]]
    return lines[0]


def test_a_function_that_raises_is_a_run_that_failed() -> None:
    def raising(theta, time_s, displacement_m):
        raise ValueError("too\nstiff")

    found = simulate_with(raising, MOTION, TRUE)
    assert found.status == "failed"
    assert found.message.startswith("ValueError: too stiff (test_own_models.py, line ")


def test_a_function_is_asked_for_no_time_twice() -> None:
    asked: list[np.ndarray] = []
    motion = PadMotion(
        np.array([0.0, 3 * 0.1, 1.0, 9.600000000000001, 20.0]), np.array([0, 0, 1e-3, 1e-3, 0])
    )
    simulate_with(lambda theta, time_s, d: asked.append(time_s) or d, motion, TRUE)
    assert np.diff(asked[0]).min() > 1e-3
    assert set(motion.time_s) <= set(asked[0])
    assert np.diff(asked[0]).max() < 0.1 + 1e-9


@pytest.mark.parametrize(
    ("forward", "more", "says"),
    [
        ("absent.py:force", PARAMETERS, "absent.py"),
        ("spring.py:absent", PARAMETERS, "no function absent"),
        ("spring.py:number", PARAMETERS, "no function number"),
        ("spring.py", PARAMETERS, "expected FILE.py:FUNCTION"),
        ("nowhere.at.all:force", PARAMETERS, "expected a Python file or module"),
        ("broken.py:force", PARAMETERS, "SyntaxError"),
        ("spring.py:raising", PARAMETERS, "ZeroDivisionError: division by zero (spring.py, line "),
        ("spring.py:short", PARAMETERS, "a force of shape (3,); expected (1"),
        ("spring.py:endless", PARAMETERS, "not finite"),
        ("spring.py:force", "", "KeyError: 'stiffness'"),
        ("spring.py:force", "[parameters.stiffness]\nlower = 1.0\n", "stiffness.upper: found nothing"),
        ("spring.py:force", PARAMETERS + '[surrogate]\nfile = "demo.h5"\n', "surrogate.file: found one"),
        ("ftp://here", PARAMETERS, "expected http://HOST:PORT"),
        ("http://here:port", PARAMETERS, "expected http://HOST:PORT"),
        ("http://127.0.0.1:9", PARAMETERS, "no answer"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(
    case: Path, capsys: pytest.CaptureFixture[str], forward: str, more: str, says: str, undrawn: None
) -> None:
    (case.parent / "broken.py").write_text("def force(:\n")
    assert says in refused(capsys, "design", configured(case, forward, more))
    assert not list((case.parent / "case").glob("runs/*"))


def test_own_and_full_models_are_not_mixed(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = case.parent / "f.csv"
    for option in (("--fields", "f"), ("--figures", "f"), ("--mechanism", "force-offset")):
        assert "no fields, figures or mechanisms" in refused(capsys, "simulate", case, *option, "-o", out)
    assert "a model of your own" in refused(capsys, "simulate", case, "--mesh", "bricks", "-o", out)
    case.write_text(case.read_text().replace('forward = "spring.py:force"', 'observation = "own"'))
    assert "expected 'own' with model.forward" in refused(capsys, "simulate", case, "-o", out)


def test_simulate_runs_it(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = case.parent / "f.csv"
    with pytest.raises(SystemExit) as stop:
        cli.main(["simulate", str(case), "--set", "share=0", "--set", "stiffness=50", "-o", str(out)])
    assert stop.value.code == 0
    assert "no estimated error: a model of your own" in capsys.readouterr().out
    _, displacement_m, force_n = np.loadtxt(out, delimiter=",", skiprows=1).T
    np.testing.assert_allclose(force_n, 50.0 * displacement_m, atol=1e-12)


def test_a_server_of_the_package_umbridge_gives_what_the_function_gives(umbridge_url: str) -> None:
    run = simulate_server(f"{umbridge_url}#spring", MOTION, TRUE)
    direct = simulate_with(spring(), MOTION, TRUE)
    assert run.status == "ok"
    np.testing.assert_array_equal(run.time_s, direct.time_s)
    np.testing.assert_allclose(run.force_n, direct.force_n, rtol=1e-12)
    with pytest.raises(
        InputError, match=r"several models; expected #NAME after the URL, one of spring, other"
    ):
        simulate_server(umbridge_url, MOTION, TRUE)
    with pytest.raises(InputError, match="no model 'wing'; expected one of spring, other"):
        simulate_server(f"{umbridge_url}#wing", MOTION, TRUE)
    with pytest.raises(InputError, match="a model of 3 inputs; expected 2: stiffness, share"):
        simulate_server(f"{umbridge_url}#spring", MOTION, {"stiffness": 1.0, "share": 0.0})


def test_a_design_runs_through_a_server_and_its_refusals_are_failed_runs(
    umbridge_url: str, case: Path, undrawn: None
) -> None:
    config = configured(case, f"{umbridge_url}#spring")
    answer = stages.run(config, "design", Silent())
    design = load_design(case.parent / "case" / "design" / "design.h5")
    stiff = design.theta[:, 0] > 900.0
    np.testing.assert_array_equal(design.ok, ~stiff)
    assert answer["runs"] == 40
    assert stiff.any()


def test_ours_answers_the_client_of_the_package_umbridge(served: str) -> None:
    model = umbridge.HTTPModel(served, "bayeskin")
    assert (model.supports_evaluate(), model.supports_gradient()) == (True, False)
    assert model.get_input_sizes() == [3]
    assert model.get_output_sizes() == [130]
    direct = simulate_with(spring(), MOTION, TRUE)
    (found,) = model([list(TRUE.values())])
    np.testing.assert_allclose(found, direct.bin_means(np.arange(131.0)), rtol=1e-6, atol=1e-9)
    at = {"times_s": [10.0, 20.5]}
    assert model.get_output_sizes(at) == [2]
    np.testing.assert_allclose(model([list(TRUE.values())], at)[0], direct.at([10.0, 20.5]), rtol=1e-5)
    other = {"protocol": {"time_s": [0.0, 4.0], "displacement_m": [0.0, 4e-3]}, "edges_s": [0.0, 2.0, 4.0]}
    (two,) = model([[100.0, 0.0, 8.0]], other)
    np.testing.assert_allclose(two, [0.1, 0.3], rtol=1e-9)


def test_a_mechanism_whose_parameter_has_the_models_name_is_refused() -> None:
    own = (Parameter("F0", "N", 0.0, 1.0, "uniform"),)
    model = ServedModel(ModelSpec(), own, Asked(MOTION, np.arange(0.0, 131.0), None, ()))
    with pytest.raises(InputError, match="found F0 twice"):
        model.input_sizes({"mechanisms": ["force-offset"]})


def test_a_function_that_cannot_be_imported_is_not_offered(case: Path) -> None:
    (case.parent / "broken.py").write_text("import no_such_package\n\ndef force(*_): pass\n")
    for forward, says in (("broken.py:force", "no_such_package"), ("spring.py:pull", "no function pull")):
        with pytest.raises(InputError, match=says):
            open_server(configured(case.parent / "other.toml", forward), "127.0.0.1", 0, Silent())


def test_a_server_that_does_not_answer_is_not_offered(case: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(Unavailable, match=url):
            open_server(configured(case.parent / "other.toml", url), "127.0.0.1", 0, Silent())


def test_instrument_mechanisms_bring_their_parameters(served: str) -> None:
    model, config = umbridge.HTTPModel(served, "bayeskin"), {"mechanisms": ["force-offset", "sensor-drift"]}
    assert model.get_input_sizes(config) == [5]
    values = {**TRUE, "offset": 0.02, "drift": 1e-4}
    known = catalogue()
    names = [p.name for n in config["mechanisms"] for p in known[n].parameters]
    direct = simulate_with(spring(), MOTION, TRUE)
    columns = {name: np.array([value]) for name, value in zip([*TRUE, *names], values.values(), strict=True)}
    force = observed([known[n] for n in config["mechanisms"]], columns, MOTION, lambda t: direct.at(t)[None])
    (found,) = model([list(values.values())], config)
    np.testing.assert_allclose(found, bin_means(force, MOTION, np.arange(131.0))[0], rtol=1e-5)


@pytest.mark.parametrize(
    ("inputs", "config", "says"),
    [
        ([[1.0, 2.0]], {}, "lengths [2]; expected lengths [3]"),
        ([[1.0, 2.0, "3"]], {}, "found '3'; expected finite numbers"),
        ([[1.0, 2.0, 3.0]], {"colour": 1}, "config: colour: found an unknown key; expected one of protocol"),
        ([[1.0, 2.0, 3.0]], {"protocol": [1]}, "config: protocol"),
        ([[1.0, 2.0, 3.0]], {"protocol": {"time_s": [1, 2], "displacement_m": [0, 1]}}, "increase from 0"),
        (
            [[1.0, 2.0, 3.0]],
            {"protocol": {"time_s": [0, 2], "displacement_m": [0]}},
            "2 times, 1 displacements",
        ),
        ([[1.0, 2.0, 3.0]], {"times_s": [3.0, 500.0]}, "times within the protocol's 0 to 130 s"),
        ([[1.0, 2.0, 3.0]], {"edges_s": [3.0]}, "1 edges"),
        ([[1.0, 2.0, 3.0]], {"mechanisms": ["wings"]}, "'wings'; expected some of amplifier-lag"),
        ([[1.0, 2.0, 3.0]], {"mechanisms": ["solid-viscoelasticity"]}, "lengths [3]; expected lengths [7]"),
        (
            [[1.0, 2.0, 3.0, 0.1, 0.1, 1.0, 2.0]],
            {"mechanisms": ["solid-viscoelasticity"]},
            "tissue mechanisms",
        ),
    ],
)
def test_what_a_client_gets_wrong_it_is_told(served: str, inputs: list, config: dict, says: str) -> None:
    model = umbridge.HTTPModel(served, "bayeskin")
    with pytest.raises(Exception, match="InvalidInput") as caught:
        model(inputs, config)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"name": "x"}', b'{"name": "bayeskin", "config": 3}'])
def test_nonsense_does_not_end_the_server(served: str, body: bytes) -> None:
    for path in ("/Evaluate", "/InputSizes", "/Gradient", "/nowhere"):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(urllib.request.Request(served + path, data=body))
        assert caught.value.code == 400
        assert "error" in json.loads(caught.value.read())
    assert Client(served).name() == "bayeskin"


def test_ours_stands_in_for_itself_over_the_wire(served: str, case: Path) -> None:
    over = simulate_own(served, MOTION, TRUE)
    here = simulate_own(f"{case.parent / 'spring.py'}:force", MOTION, TRUE)
    np.testing.assert_allclose(over.force_n, here.force_n, rtol=1e-6, atol=1e-9)
    assert over.model_hash == identity(served) != here.model_hash


def test_the_full_model_is_served(served: str) -> None:
    for url in serving(None):
        model = umbridge.HTTPModel(url, "bayeskin")
        protocol = {"time_s": [0.0, 2.0], "displacement_m": [0.0, 2e-3]}
        config = {"protocol": protocol, "times_s": [2.0]}
        assert model.get_input_sizes(config) == [5]
        assert model([list(THETA.values())], config)[0][0] == pytest.approx(FULL_MODEL_N, rel=1e-3)
        with pytest.raises(Exception, match=r"InvalidInput.*E_c: found -1"):
            model([[-1.0, *list(THETA.values())[1:]]], config)


class Waiting:
    """A model that answers when it is let."""

    name = "waiting"

    def __init__(self) -> None:
        self.begun, self.let = threading.Event(), threading.Event()

    def input_sizes(self, config):
        return [1]

    def output_sizes(self, config):
        return [1]

    def evaluate(self, inputs, config):
        self.begun.set()
        assert self.let.wait(20.0)
        return inputs


def asked_raw(address, sent: bytes, reset: bool) -> socket.socket:
    """A connection that has sent bytes; `reset`: one that its client will tear down as it closes it."""
    client = socket.create_connection(address, timeout=20.0)
    if reset:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.sendall(sent)
    return client


def test_clients_that_misbehave_or_leave_print_nothing_at_the_server(capfd: pytest.CaptureFixture) -> None:
    model, before = Waiting(), set(threading.enumerate())
    listening = server(model, "127.0.0.1", 0)
    serving = threading.Thread(target=listening.serve_forever, daemon=True)
    serving.start()
    body = b'{"name": "waiting", "input": [[1.0]]}'
    whole = b"POST /Evaluate HTTP/1.1\r\nContent-Length: %d\r\n\r\n" % len(body) + body
    leaving = asked_raw(listening.server_address, whole, reset=True)
    assert model.begun.wait(20.0)
    leaving.close()
    for sent in (b"", b"\x00\xff garbage\r\n\r\n", b"GET /Info", whole[:-5], b"POST / HTTP/1.1\r\n"):
        asked_raw(listening.server_address, sent, reset=True).close()
    for length in (b"-1", b"9" * 5000, b"64000001", b"x"):
        sent = b"POST /Evaluate HTTP/1.1\r\nContent-Length: %s\r\n\r\n" % length
        with asked_raw(listening.server_address, sent, reset=False) as client:
            assert client.recv(100).startswith(b"HTTP/1.0 400")
    with asked_raw(listening.server_address, whole[:-5], reset=False) as client:
        client.shutdown(socket.SHUT_WR)
        assert client.recv(100).startswith(b"HTTP/1.0 400")
    model.let.set()
    for thread in set(threading.enumerate()) - before - {serving}:
        thread.join(20.0)
    assert Client(f"http://127.0.0.1:{listening.server_address[1]}").name() == "waiting"
    listening.shutdown()
    listening.server_close()
    assert capfd.readouterr() == ("", "")


def test_a_server_that_goes_away_costs_no_finished_run_and_fails_none(tmp_path: Path) -> None:
    class Mortal:
        name, left = "mortal", 4

        def input_sizes(self, config):
            return [3]

        def output_sizes(self, config):
            return [len(config["times_s"])]

        def evaluate(self, inputs, config):
            Mortal.left -= 1
            if Mortal.left == 0:
                threading.Thread(target=stop).start()
                time.sleep(0.5)
            return [[inputs[0][0]] * len(config["times_s"])]

    def stop() -> None:
        listening.shutdown()
        listening.server_close()

    def start(port: int):
        found = server(Mortal(), "127.0.0.1", port)
        threading.Thread(target=found.serve_forever, daemon=True).start()
        return found

    listening = start(0)
    port = listening.server_address[1]
    url = f"http://127.0.0.1:{port}"
    theta = SPACE.from_unit(np.random.default_rng(2).uniform(size=(8, 3)))
    wave, edges_s = Wave(SPACE, theta, np.zeros(8, bool), 0, 1), np.arange(0.0, 131.0, 10.0)
    run = partial(simulate_server, url, MOTION)
    with pytest.raises(Unavailable, match=r"no answer .*; expected a server that speaks UM-Bridge"):
        run_design(tmp_path / "d.h5", wave, edges_s, run, identity(url), local(1))
    kept = len((tmp_path / "d.h5.journal").read_bytes().splitlines())
    assert 3 <= kept <= 4
    Mortal.left = 1000
    listening = start(port)
    design = run_design(tmp_path / "d.h5", wave, edges_s, run, identity(url), local(1))
    stop()
    assert Mortal.left == 1000 - (8 - kept)
    assert design.ok.all()
    np.testing.assert_allclose(design.force_n, np.repeat(theta[:, :1], 13, axis=1), rtol=1e-12)


def test_the_command_serves_on_loopback_until_it_is_interrupted(case: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from bayeskin.cli import main; main()",
        "serve",
        str(case),
        "--port",
        "0",
    ]
    process = subprocess.Popen(
        [*command, "--json"],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell ignores it
    )
    text = ""
    while not text.endswith("}\n"):
        line = process.stdout.readline()
        assert line, f"it ended after {text!r}"
        text += line
    said = json.loads(text)
    assert said["url"].startswith("http://127.0.0.1:")
    assert umbridge.supported_models(said["url"]) == ["bayeskin"]
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) == 0


def test_a_port_that_is_taken_is_told(served: str, case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = served.rpartition(":")[2]
    assert f"127.0.0.1:{port}" in refused(capsys, "serve", case, "--port", port)
