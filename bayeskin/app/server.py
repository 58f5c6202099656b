"""Opens the page on a loopback port, and serves it until it is interrupted."""

from __future__ import annotations

import os
import socket
import webbrowser
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn

from bayeskin.app.access import HOST, Access, Guard
from bayeskin.app.recordings import open_recordings
from bayeskin.app.routes import Routes
from bayeskin.errors import InputError, reason_of

PATIENCE_S = 3  # for requests that are being answered when the page is closed


@dataclass(frozen=True)
class Page:
    """The page, which listens at its port already."""

    access: Access
    folder: Path
    listening: socket.socket
    server: uvicorn.Server

    @property
    def answer(self) -> dict[str, Any]:
        """Returns the answer of the command."""
        text = (
            f"Open this link in a browser of this computer:\n{self.access.link}\n"
            f"The recordings lie in {self.folder}. Ctrl-C closes the page; jobs that run go on."
        )
        return {"ok": True, "link": self.access.link, "folder": str(self.folder), "text": text}

    def show(self) -> None:
        """Opens the page in the browser, by way of a file that only its owner can read.

        Other users of the machine can see the arguments of a process, so the link is not among them.
        """
        file = self.folder / ".open.html"
        file.unlink(missing_ok=True)
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as handle:
            handle.write(f'<meta http-equiv="refresh" content="0; url={self.access.link}">\n')
        webbrowser.open(file.as_uri())

    def serve(self) -> None:
        """Answers requests until Ctrl-C."""
        with self.listening, suppress(KeyboardInterrupt):
            self.server.run(sockets=[self.listening])


def open_page(folder: Path, port: int) -> Page:
    """Returns the page of the recordings in a folder, which listens at a port of this machine.

    With port 0 it takes a free port. Raises InputError where the folder cannot be made or the
    port cannot be used.
    """
    recordings = open_recordings(folder)
    listening = socket.socket()
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((HOST, port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise InputError(
            f"{HOST}:{port}", f"the page cannot listen there ({reason_of(error)})", "use a free port"
        ) from None
    access = Access(listening.getsockname()[1])
    config = uvicorn.Config(
        Guard(Routes(access, recordings).app(), access), lifespan="off", ws="none", access_log=False,
        log_level="error", server_header=False, proxy_headers=False, timeout_graceful_shutdown=PATIENCE_S,
    )  # fmt: skip
    return Page(access, recordings.root, listening, uvicorn.Server(config))
