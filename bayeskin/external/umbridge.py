"""Client and server of UM-Bridge, a protocol that connects models with tools of uncertainty quantification.

Seidelmann, L. et al. (2023), UM-Bridge: Uncertainty quantification and modeling bridge, JOSS 8(83), 4748.
The protocol is JSON over HTTP, version 1.0: a model takes vectors and a configuration, and returns vectors.
This module needs only the standard library. The package `umbridge` has a server too, but that server listens
to every network and opens shared memory by names that a client sends; the server here does neither. The tests
run client and server against that package.
"""

from __future__ import annotations

import http.client
import json
import math
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any, Protocol
from urllib.parse import urlsplit

from bayeskin.errors import InputError, Unavailable

VERSION = 1.0
CONNECT_S = 10.0
MOST_BYTES = 64_000_000  # largest size of a request; a protocol of a million corners takes half of it
REMEDY = "bayeskin needs a server that speaks UM-Bridge"

Vectors = list[list[float]]


class Model(Protocol):
    """A model that a server offers. Each method raises InputError for input that it cannot use."""

    @property
    def name(self) -> str: ...

    def input_sizes(self, config: Mapping[str, Any]) -> list[int]: ...

    def output_sizes(self, config: Mapping[str, Any]) -> list[int]: ...

    def evaluate(self, inputs: Vectors, config: Mapping[str, Any]) -> Vectors: ...


class Refused(Exception):
    """Error with which a server answers an evaluation; it carries the message of the model."""


@dataclass(frozen=True)
class Client:
    """A model behind a URL: ``http://HOST:PORT``, with ``#NAME`` where the server has several models."""

    url: str

    def name(self) -> str:
        """Returns the name of the model: the name in the URL, or the only model of the server.

        Raises InputError where the server does not have this model, or where the URL names none of several
        models. Raises Unavailable where no server answers.
        """
        models = self._request("GET", "/Info", None).get("models")
        wanted = urlsplit(self.url).fragment
        if not isinstance(models, list) or not models:
            raise InputError(self.url, "the server has no models", REMEDY)
        if wanted and wanted not in models:
            raise InputError(
                self.url, f"the server has no model {wanted!r}", f"use one of {', '.join(map(str, models))}"
            )
        if not wanted and len(models) > 1:
            raise InputError(
                self.url,
                "the server has several models",
                f"write #NAME after the URL, with one of {', '.join(models)}",
            )
        return wanted or str(models[0])

    def sizes(self, name: str, which: str, config: Mapping[str, Any]) -> list[int]:
        """Returns the lengths of the model's vectors; `which` is "input" or "output"."""
        answer = self._request("POST", f"/{which.capitalize()}Sizes", {"name": name, "config": config})
        sizes = answer.get(f"{which}Sizes")
        if not isinstance(sizes, list) or not all(isinstance(size, int) for size in sizes):
            raise InputError(
                self.url, f"the server states the {which} sizes {sizes!r}", "it must state a list of lengths"
            )
        return sizes

    def evaluate(self, name: str, inputs: Vectors, config: Mapping[str, Any]) -> list[float]:
        """Returns all output vectors as one list.

        The call has no time limit, since a model may need hours. Raises Refused where the model fails, and
        InputError where the answer has no numbers.
        """
        answer = self._request("POST", "/Evaluate", {"name": name, "input": inputs, "config": config})
        try:
            return [float(value) for vector in answer["output"] for value in vector]
        except (KeyError, TypeError, ValueError):
            raise InputError(self.url, "the answer contains no vectors of numbers", REMEDY) from None

    def _request(self, method: str, path: str, content: Mapping[str, Any] | None) -> dict[str, Any]:
        parts = _checked_url(self.url)
        connect = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = connect(parts.hostname or "", parts.port, timeout=CONNECT_S)
        body = None if content is None else json.dumps(content).encode()
        try:
            connection.connect()
            connection.sock.settimeout(None if path == "/Evaluate" else CONNECT_S)
            headers = {"Content-Type": "application/json"}
            connection.request(method, parts.path.rstrip("/") + path, body, headers)
            text = connection.getresponse().read()
        except (OSError, http.client.HTTPException) as error:
            raise Unavailable(
                self.url, f"no server answers ({error or type(error).__name__})", REMEDY
            ) from None
        finally:
            connection.close()
        return parsed_answer(self.url, text)


def _checked_url(url: str) -> Any:
    try:
        parts = urlsplit(url)
        fits = parts.scheme in ("http", "https") and parts.hostname and (parts.port or True)
    except ValueError:  # the port is not a number
        fits = False
    if not fits:
        raise InputError(
            url, "this is not a valid address", "write http://HOST:PORT or http://HOST:PORT#NAME"
        )
    return parts


def parsed_answer(url: str, text: bytes) -> dict[str, Any]:
    """Returns the JSON object with which a server answers.

    Raises Refused where the server reports an error, and InputError where the text is no JSON object.
    """
    try:
        answer = json.loads(text)
    except (ValueError, RecursionError):
        answer = None
    if not isinstance(answer, dict):
        raise InputError(url, f"the answer is {text[:40]!r}", REMEDY)
    if "error" in answer:
        error = answer["error"]
        raise Refused(str(error.get("message", error)) if isinstance(error, dict) else str(error))
    return answer


def server(model: Model, host: str, port: int) -> ThreadingHTTPServer:
    """Returns a server that listens already. It answers once `serve_forever` is called.

    It runs one evaluation at a time. Raises InputError where the address cannot be used.
    """
    handler = type("Handler", (_Handler,), {"model": model, "busy": threading.Lock()})
    try:
        return _Server((host, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"{host}:{port}",
            f"a server cannot listen there ({error})",
            "use an address of this machine and a free port",
        ) from None


class _Server(ThreadingHTTPServer):
    def server_bind(self) -> None:
        """Binds as a TCP server. An HTTP server would ask the network for a name, which can take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignores a client that has left before its answer, since the server has made no error."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Handles the requests of the protocol that a model without derivatives can answer."""

    model: Model
    busy: threading.Lock
    timeout = 60  # seconds after which a client that sends nothing is dropped

    def do_GET(self) -> None:
        if self.path == "/Info":
            self._send(200, {"protocolVersion": VERSION, "models": [self.model.name]})
        else:
            self._refuse(404, "UnsupportedFeature", f"no such path: {self.path}")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not (length.isdecimal() and len(length) < 20 and int(length) <= MOST_BYTES):
            self.close_connection = True  # the rest of this request could be mistaken for the next one
            self._refuse(
                400, "InvalidInput", f"Content-Length is {length!r:.40}; it must be at most {MOST_BYTES}"
            )
            return
        body = self.rfile.read(int(length))
        try:
            answer = self._answer(self.path, self._parsed(body))
        except (InputError, Refused) as error:
            self._refuse(400, "InvalidInput", str(error))
        except Exception as error:  # the model failed: report it to the client and keep the server running
            self._refuse(500, "ModelError", f"{type(error).__name__}: {error}")
        else:
            self._send(200, answer)

    def _parsed(self, body: bytes) -> dict[str, Any]:
        try:
            request = json.loads(body)
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict) or not isinstance(request.get("config", {}), dict):
            raise Refused("the request must be a JSON object, and its config too")
        if request.get("name") != self.model.name:
            raise Refused(f"no model {request.get('name')!r:.60}; the model here is {self.model.name!r}")
        return request

    def _answer(self, path: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        config = asked.get("config", {})
        if path == "/ModelInfo":
            unsupported = dict.fromkeys(("Gradient", "ApplyJacobian", "ApplyHessian"), False)
            return {"support": {"Evaluate": True, **unsupported}}
        if path == "/InputSizes":
            return {"inputSizes": self.model.input_sizes(config)}
        if path == "/OutputSizes":
            return {"outputSizes": self.model.output_sizes(config)}
        if path == "/Evaluate":
            inputs = _vectors(asked.get("input"), self.model.input_sizes(config))
            with self.busy:
                return {"output": self.model.evaluate(inputs, config)}
        raise Refused(f"{path} is not supported")

    def _refuse(self, status: int, kind: str, message: str) -> None:
        self._send(status, {"error": {"type": kind, "message": message}})

    def _send(self, status: int, content: Mapping[str, Any]) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Writes no log, since each request of a sampler would be a line."""


def _vectors(given: Any, sizes: Sequence[int]) -> Vectors:
    """Returns the input vectors. Raises InputError unless they have these sizes and hold finite numbers."""
    fits = isinstance(given, list) and all(isinstance(vector, list) for vector in given)
    if not fits or [len(vector) for vector in given] != list(sizes):
        problem = (
            f"its vectors have the lengths {[len(v) for v in given]}" if fits else "it is no list of lists"
        )
        raise InputError("input", problem, f"the lengths must be {list(sizes)}")
    for value in (value for vector in given for value in vector):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(
                "input", f"{value!r} is not a finite number", "all values must be finite numbers"
            )
    return [[float(value) for value in vector] for vector in given]
