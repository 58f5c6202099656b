"""The page in a browser: from a dropped file to the report, in light, in dark and on a phone's width."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from toys.app_page import served, until
from toys.browser import Browser
from toys.external_models import PARAMETERS

from bayeskin.app.server import Page

# Each run takes a while, until a file says that runs are to fail. A design that fails ends with a report.
MODEL = """
import time
from pathlib import Path

def force(theta, time_s, displacement_m):
    if Path("fail").exists():
        raise ValueError("no skin")
    time.sleep(0.3)
    return theta["stiffness"] * displacement_m
"""
SETTINGS = """
[model]
forward = "model.py:force"
[fit]
bin_width_s = 1.0
[design]
points = [40]
held_out = 8
workers = 1
"""
WIDE = "document.documentElement.scrollWidth"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page, without recordings."""
    with served(tmp_path_factory.mktemp("app") / "recordings") as page:
        yield page


@pytest.fixture(scope="module")
def entered(shown: Browser, page: Page) -> Browser:
    """The browser, after it has opened the link."""
    shown.look(1280)
    shown.tell("Page.navigate", url=page.access.link)
    until(lambda: at(shown) == f"{page.access.root}/")
    assert page.access.token not in shown.ask("location.href")
    return shown


def at(browser: Browser) -> str:
    """The path at which the browser has arrived, or "" while it is on its way."""
    try:
        return str(browser.ask("document.readyState === 'complete' ? location.pathname : ''"))
    except AssertionError:  # the page is just being left
        return ""


def drop(browser: Browser, file: Path) -> None:
    """Drags a file onto the page and lets it go, as with the pointer."""
    dragged = {"items": [], "files": [str(file)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        browser.tell("Input.dispatchDragEvent", type=kind, x=400, y=200, data=dragged)


def choose(browser: Browser, file: Path) -> None:
    """Chooses a file, as in the dialog of the browser."""
    document = browser.tell("DOM.getDocument")["root"]["nodeId"]
    node = browser.tell("DOM.querySelector", nodeId=document, selector=".drop input")["nodeId"]
    browser.tell("DOM.setFileInputFiles", files=[str(file)], nodeId=node)


def text(browser: Browser, selector: str) -> str:
    """The text of an element, or "" if there is none."""
    try:
        return str(browser.ask(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''"))
    except AssertionError:
        return ""


def fits(browser: Browser) -> None:
    """The page fits a wide screen and a phone, in light and dark, and the browser has no complaint."""
    for width, scheme in ((1280, "light"), (390, "light"), (390, "dark"), (1280, "dark")):
        browser.look(width, scheme)
        browser.ask("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        assert browser.ask(WIDE) <= width, (at(browser), width)
        colors = [
            browser.ask(f"getComputedStyle(document.body).{name}.match(/\\d+/g).map(Number)[0]")
            for name in ("color", "backgroundColor")
        ]
        assert (colors[0] < colors[1]) == (scheme == "light")
    browser.look(1280)
    assert browser.complaints == []


def test_from_a_dropped_file_to_the_report(entered: Browser, page: Page, measured: Path) -> None:
    root, folder = page.access.root, page.folder / "measured"
    fits(entered)
    drop(entered, measured)
    until(lambda: at(entered) == f"{root}/recordings/measured")
    fits(entered)
    entered.point("#force", 0.3)
    assert "hold" in text(entered, "#read .chart:has(#force) .read-out")

    entered.click("form[action$='/device'] button")
    until(lambda: "The device is stated" in text(entered, "#device"))
    config = f'[recording]\nfile = "measured.h5"\n{SETTINGS}{PARAMETERS}'
    (folder / "measured.toml").write_text(config)
    (folder / "model.py").write_text(MODEL)
    entered.click("form[action$='/ask/calibrate'] button")
    until(lambda: at(entered).endswith("/job"))
    until(lambda: "left" in text(entered, "#now .task"))
    assert "of 48 runs" in text(entered, "#now .task")
    fits(entered)

    entered.click("form[action$='/stop'] button")
    until(lambda: text(entered, "#job .word") == "stopped")
    (folder / "fail").touch()
    entered.click("form[action$='/ask/calibrate'] button")
    until(lambda: text(entered, "#job .word") == "failed")
    fits(entered)

    report = entered.ask("document.querySelector('a[href$=\"/report\"]').href")
    entered.tell("Page.navigate", url=report)
    until(lambda: at(entered).endswith("/report"))
    assert text(entered, "h1") == "What is this skin made of?"
    assert entered.ask("self.origin") == "null"  # it can reach nothing of the page
    assert entered.complaints == []


def test_the_link_works_wherever_it_is_clicked(shown: Browser, page: Page, tmp_path: Path) -> None:
    (tmp_path / "letter.html").write_text(f'<a href="{page.access.link}">the page</a>')
    shown.tell("Page.navigate", url=(tmp_path / "letter.html").as_uri())
    until(lambda: text(shown, "a") == "the page")
    shown.click("a")
    until(lambda: at(shown) == f"{page.access.root}/")
    assert "Drop a recording here" in text(shown, "main")


def test_a_broken_file_is_refused_on_the_page(entered: Browser, page: Page, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("Dear reader,\nthis is no table.\n")
    entered.tell("Page.navigate", url=f"http://127.0.0.1:{page.access.port}{page.access.root}/")
    until(lambda: at(entered) == f"{page.access.root}/")
    choose(entered, tmp_path / "letter.txt")
    until(lambda: "no rows of numbers" in text(entered, ".drop .problem"))
    entered.events.clear()  # the browser reports the refusal of the request, too


@pytest.fixture
def other_site() -> Iterator[tuple[str, list[str | None]]]:
    """A server of another user on this machine: its address, and the cookies that it gets."""
    cookies: list[str | None] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            cookies.append(self.headers["Cookie"])
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<title>another site</title>")

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}", cookies
        server.shutdown()


def test_another_site_reaches_nothing_even_on_another_port_of_this_machine(
    entered: Browser, page: Page, other_site: tuple[str, list[str | None]]
) -> None:
    address, cookies = other_site
    home = f"http://127.0.0.1:{page.access.port}{page.access.root}"
    entered.tell("Page.navigate", url=f"{address}/")
    until(lambda: entered.ask("document.title") == "another site")
    before = sorted(path.name for path in page.folder.rglob("*"))
    options = "{credentials: 'include', mode: 'no-cors'}"
    posted = "{credentials: 'include', mode: 'no-cors', method: 'POST', body: '1'}"
    for path, how in (("/", options), ("/upload?name=a.csv", posted), ("/recordings/measured/stop", posted)):
        assert (
            entered.ask(f"fetch('{home}{path}', {how}).then(() => 'reached', () => 'refused')") == "refused"
        )
    framed = (
        f"new Promise((done) => {{ const frame = document.createElement('iframe'); frame.src = '{home}/';"
        "frame.onload = () => done(frame.contentDocument === null); document.body.append(frame); })"
    )
    assert entered.ask(framed)
    assert sorted(path.name for path in page.folder.rglob("*")) == before
    assert cookies
    assert set(cookies) == {None}
    entered.events.clear()  # the browser reports what it refused
