"""Answers the requests of the page. Everything that changes a recording is a POST."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route

from bayeskin.app import devices, jobs, pages, questions, reading
from bayeskin.app.access import COOKIE, ENTRANCE, Access
from bayeskin.app.downloads import packed
from bayeskin.app.recordings import RecordingFolder, Recordings
from bayeskin.app.removal import remove
from bayeskin.app.uploads import receive
from bayeskin.errors import InputError
from bayeskin.report.page.render import page_asset

MOST_FORM_BYTES = 100_000
# A report runs in an origin of its own, so that its script could reach nothing of the page.
REPORT_POLICY = (
    "sandbox allow-scripts allow-modals; default-src 'none'; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
)
Change = Callable[[RecordingFolder, dict[str, str]], str]


@dataclass
class Routes:
    """The functions that answer requests; one change of the recordings is made at a time."""

    access: Access
    recordings: Recordings
    _changing: Lock = field(default_factory=Lock)

    def app(self) -> Starlette:
        """Returns the application with all its paths."""
        at = "/recordings/{name}"
        routes = [
            Route(ENTRANCE, self.enter),
            Route("/", self.list),
            Route("/style.css", self.style),
            Route("/page.js", self.page_script),
            Route("/app.js", self.app_script),
            Route("/upload", self.upload, methods=["POST"]),
            Route("/compare", self.compare),
            Route(at, self.recording),
            Route(f"{at}/reading", self.read, methods=["POST"]),
            Route(f"{at}/device", self.state_device, methods=["POST"]),
            Route(f"{at}/ask/{{question}}", self.ask, methods=["POST"]),
            Route(f"{at}/stop", self.stop, methods=["POST"]),
            Route(f"{at}/remove", self.remove, methods=["POST"]),
            Route(f"{at}/job", self.job),
            Route(f"{at}/report", self.report),
            Route(f"{at}/download", self.download),
        ]
        handlers = {InputError: self.refused, HTTPException: self.refused}
        return Starlette(routes=[Mount(self.access.root, routes=routes)], exception_handlers=handlers)

    def enter(self, request: Request) -> Response:
        """Sets the cookie for whoever has the link.

        The answer leads on by itself. A redirect would not do, because browsers send a strict cookie only
        with requests that the page itself has begun.
        """
        if not self.access.opens(request.query_params.get("token", "")):
            return PlainTextResponse("This link is not valid, or no longer.", status_code=403)
        response = HTMLResponse(pages.render("enter.html", self.access.root))
        response.set_cookie(
            COOKIE, self.access.session, path=f"{self.access.root}/", httponly=True, samesite="strict"
        )
        return response

    def list(self, request: Request) -> Response:
        """Shows all recordings."""
        return HTMLResponse(pages.recordings_page(self.access.root, self.recordings))

    def style(self, request: Request) -> Response:
        """Returns the style: that of reports, and what only this page has."""
        own = (pages.HERE / "static" / "app.css").read_text(encoding="utf-8")
        return Response(f"{page_asset('page.css')}\n{own}", media_type="text/css")

    def page_script(self, request: Request) -> Response:
        """Returns the script of reports, which sorts tables and reads charts."""
        return Response(page_asset("page.js"), media_type="text/javascript")

    def app_script(self, request: Request) -> Response:
        """Returns the script of this page."""
        own = (pages.HERE / "static" / "app.js").read_text(encoding="utf-8")
        return Response(own, media_type="text/javascript")

    async def upload(self, request: Request) -> Response:
        """Receives a dropped file, and names the page of its recording."""
        try:
            folder = await receive(self.recordings, request.query_params.get("name", ""), request.stream())
        except InputError as error:
            return JSONResponse({"error": str(error)}, status_code=400)
        except ClientDisconnect:
            return Response(status_code=400)
        return JSONResponse({"at": f"{self.access.root}/recordings/{folder.name}"})

    def compare(self, request: Request) -> Response:
        """Compares the runs of the chosen recordings."""
        folders = [self._named(name) for name in dict.fromkeys(request.query_params.getlist("recording"))]
        return HTMLResponse(pages.comparison_page(self.access.root, folders))

    def recording(self, request: Request) -> Response:
        """Shows one recording."""
        return HTMLResponse(pages.recording_page(self.access.root, self.recordings, self._folder(request)))

    async def read(self, request: Request) -> Response:
        """Reads a recording again as a person states it."""

        def change(folder: RecordingFolder, form: dict[str, str]) -> str:
            questions.refuse_running(folder)
            reading.read_as(folder, reading.Choice.from_form(form))
            return f"{_at(folder)}#read"

        return await self._changed(request, "reading", change)

    async def state_device(self, request: Request) -> Response:
        """Takes the device of a form, or that of another recording."""

        def change(folder: RecordingFolder, form: dict[str, str]) -> str:
            questions.refuse_running(folder)
            if "as" in form:
                devices.state_as(folder, self._named(form["as"]))
            else:
                devices.state(folder, devices.from_form(form))
            return f"{_at(folder)}#ask"

        return await self._changed(request, "device", change)

    async def ask(self, request: Request) -> Response:
        """Starts a job, or goes on with it, and shows it."""

        def change(folder: RecordingFolder, form: dict[str, str]) -> str:
            questions.ask(folder, request.path_params["question"])
            return f"{_at(folder)}/job"

        return await self._changed(request, "ask", change)

    async def stop(self, request: Request) -> Response:
        """Stops a job, and shows it."""

        def change(folder: RecordingFolder, form: dict[str, str]) -> str:
            jobs.stop(folder.job)
            return f"{_at(folder)}/job"

        return await self._changed(request, "ask", change)

    async def remove(self, request: Request) -> Response:
        """Removes a recording, and shows the others."""

        def change(folder: RecordingFolder, form: dict[str, str]) -> str:
            remove(folder, form)
            return "/"

        return await self._changed(request, "remove", change)

    def job(self, request: Request) -> Response:
        """Shows the last job of a recording."""
        folder = self._folder(request)
        job = jobs.job_of(folder.job)
        if job is None or job.question not in questions.QUESTIONS:
            raise HTTPException(404)
        return HTMLResponse(pages.job_page(self.access.root, self.recordings, folder, job))

    def report(self, request: Request) -> Response:
        """Shows the report of a recording's run."""
        file = self._folder(request).report
        if not file.is_file():
            raise HTTPException(404)
        return FileResponse(file, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})

    def download(self, request: Request) -> Response:
        """Sends everything that belongs to a recording as one archive."""
        folder = self._folder(request)
        headers = {"Content-Disposition": f'attachment; filename="{folder.name}.zip"'}
        return StreamingResponse(packed(folder.path), media_type="application/zip", headers=headers)

    def refused(self, request: Request, error: Exception) -> Response:
        """Shows an error in one line."""
        code = error.status_code if isinstance(error, HTTPException) else 400
        text = "There is no such page." if code == 404 else str(error)
        return HTMLResponse(pages.render("refused.html", self.access.root, text=text), status_code=code)

    def _folder(self, request: Request) -> RecordingFolder:
        return self._named(request.path_params["name"])

    def _named(self, name: str) -> RecordingFolder:
        """Returns the folder of a recording. Raises HTTPException where there is none of this name."""
        folder = self.recordings.named(name)
        if folder is None:
            raise HTTPException(404)
        return folder

    async def _changed(self, request: Request, part: str, change: Change) -> Response:
        """Makes a change of a recording, and leads on to the path that it returns.

        A wrong input is shown in a `part` of the recording's page, and changes nothing.
        """
        folder, form = self._folder(request), await _form(request)

        def answer() -> Response:
            with self._changing:
                try:
                    at = change(folder, form)
                except InputError as error:
                    problems = {part: str(error)}
                    text = pages.recording_page(self.access.root, self.recordings, folder, problems)
                    return HTMLResponse(text, status_code=400)
            return RedirectResponse(f"{self.access.root}{at}", status_code=303)

        return await run_in_threadpool(answer)


def _at(folder: RecordingFolder) -> str:
    """Returns the path of a recording's page, below the page's root."""
    return f"/recordings/{folder.name}"


async def _form(request: Request) -> dict[str, str]:
    """Returns the fields of a form. Raises HTTPException for one that is too large or no text."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_FORM_BYTES:
            raise HTTPException(413, "The form is too large.")
    try:
        return dict(parse_qsl(body.decode(), keep_blank_values=True, max_num_fields=100))
    except ValueError:
        raise HTTPException(400, "The form is not text.") from None
