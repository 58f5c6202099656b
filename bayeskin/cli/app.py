"""The command for people who do not use a terminal: `app`."""

from __future__ import annotations

from pathlib import Path

import click

from bayeskin.cli.answers import print_answer
from bayeskin.cli.options import PATH, json_option
from bayeskin.errors import InputError


@click.command(short_help="Open a page in the browser that needs no terminal.")
@click.argument("folder", default=Path("bayeskin-app"), type=PATH)
@click.option(
    "--port", default=0, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 takes a free one."
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser, too.")
@json_option
def app(folder: Path, port: int, opens: bool, as_json: bool) -> None:
    """Open a page in the browser, for people who do not use a terminal.

    A recording is dropped on the page. The page shows how it was understood, asks for the device, starts a
    calibration or a diagnosis, and shows its progress, its report and comparisons. Everything lies in FOLDER
    (default: bayeskin-app), in one folder for each recording, as the other commands would write it.

    The command prints a link. Only a browser that opens this link can use the page, and only on this
    machine. The link is valid until Ctrl-C. A job goes on when the page is closed. The page needs the
    packages of `pip install '.[app]'`, and no network.

    \b
    Example:
      bayeskin app
      bayeskin app --open
      bayeskin app arms --port 8080
    """
    try:
        from bayeskin.app.server import open_page
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise InputError(
            "app", f"the package {error.name} is not installed", "run `pip install '.[app]'`"
        ) from None
    page = open_page(folder, port)
    print_answer(page.answer, as_json)
    if opens:
        page.show()
    page.serve()
