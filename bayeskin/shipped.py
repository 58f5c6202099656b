"""Where the files that come with bayeskin lie: at the root of a checkout, inside an installed wheel."""

from __future__ import annotations

from pathlib import Path

from bayeskin.errors import InputError

_PACKAGE = Path(__file__).resolve().parent
_ROOTS = (_PACKAGE / "_shipped", _PACKAGE.parent)


def shipped(name: str) -> Path:
    """Path of a shipped file such as ``"surrogates/demo.h5"``; raises InputError when there is none."""
    for root in _ROOTS:
        if (root / name).is_file():
            return root / name
    raise InputError(name, "no such file among those shipped with bayeskin", "a reinstalled package")
