"""The documentation's site: `make docs`. Pages are Markdown; the reference is made from docstrings."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import click
from docutils import nodes
from docutils.parsers.rst import Directive

import bayeskin
from bayeskin.cli import cli

project, author = "bayeskin", "bayeskin authors"
release = version = bayeskin.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
html_theme, html_title = "furo", f"bayeskin {version}"
html_show_sphinx, html_copy_source = False, False
exclude_patterns = ["_build"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike")}


class Commands(Directive):
    """``--help`` of every command, as it is printed."""

    option_spec: ClassVar[dict[str, Any]] = {}

    def run(self) -> list[nodes.Node]:
        found: list[nodes.Node] = []
        for name in cli.list_commands(click.Context(cli)):
            command = cli.commands[name]
            context = click.Context(command, info_name=f"bayeskin {name}", max_content_width=100)
            section = nodes.section(ids=[f"bayeskin-{name}"], names=[f"bayeskin {name}"])
            section += nodes.title(text=f"bayeskin {name}")
            section += nodes.literal_block(text=command.get_help(context), language="none")
            found.append(section)
        return found


def plain_docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: `name` is code, ``name : text`` a term and its meaning."""
    paragraphs = [part for part in "\n".join(lines).strip().split("\n\n") if part]
    lines[:] = [line for paragraph in paragraphs for line in (*_as_rst(paragraph.splitlines()), "")]


def _as_rst(paragraph: list[str]) -> Iterator[str]:
    if len(paragraph) > 1 and set(paragraph[1].strip()) == {"-"}:  # a heading as NumPy's
        yield from (f"**{paragraph[0].strip()}**", "", *_as_rst(paragraph[2:]))
        return
    if all(line.startswith("    ") for line in paragraph):
        yield from ("::", "", *(f"    {line}" for line in paragraph))
        return
    for line in paragraph:
        term = re.match(r"^([A-Za-z_][\w, ]{0,60}?) : (.*)$", line)
        if term:
            yield from ("", f"``{term[1]}``", f"    {_escaped(term[2])}")
        else:
            listed = paragraph[0].startswith("- ") and line.startswith("  ")
            indent = "    " if line.startswith("    ") else "  " if listed else ""
            yield indent + _escaped(line.strip())


def _escaped(text: str) -> str:
    """Code between backticks stays code; nothing else is markup."""
    parts = re.split(r"(``[^`]+``|`[^`]+`)", text)
    return "".join(
        f"``{part.strip('`')}``" if part.startswith("`") else re.sub(r"([\\*_|`<>])", r"\\\1", part)
        for part in parts
    )


def setup(app: Any) -> None:
    app.add_directive("commands", Commands)
    app.connect("autodoc-process-docstring", plain_docstring)
