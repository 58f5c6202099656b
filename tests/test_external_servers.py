"""Servers of forward models by UM-Bridge: others' asked, and ours that answers."""

from __future__ import annotations

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
from toys.closed_form_model import MOTION
from toys.external_models import TRUE, spring
from toys.spring_case import SPACE, configured, refused, spring_case

from bayeskin import report
from bayeskin.design import Wave
from bayeskin.design_files import load_design
from bayeskin.errors import InputError, Unavailable
from bayeskin.execution.local import here, local
from bayeskin.external.model import identity, simulate_own, simulate_server, simulate_with
from bayeskin.external.umbridge import Client, server
from bayeskin.finite_element import ModelSpec
from bayeskin.mechanisms import bin_means, catalogue, observed
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.types import Parameter
from bayeskin.workflow import executor, stages
from bayeskin.workflow.doctor_models import FULL_MODEL_N, THETA
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.serve import Asked, ServedModel, open_server

POLL_S = 0.01  # between two looks of a server at whether it is to stop


@pytest.fixture
def case(tmp_path: Path) -> Path:
    return spring_case(tmp_path)


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets stages run without drawings and without other processes."""
    monkeypatch.setattr(executor, "local", lambda workers: here)
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, provenance: None)


@pytest.fixture(scope="module")
def umbridge_url() -> Iterator[str]:
    """A server of the package `umbridge` with two models, in a process of its own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = [sys.executable, str(Path(__file__).parent / "toys/external_models.py"), str(port)]
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


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """`bayeskin serve` on the spring; no request may change what it answers to the next."""
    yield from serving(spring_case(tmp_path_factory.mktemp("served")))


def serving(config: Path | None) -> Iterator[str]:
    listening, said = open_server(config, "127.0.0.1", 0, Silent())
    threading.Thread(target=listening.serve_forever, args=(POLL_S,), daemon=True).start()
    yield said["url"]
    listening.shutdown()
    listening.server_close()


def test_a_server_of_the_package_umbridge_gives_what_the_function_gives(umbridge_url: str) -> None:
    run = simulate_server(f"{umbridge_url}#spring", MOTION, TRUE)
    direct = simulate_with(spring(), MOTION, TRUE)
    assert run.status == "ok"
    np.testing.assert_array_equal(run.time_s, direct.time_s)
    np.testing.assert_allclose(run.force_n, direct.force_n, rtol=1e-12)
    with pytest.raises(
        InputError, match=r"several models; write #NAME after the URL, with one of spring, other"
    ):
        simulate_server(umbridge_url, MOTION, TRUE)
    with pytest.raises(InputError, match="no model 'wing'; use one of spring, other"):
        simulate_server(f"{umbridge_url}#wing", MOTION, TRUE)
    with pytest.raises(InputError, match="inputs is 3; it must be 2: stiffness, share"):
        simulate_server(f"{umbridge_url}#spring", MOTION, {"stiffness": 1.0, "share": 0.0})


def test_a_design_runs_through_a_server_and_its_refusals_are_failed_runs(
    umbridge_url: str, case: Path, quickly: None
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
    (output,) = model([list(TRUE.values())])
    np.testing.assert_allclose(output, direct.bin_means(np.arange(131.0)), rtol=1e-6, atol=1e-9)
    at = {"times_s": [10.0, 20.5]}
    assert model.get_output_sizes(at) == [2]
    np.testing.assert_allclose(model([list(TRUE.values())], at)[0], direct.at([10.0, 20.5]), rtol=1e-5)
    other = {"protocol": {"time_s": [0.0, 4.0], "displacement_m": [0.0, 4e-3]}, "edges_s": [0.0, 2.0, 4.0]}
    (two,) = model([[100.0, 0.0, 8.0]], other)
    np.testing.assert_allclose(two, [0.1, 0.3], rtol=1e-9)


def test_a_mechanism_whose_parameter_has_the_models_name_is_refused() -> None:
    own = (Parameter("F0", "N", 0.0, 1.0, "uniform"),)
    model = ServedModel(ModelSpec(), own, Asked(MOTION, np.arange(0.0, 131.0), None, ()))
    with pytest.raises(InputError, match="the name F0"):
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
    (output,) = model([list(values.values())], config)
    np.testing.assert_allclose(output, bin_means(force, MOTION, np.arange(131.0))[0], rtol=1e-5)


@pytest.mark.parametrize(
    ("inputs", "config", "says"),
    [
        ([[1.0, 2.0]], {}, "lengths [2]; the lengths must be [3]"),
        ([[1.0, 2.0, "3"]], {}, "'3' is not a finite number"),
        ([[1.0, 2.0, 3.0]], {"colour": 1}, "config: colour: this key is not known; use some of protocol"),
        ([[1.0, 2.0, 3.0]], {"protocol": [1]}, "config: protocol"),
        ([[1.0, 2.0, 3.0]], {"protocol": {"time_s": [1, 2], "displacement_m": [0, 1]}}, "increase from 0"),
        (
            [[1.0, 2.0, 3.0]],
            {"protocol": {"time_s": [0, 2], "displacement_m": [0]}},
            "2 times and 1 displacements",
        ),
        ([[1.0, 2.0, 3.0]], {"times_s": [3.0, 500.0]}, "within the protocol, 0 to 130 s"),
        ([[1.0, 2.0, 3.0]], {"edges_s": [3.0]}, "the number of edges is 1"),
        ([[1.0, 2.0, 3.0]], {"mechanisms": ["wings"]}, "'wings' is not known; use some of amplifier-lag"),
        (
            [[1.0, 2.0, 3.0]],
            {"mechanisms": ["solid-viscoelasticity"]},
            "lengths [3]; the lengths must be [7]",
        ),
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
        with pytest.raises(Exception, match=r"InvalidInput.*E_c: it is -1"):
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
    serving = threading.Thread(target=listening.serve_forever, args=(POLL_S,), daemon=True)
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
        served = server(Mortal(), "127.0.0.1", port)
        threading.Thread(target=served.serve_forever, args=(POLL_S,), daemon=True).start()
        return served

    listening = start(0)
    port = listening.server_address[1]
    url = f"http://127.0.0.1:{port}"
    theta = SPACE.from_unit(np.random.default_rng(2).uniform(size=(8, 3)))
    wave, edges_s = Wave(SPACE, theta, np.zeros(8, bool), 0, 1), np.arange(0.0, 131.0, 10.0)
    run = partial(simulate_server, url, MOTION)
    with (
        Store(tmp_path / "a.store", url) as store,
        pytest.raises(
            Unavailable, match=r"no server answers .*; bayeskin needs a server that speaks UM-Bridge"
        ),
    ):
        run_design(store, wave, edges_s, run, identity(url), local(1))
    kept = len((tmp_path / "a.store").read_bytes().splitlines()) - 1
    assert 3 <= kept <= 4
    Mortal.left = 1000
    listening = start(port)
    with Store(tmp_path / "a.store", url) as store:
        design = run_design(store, wave, edges_s, run, identity(url), local(1))
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
