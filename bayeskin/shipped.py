"""Locates the files that come with bayeskin: at the root of a checkout, or inside an installed wheel."""

from __future__ import annotations

from pathlib import Path

from bayeskin.errors import InputError

_PACKAGE = Path(__file__).resolve().parent
_ROOTS = (_PACKAGE / "_shipped", _PACKAGE.parent)


def shipped(name: str) -> Path:
    """Returns the path of a shipped file such as ``"surrogates/demo.h5"``.

    Raises InputError where there is no such file.
    """
    for root in _ROOTS:
        if (root / name).is_file():
            return root / name
    raise InputError(name, "it is not among the files that come with bayeskin", "install bayeskin again")
