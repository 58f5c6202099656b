"""A browser without a window, told what to do over its DevTools pipe: no package is needed for it."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome", "chrome")
PATIENCE_S = 60.0


def opened_browser(profile: Path) -> Browser:
    """Starts the browser that the PATH has; skips the test if there is none."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the PATH")
    return Browser(program, profile)


class Browser:
    """One page of a browser; `complaints` is what its console has had to say."""

    def __init__(self, program: str, profile: Path) -> None:
        self._ours, theirs_out = os.pipe()
        theirs_in, self._told = os.pipe()
        # The browser reads its file 3 and writes its file 4.
        shell = f'exec "$0" "$@" 3<&{theirs_in} 4>&{theirs_out}'
        switches = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                    "--remote-debugging-pipe", f"--user-data-dir={profile}")  # fmt: skip
        self._process = subprocess.Popen(
            ["bash", "-c", shell, program, *switches], pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for end in (theirs_in, theirs_out):
            os.close(end)
        os.set_blocking(self._ours, False)
        self._heard, self._count, self._session = b"", 0, ""
        self.events: list[dict[str, Any]] = []
        target = self.tell("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.tell("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Audits"):
            self.tell(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: BaseException | TracebackType | None) -> None:
        self._process.kill()
        self._process.wait()
        for end in (self._ours, self._told):
            os.close(end)

    def tell(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Calls a method of the DevTools protocol and waits for what it returns."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._told, json.dumps(message).encode() + b"\0")
        while True:
            said = self._next()
            if said.get("id") == self._count:
                assert "error" not in said, said["error"]
                return dict(said["result"])
            self.events.append(said)

    def open(self, page: Path, width: int, scheme: str = "light") -> None:
        """Opens a file as wide as a screen and in a colour scheme, and waits until it is loaded."""
        self.look(width, scheme)
        self.events.clear()
        self.tell("Page.navigate", url=page.as_uri())
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())

    def look(self, width: int, scheme: str = "light", medium: str = "", height: int = 800) -> None:
        scale = {"deviceScaleFactor": 1, "mobile": width < 600}
        self.tell("Emulation.setDeviceMetricsOverride", width=width, height=height, **scale)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.tell("Emulation.setEmulatedMedia", media=medium, features=features)

    def ask(self, expression: str) -> Any:
        """Returns the value of JavaScript in the page; of a promise, the value that it settles at."""
        said = self.tell(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True, userGesture=True
        )
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.tell("Input.dispatchKeyEvent", type=kind, key=key)

    def point(self, selector: str, share: float) -> None:
        """Moves the pointer over an element, to a share of its width and half of its height."""
        self.ask(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})")
        box = self.ask(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")
        x, y = box["x"] + share * box["width"], box["y"] + 0.5 * box["height"]
        self.tell("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def click(self, selector: str) -> None:
        """A real click on the middle of an element."""
        self.point(selector, 0.5)
        box = self.ask(f"document.querySelector({json.dumps(selector)}).getBoundingClientRect().toJSON()")
        place = {"x": box["x"] + 0.5 * box["width"], "y": box["y"] + 0.5 * box["height"]}
        for kind in ("mousePressed", "mouseReleased"):
            self.tell("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)

    def picture(self) -> bytes:
        """PNG of the whole page."""
        said = self.tell("Page.captureScreenshot", captureBeyondViewport=True)
        return base64.b64decode(said["data"])

    def paper(self) -> bytes:
        """PDF as it would be printed."""
        return base64.b64decode(self.tell("Page.printToPDF", printBackground=True)["data"])

    @property
    def complaints(self) -> list[str]:
        """Uncaught errors, errors and warnings of the console, and breaches of the page's own policy."""
        self.ask("0")  # what was said before this answer has been heard
        told = []
        for event in self.events:
            said = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown":
                    told.append(str(said["exceptionDetails"]))
                case "Runtime.consoleAPICalled" if said["type"] in ("error", "warning", "assert"):
                    told.append(str(said["args"]))
                case "Log.entryAdded" if said["entry"]["level"] in ("error", "warning"):
                    told.append(str(said["entry"]["text"]))
                case "Audits.issueAdded" if said["issue"]["code"] == "ContentSecurityPolicyIssue":
                    told.append(str(said["issue"]["details"]))
        return told

    def _next(self) -> dict[str, Any]:
        until = time.monotonic() + PATIENCE_S
        while b"\0" not in self._heard:
            try:
                heard = os.read(self._ours, 1 << 20)
            except BlockingIOError:
                heard = None
                time.sleep(0.01)
            assert heard != b"", "the browser is gone"
            assert time.monotonic() < until, f"the browser has said nothing for {PATIENCE_S:g} s"
            self._heard += heard or b""
        message, _, self._heard = self._heard.partition(b"\0")
        return dict(json.loads(message))
