"""Prints the answers of commands, and turns an answer that cannot be trusted into exit code 1."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

import click

from bayeskin.cli.options import json_option
from bayeskin.cli.terminal import NOT_TRUSTED


def answered(function: Callable[..., Mapping[str, Any]]) -> Callable[..., None]:
    """Returns a function with the option --json that prints the answer which `function` returns."""

    @json_option
    @wraps(function)
    def command(as_json: bool, **options: Any) -> None:
        print_answer(function(**options), as_json)

    return command


def print_answer(document: Mapping[str, Any], as_json: bool) -> None:
    """Prints the answer of a command as JSON or text; exits with code 1 where its ``ok`` is False."""
    try:
        click.echo(json.dumps(document, indent=2, allow_nan=False) if as_json else document["text"])
        sys.stdout.flush()
    except BrokenPipeError:  # the reading program ended early, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not document["ok"]:
        raise click.exceptions.Exit(NOT_TRUSTED)
