"""A figure's SVG made fit to stand inside a page among others."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_HREF = f"{{{_XLINK}}}href"
_LEFT_OUT = {f"{{{_SVG}}}metadata", f"{{{_SVG}}}script"}
_URL = re.compile(r"""url\(\s*['"]?#([^)'"]+)['"]?\s*\)""")
_OUTSIDE = re.compile(r"""url\(\s*(?!['"]?#)[^)]*\)|@import[^;]*;?""")

ElementTree.register_namespace("", _SVG)
ElementTree.register_namespace("xlink", _XLINK)


def inline_svg(text: str, prefix: str) -> str:
    """The `<svg>` element of an SVG file, as wide as it is given room.

    Identifiers, and what refers to them, get `prefix`, so that figures of one page do not take each other's
    parts. Style rules hold inside this figure only. Metadata, scripts, event handlers and references to
    anything outside of the file are left out. Raises ElementTree.ParseError for text that is no XML.
    """
    root = ElementTree.fromstring(text)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tail is not None and child.tail.isspace():
                child.tail = None  # the file's indentation
            if child.tag in _LEFT_OUT:
                parent.remove(child)
    for element in root.iter():
        element.attrib = dict(
            (name, value) for name, value in (_kept(*pair, prefix) for pair in element.items()) if name
        )
        if element.tag == f"{{{_SVG}}}style" and element.text:
            element.text = _OUTSIDE.sub("", element.text.replace("*{", f"#{prefix} *{{"))
    for name in ("width", "height"):
        root.attrib.pop(name, None)
    root.attrib |= {"id": prefix, "aria-hidden": "true", "focusable": "false"}
    return ElementTree.tostring(root, encoding="unicode")


def _kept(name: str, value: str, prefix: str) -> tuple[str, str]:
    """An attribute as it may stand in a page; an empty name for one that may not."""
    if name.lower().startswith("on"):
        return "", ""
    if name == "id":
        return name, f"{prefix}-{value}"
    if name in ("href", _HREF):
        if value.startswith("#"):
            return name, f"#{prefix}-{value[1:]}"
        return (name, value) if value.startswith("data:image/png;") else ("", "")
    return name, _URL.sub(rf"url(#{prefix}-\1)", _OUTSIDE.sub("none", value))
