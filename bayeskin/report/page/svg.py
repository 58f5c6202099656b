"""Prepares the SVG of a figure for a page that contains other figures."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_HREF = f"{{{_XLINK}}}href"
# These are the elements with which matplotlib draws. Metadata, scripts and everything else that could run or
# fetch something are not among them.
_KNOWN = {f"{{{_SVG}}}{name}" for name in (
    "svg", "g", "defs", "style", "clipPath", "path", "rect", "circle", "ellipse", "line", "polyline",
    "polygon", "use", "image", "text", "tspan", "title", "desc", "linearGradient", "radialGradient", "stop",
    "pattern", "marker", "mask",
)}  # fmt: skip
_URL = re.compile(r"""url\(\s*['"]?#([^)'"]+)['"]?\s*\)""")
_OUTSIDE = re.compile(r"""url\(\s*(?!['"]?#)[^)]*\)|@import[^;]*;?""")

ElementTree.register_namespace("", _SVG)
ElementTree.register_namespace("xlink", _XLINK)


def inline_svg(text: str, prefix: str) -> str:
    """Returns the `<svg>` element of an SVG file, without its own width and height.

    Identifiers and references to them get `prefix`, so that no figure of the page uses parts of another.
    Style rules apply to this figure only. Elements with which matplotlib does not draw (metadata, scripts,
    foreign objects), event handlers, and references to anything outside the file are left out.
    Raises ElementTree.ParseError for text that is not an SVG.
    """
    root = ElementTree.fromstring(text)
    if root.tag != f"{{{_SVG}}}svg":
        raise ElementTree.ParseError(f"{root.tag} is no SVG")
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tail is not None and child.tail.isspace():
                child.tail = None  # removes the indentation of the file
            if child.tag not in _KNOWN:
                parent.remove(child)
    for element in root.iter():
        element.attrib = dict(
            (name, value)
            for name, value in (_safe_attribute(*pair, prefix) for pair in element.items())
            if name
        )
        if element.tag == f"{{{_SVG}}}style" and element.text:
            element.text = _OUTSIDE.sub("", element.text.replace("*{", f"#{prefix} *{{"))
    for name in ("width", "height"):
        root.attrib.pop(name, None)
    root.attrib |= {"id": prefix, "aria-hidden": "true", "focusable": "false"}
    return ElementTree.tostring(root, encoding="unicode")


def _safe_attribute(name: str, value: str, prefix: str) -> tuple[str, str]:
    """Returns name and value of an attribute that is safe in a page, or an empty name for any other."""
    if name.lower().startswith("on"):
        return "", ""
    if name == "id":
        return name, f"{prefix}-{value}"
    if name in ("href", _HREF):
        if value.startswith("#"):
            return name, f"#{prefix}-{value[1:]}"
        return (name, value) if value.startswith("data:image/png;") else ("", "")
    return name, _URL.sub(rf"url(#{prefix}-\1)", _OUTSIDE.sub("none", value))
