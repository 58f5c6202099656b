"""Decides who may use the page: only a browser that has opened the link which the command printed.

The page can be reached by every user and every program of the machine, and by every site that is open in the
same browser. The following facts keep all of them out:

- The server listens on a loopback address only, and answers only requests whose Host is this address. A
  foreign name that is made to point to this machine (DNS rebinding) is therefore refused.
- The link contains a random token. It sets a cookie with another random value, which scripts cannot read and
  which a browser does not send along with requests of other sites.
- Browsers send cookies to every port of a host. The cookie is therefore bound to a random path, so that a
  server of another user, on another port of this machine, never receives it.
- A request that changes anything must state the page itself as its Origin.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from hmac import compare_digest

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HOST = "127.0.0.1"
COOKIE = "bayeskin"
ENTRANCE = "/enter"
_BYTES = 32  # of each random value
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",  # with "no-referrer", forms would state no Origin
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def _random() -> str:
    return secrets.token_urlsafe(_BYTES)


@dataclass(frozen=True)
class Access:
    """The random values of one start of the page, and its port.

    key : the first part of every path; token : is in the link; session : the value of the cookie
    """

    port: int
    key: str = field(default_factory=_random, repr=False)
    token: str = field(default_factory=_random, repr=False)
    session: str = field(default_factory=_random, repr=False)

    @property
    def root(self) -> str:
        """Returns the path below which all pages lie."""
        return f"/{self.key}"

    @property
    def link(self) -> str:
        """Returns the link that opens the page."""
        return f"http://{HOST}:{self.port}{self.root}{ENTRANCE}?token={self.token}"

    def refusal(self, method: str, path: str, headers: Mapping[str, str], cookie: str) -> str:
        """Returns why a request is refused, or "" for a request that may pass.

        A request for the entrance passes without a cookie; its token is checked by `opens`.
        """
        hosts = {f"{HOST}:{self.port}", f"localhost:{self.port}"}
        host = headers.get("host", "")
        if host not in hosts:
            return "This address does not belong to the page."
        inside = path.startswith(f"{self.root}/")
        if method == "GET" and inside and path == self.root + ENTRANCE:
            return ""
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "The request comes from another site."
        if method not in ("GET", "HEAD") and headers.get("origin") != f"http://{host}":
            return "The request comes from another site."
        if not inside or not compare_digest(cookie.encode(), self.session.encode()):
            return "Open the link that `bayeskin app` printed when it was started."
        return ""

    def opens(self, token: str) -> bool:
        """Returns whether a token is that of the link."""
        return compare_digest(token.encode(), self.token.encode())


class Guard:
    """Passes only permitted requests on to the page, and adds headers of protection to every answer."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app, self.access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one request."""
        if scope["type"] != "http":
            return  # a web socket is closed

        async def protected(message: Message) -> None:
            """Adds the headers that an answer does not set itself."""
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        request = Request(scope)
        cookie = request.cookies.get(COOKIE, "")
        refusal = self.access.refusal(request.method, scope["path"], request.headers, cookie)
        answer = PlainTextResponse(refusal, status_code=403) if refusal else self.app
        await answer(scope, receive, protected)
