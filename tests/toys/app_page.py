"""The page of `bayeskin app`, served in this process, and a visitor who speaks plain HTTP to it."""

from __future__ import annotations

import http.client
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from bayeskin.app.server import Page, open_page

# The fields of a device that is not the article's, as a person fills them in.
DEVICE = {
    "gauge": "20", "pad_length": "6", "pad_width": "10", "guard": "no", "guard_gap": "1", "guard_width": "8",
    "force_on": "pad", "cutis": "1,5", "cutis_sd": "0.2", "subcutis": "5", "subcutis_sd": "", "flat": "yes",
    "arm_radius": "", "arm_radius_sd": "",
}  # fmt: skip


@dataclass(frozen=True)
class Answer:
    """The answer to a request."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def text(self) -> str:
        """Returns the body as text."""
        return self.body.decode()


@dataclass
class Visitor:
    """Somebody who sends requests to the page; headers with the value None are left out."""

    page: Page
    cookie: str = ""
    sent: dict[str, str | None] = field(default_factory=dict)

    @property
    def origin(self) -> str:
        """Returns the origin of the page."""
        return f"http://127.0.0.1:{self.page.access.port}"

    def ask(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str | None] | None = None
    ) -> Answer:
        """Sends a request for a path below the page's root."""
        return self.ask_for(method, f"{self.page.access.root}{path}", body, headers)

    def ask_for(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str | None] | None = None
    ) -> Answer:
        """Sends a request for any path, exactly as it is written."""
        port = self.page.access.port
        given = {"Host": f"127.0.0.1:{port}", "Origin": self.origin if method == "POST" else None}
        given |= {
            "Cookie": f"bayeskin={self.cookie}" if self.cookie else None,
            **self.sent,
            **(headers or {}),
        }
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in given.items():
            if value is not None:
                connection.putheader(name, value)
        connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        response = connection.getresponse()
        answer = Answer(response.status, dict(response.headers), response.read())
        connection.close()
        return answer

    def enter(self) -> Answer:
        """Opens the link, and keeps the cookie."""
        parts = urlsplit(self.page.access.link)
        answer = self.ask_for("GET", f"{parts.path}?{parts.query}")
        self.cookie = answer.headers["set-cookie"].partition("=")[2].partition(";")[0]
        return answer

    def drop(self, name: str, data: bytes) -> Answer:
        """Drops a file."""
        return self.ask("POST", f"/upload?{urlencode({'name': name})}", data)

    def fill(self, path: str, **fields: str) -> Answer:
        """Sends a form."""
        return self.ask("POST", path, urlencode(fields).encode())


@contextmanager
def served(folder: Path) -> Iterator[Page]:
    """The page of a folder, as long as the context lasts."""
    page = open_page(folder, 0)
    thread = threading.Thread(target=page.serve)
    thread.start()
    try:
        yield page
    finally:
        page.server.should_exit = True
        thread.join()


def until(true: Callable[[], object], patience_s: float = 60.0) -> None:
    """Waits until a function returns something true."""
    end = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end, f"waited {patience_s:g} s in vain"
        time.sleep(0.05)
