"""bayeskin: what living skin is made of, how sure one can be, and what the model leaves out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bayeskin.scripting import calibrate, check, diagnose, load_recording, simulate

__version__ = "0.1.0"
__all__ = ["calibrate", "check", "diagnose", "load_recording", "simulate"]


def __getattr__(name: str) -> Any:
    """The functions of `scripting`, loaded when one is asked for: a worker process needs none of them."""
    if name in __all__:
        from bayeskin import scripting

        return getattr(scripting, name)
    raise AttributeError(f"module 'bayeskin' has no attribute {name!r}")
