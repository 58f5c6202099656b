"""Who may use the page: nobody but the browser that opened the link, whatever else runs on the machine."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Iterator
from pathlib import Path

import pytest
from toys.app_page import Visitor, served
from toys.command_line import Command, assert_refused

from bayeskin.app.server import Page

FORM = b"cutis=2"


@pytest.fixture(scope="module")
def page(measured: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page, with one recording."""
    with served(tmp_path_factory.mktemp("app") / "recordings") as page:
        owner = Visitor(page)
        owner.enter()
        assert owner.drop("arm.csv", measured.read_bytes()).status == 200
        yield page


@pytest.fixture
def owner(page: Page) -> Visitor:
    """Whoever started the page."""
    visitor = Visitor(page)
    visitor.enter()
    return visitor


def test_the_link_lets_its_owner_in(owner: Visitor) -> None:
    assert owner.ask("GET", "/").status == 200
    assert owner.ask("GET", "/recordings/arm").status == 200
    assert owner.fill("/recordings/arm/stop").status == 303


def test_the_cookie_is_for_this_page_alone(page: Page) -> None:
    given = Visitor(page).enter().headers["set-cookie"].lower().split("; ")
    assert {"httponly", "samesite=strict", f"path={page.access.root.lower()}/"} <= set(given)
    assert page.access.session not in page.access.link


def test_another_user_of_the_machine_gets_nothing(page: Page) -> None:
    stranger = Visitor(page)
    root = page.access.root
    for path in ("/", "/recordings/arm", "/style.css", "/app.js", "/recordings/arm/download", "/compare"):
        assert stranger.ask("GET", path).status == 403
    for path in ("/", "/favicon.ico", "/recordings/arm", root, "/x/enter?token=x", f"{root}/enter"):
        assert stranger.ask_for("GET", path).status == 403
    for token in ("", "x", page.access.key, page.access.session, page.access.token[:-1], "é"):
        assert stranger.ask("GET", f"/enter?token={token!a}").status == 403
    for path in ("/upload?name=a.csv", "/recordings/arm/device", "/recordings/arm/ask/calibrate"):
        assert stranger.ask("POST", path, FORM).status == 403
    for cookie in ("x", page.access.token, page.access.key):
        assert Visitor(page, cookie).ask("GET", "/").status == 403


@pytest.mark.parametrize("path", ["/upload?name=a.csv", "/recordings/arm/device", "/recordings/arm/stop"])
@pytest.mark.parametrize(
    "origin", [None, "null", "https://example.com", "http://127.0.0.1:1", "http://localhost", ""]
)
def test_another_site_cannot_change_anything_even_with_the_cookie(
    owner: Visitor, path: str, origin: str | None
) -> None:
    names = sorted(p.name for p in owner.page.folder.rglob("*"))
    assert owner.ask("POST", path, FORM, {"Origin": origin}).status == 403
    assert sorted(p.name for p in owner.page.folder.rglob("*")) == names


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_a_request_that_a_browser_says_another_site_began_is_refused(owner: Visitor, site: str) -> None:
    assert owner.ask("GET", "/", headers={"Sec-Fetch-Site": site}).status == 403
    assert owner.ask("GET", "/", headers={"Sec-Fetch-Site": "same-origin"}).status == 200
    assert owner.ask("GET", "/", headers={"Sec-Fetch-Site": "none"}).status == 200


@pytest.mark.parametrize(
    "host", ["example.com", "example.com:{port}", "127.0.0.1", "127.0.0.1.example.com:{port}", ""]
)
def test_a_name_that_is_made_to_point_to_this_machine_is_refused(owner: Visitor, host: str) -> None:
    named = {"Host": host.format(port=owner.page.access.port)}
    assert owner.ask("GET", "/", headers=named).status == 403
    port = owner.page.access.port
    rebound = {**named, "Origin": f"http://{named['Host']}"}
    assert owner.ask("POST", "/recordings/arm/stop", headers=rebound).status == 403
    link = f"{owner.page.access.root}/enter?token={owner.page.access.token}"
    assert owner.ask_for("GET", link, headers=named).status == 403
    assert owner.ask("GET", "/", headers={"Host": f"localhost:{port}"}).status == 200


@pytest.mark.parametrize(
    "name", ["..", ".", "%2e%2e", "..%2f..%2fetc", "%2fetc", "arm%2f..%2f..", ".arm", "arm%00", "absent"]
)
@pytest.mark.parametrize("page_of", ["", "/job", "/report", "/download"])
def test_no_name_leads_out_of_the_folder(owner: Visitor, name: str, page_of: str) -> None:
    (owner.page.folder.parent / "original").mkdir(exist_ok=True)  # what a recording's folder would have
    assert owner.ask("GET", f"/recordings/{name}{page_of}").status == 404


def test_every_answer_forbids_what_it_does_not_need(owner: Visitor) -> None:
    for path in ("/", "/recordings/arm", "/style.css", "/recordings/absent"):
        headers = owner.ask("GET", path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert headers["x-frame-options"] == "DENY"
        assert headers["cache-control"] == "no-store"
        assert headers["referrer-policy"] == "same-origin"
        assert "access-control-allow-origin" not in headers


def test_the_page_listens_on_loopback_only(page: Page) -> None:
    assert page.listening.getsockname()[0] == "127.0.0.1"


def test_the_link_is_not_among_the_arguments_of_the_browser(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    for _ in range(2):
        page.show()
        file = page.folder / ".open.html"
        assert opened.pop() == file.as_uri()
        assert page.access.link in file.read_text()
        assert file.stat().st_mode & 0o077 == 0


def test_other_users_may_not_look_into_the_folders(page: Page) -> None:
    assert page.folder.stat().st_mode & 0o077 == 0
    assert (page.folder / "arm").stat().st_mode & 0o077 == 0


def test_without_its_packages_or_its_port_the_command_ends_with_one_line(
    bayeskin: Command, page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = bayeskin("app", tmp_path / "recordings", "--port", page.access.port)
    assert_refused(taken, f"127.0.0.1:{page.access.port}: the page cannot listen there", "use a free port")
    (tmp_path / "file").touch()
    assert_refused(bayeskin("app", tmp_path / "file"), "the folder cannot be made")
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "bayeskin.app.server")
    answer = bayeskin("app", tmp_path / "other")
    assert_refused(answer, "app: the package uvicorn is not installed; run `pip install '.[app]'`")
    assert not (tmp_path / "other").exists()
