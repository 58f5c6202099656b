"""UM-Bridge, the protocol by which models and tools of uncertainty quantification talk: both ends of it.

Seidelmann, L. et al. (2023), UM-Bridge: Uncertainty quantification and modeling bridge, JOSS 8(83), 4748.
JSON over HTTP, version 1.0: a model takes vectors and a configuration, and gives vectors. The standard
library is enough for it. The package `umbridge` has a server too, but one that listens to every network and
opens shared memory by names that a client sends; this one does neither. Tests run both ends against that
package.
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
MOST_BYTES = 64_000_000  # of a request; a protocol of a million corners takes half of it
EXPECTED = "a server that speaks UM-Bridge"

Vectors = list[list[float]]


class Model(Protocol):
    """Requests that a server answers. Each method raises InputError for input that it cannot use."""

    @property
    def name(self) -> str: ...

    def input_sizes(self, config: Mapping[str, Any]) -> list[int]: ...

    def output_sizes(self, config: Mapping[str, Any]) -> list[int]: ...

    def evaluate(self, inputs: Vectors, config: Mapping[str, Any]) -> Vectors: ...


class Refused(Exception):
    """A server's answer to one evaluation: an error of the model, with its message."""


@dataclass(frozen=True)
class Client:
    """A model behind a URL: ``http://HOST:PORT``, and ``#NAME`` where the server has several."""

    url: str

    def name(self) -> str:
        """The model's name: the URL's, or the only one that the server has.

        Raises InputError where it has another, or several, and Unavailable where nobody answers.
        """
        models = self._ask("GET", "/Info", None).get("models")
        asked = urlsplit(self.url).fragment
        if not isinstance(models, list) or not models:
            raise InputError(self.url, "a server without models", EXPECTED)
        if asked and asked not in models:
            raise InputError(self.url, f"no model {asked!r}", f"one of {', '.join(map(str, models))}")
        if not asked and len(models) > 1:
            raise InputError(self.url, "several models", f"#NAME after the URL, one of {', '.join(models)}")
        return asked or str(models[0])

    def sizes(self, name: str, which: str, config: Mapping[str, Any]) -> list[int]:
        """Lengths of the model's vectors; `which` is "input" or "output"."""
        said = self._ask("POST", f"/{which.capitalize()}Sizes", {"name": name, "config": config})
        sizes = said.get(f"{which}Sizes")
        if not isinstance(sizes, list) or not all(isinstance(size, int) for size in sizes):
            raise InputError(self.url, f"{which} sizes {sizes!r}", "a list of lengths")
        return sizes

    def evaluate(self, name: str, inputs: Vectors, config: Mapping[str, Any]) -> list[float]:
        """All output vectors in a row. However long it takes: a model may need hours.

        Raises Refused where the model fails, InputError where the answer has no numbers.
        """
        said = self._ask("POST", "/Evaluate", {"name": name, "input": inputs, "config": config})
        try:
            return [float(value) for vector in said["output"] for value in vector]
        except (KeyError, TypeError, ValueError):
            raise InputError(self.url, "an answer without numbers", "output vectors") from None

    def _ask(self, method: str, path: str, content: Mapping[str, Any] | None) -> dict[str, Any]:
        parts = _checked_url(self.url)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = kind(parts.hostname or "", parts.port, timeout=CONNECT_S)
        body = None if content is None else json.dumps(content).encode()
        try:
            connection.connect()
            connection.sock.settimeout(None if path == "/Evaluate" else CONNECT_S)
            head = {"Content-Type": "application/json"}
            connection.request(method, parts.path.rstrip("/") + path, body, head)
            text = connection.getresponse().read()
        except (OSError, http.client.HTTPException) as error:
            raise Unavailable(self.url, f"no answer ({error or type(error).__name__})", EXPECTED) from None
        finally:
            connection.close()
        return _understood(self.url, text)


def _checked_url(url: str) -> Any:
    expected = "http://HOST:PORT or http://HOST:PORT#NAME"
    try:
        parts = urlsplit(url)
        fits = parts.scheme in ("http", "https") and parts.hostname and (parts.port or True)
    except ValueError:  # of a port that is no number
        fits = False
    if not fits:
        raise InputError(url, "no address of a server", expected)
    return parts


def _understood(url: str, text: bytes) -> dict[str, Any]:
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        raise InputError(url, f"the answer {text[:40]!r}", EXPECTED)
    if "error" in said:
        error = said["error"]
        raise Refused(str(error.get("message", error)) if isinstance(error, dict) else str(error))
    return said


def server(model: Model, host: str, port: int) -> ThreadingHTTPServer:
    """A server that listens already and answers from `serve_forever` on; one evaluation at a time.

    Raises InputError where the address cannot be had.
    """
    handler = type("Handler", (_Handler,), {"model": model, "busy": threading.Lock()})
    try:
        return _Server((host, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(f"{host}:{port}", str(error), "an address of this machine, a free port") from None


class _Server(ThreadingHTTPServer):
    def server_bind(self) -> None:
        """Binds as any TCP server does; HTTP's asks the network for a name, which can take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing where a client has left before its answer: that is no fault of the server's."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """The requests of the protocol that a model without derivatives answers."""

    model: Model
    busy: threading.Lock
    timeout = 60  # of a client that sends nothing

    def do_GET(self) -> None:
        if self.path == "/Info":
            self._say(200, {"protocolVersion": VERSION, "models": [self.model.name]})
        else:
            self._refuse(404, "UnsupportedFeature", f"no {self.path}")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not (length.isdecimal() and len(length) < 20 and int(length) <= MOST_BYTES):
            self.close_connection = True  # what follows cannot be told from the next request
            self._refuse(400, "InvalidInput", f"Content-Length {length!r:.40}; expected at most {MOST_BYTES}")
            return
        body = self.rfile.read(int(length))
        try:
            answer = self._answer(self.path, self._understood(body))
        except (InputError, Refused) as error:
            self._refuse(400, "InvalidInput", str(error))
        except Exception as error:  # of the model: the client is told, and the server stays
            self._refuse(500, "ModelError", f"{type(error).__name__}: {error}")
        else:
            self._say(200, answer)

    def _understood(self, body: bytes) -> dict[str, Any]:
        try:
            asked = json.loads(body)
        except (ValueError, RecursionError):
            asked = None
        if not isinstance(asked, dict) or not isinstance(asked.get("config", {}), dict):
            raise Refused("the request is no JSON object with a config that is one")
        if asked.get("name") != self.model.name:
            raise Refused(f"no model {asked.get('name')!r:.60}; there is {self.model.name!r}")
        return asked

    def _answer(self, path: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        config = asked.get("config", {})
        if path == "/ModelInfo":
            without = dict.fromkeys(("Gradient", "ApplyJacobian", "ApplyHessian"), False)
            return {"support": {"Evaluate": True, **without}}
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
        self._say(status, {"error": {"type": kind, "message": message}})

    def _say(self, status: int, content: Mapping[str, Any]) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing: each request of a sampler would be a line."""


def _vectors(given: Any, sizes: Sequence[int]) -> Vectors:
    """The input vectors, checked. Raises InputError unless they are finite numbers of the right count."""
    fits = isinstance(given, list) and all(isinstance(vector, list) for vector in given)
    if not fits or [len(vector) for vector in given] != list(sizes):
        found = [len(vector) for vector in given] if fits else type(given).__name__
        raise InputError("input", f"vectors of lengths {found}", f"lengths {list(sizes)}")
    for value in (value for vector in given for value in vector):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError("input", repr(value), "finite numbers")
    return [[float(value) for value in vector] for vector in given]
