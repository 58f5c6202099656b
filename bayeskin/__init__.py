"""Bayesian inference of the material parameters of living skin from extensometer tests.

The package estimates the parameters with their uncertainty, and finds the physics that the model leaves out.
The functions in `__all__` are for scripts; the command line is in `bayeskin.cli`.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayeskin.compiled_code import keep_compiled_code

if TYPE_CHECKING:
    from bayeskin.scripting import calibrate, check, diagnose, load_recording, simulate

_home, _temporary = Path(os.path.expanduser("~")), Path(tempfile.gettempdir())
if _folder := keep_compiled_code(Path(__file__).parent, _home, _temporary):
    print(f"bayeskin: compiled code is kept in {_folder}; no usual folder is writable", file=sys.stderr)

__version__ = "0.1.0"
__all__ = ["calibrate", "check", "diagnose", "load_recording", "simulate"]


def __getattr__(name: str) -> Any:
    """Returns a function of `bayeskin.scripting`, which is imported only when it is asked for.

    Worker processes import this package too, and need none of these functions.
    """
    if name in __all__:
        from bayeskin import scripting

        return getattr(scripting, name)
    raise AttributeError(f"module 'bayeskin' has no attribute {name!r}")
