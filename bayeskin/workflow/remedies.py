"""Commands that mend an installation, as `bayeskin doctor` names them. They can be copied into a shell."""

from __future__ import annotations

import json
import shlex
import sys
from importlib import metadata
from pathlib import Path
from urllib.parse import unquote, urlparse

import bayeskin
from bayeskin.compiled_code import folder_of_compiled_code

PACKAGE = Path(bayeskin.__file__).parent
WHERE_FROM = "the folder or the wheel from which bayeskin was installed"


def install(requirement: str) -> str:
    """Returns the command that installs a package in a version that suits, such as "numpy>=2.0"."""
    return shlex.join([sys.executable, "-m", "pip", "install", requirement])


def reinstall() -> str:
    """Returns the command that installs bayeskin anew with all its packages."""
    source = _source()
    if source is None:
        return f"{shlex.join([sys.executable, '-m', 'pip', 'install', '--force-reinstall'])} {WHERE_FROM}"
    editable = ["--editable"] if source.is_dir() and source == PACKAGE.parent else []
    return shlex.join([sys.executable, "-m", "pip", "install", "--force-reinstall", *editable, str(source)])


def restore(file: str) -> str:
    """Returns the command that brings back a file that comes with bayeskin."""
    checkout = PACKAGE.parent
    if not (checkout / ".git").exists():
        return reinstall()
    return shlex.join(["git", "-C", str(checkout), "checkout", "--", file])


def compile_anew() -> str:
    """Returns the command that deletes the compiled code, after which the models are compiled anew."""
    folder = folder_of_compiled_code(PACKAGE, Path.home())
    return f"find {shlex.quote(str(folder))} -name '*.nb[ic]' -delete"


def _source() -> Path | None:
    """Returns the checkout or the wheel from which bayeskin was installed, or None where it is not known."""
    if (PACKAGE.parent / "pyproject.toml").is_file():
        return PACKAGE.parent
    try:
        text = metadata.distribution("bayeskin").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return None
    if text is None:
        return None
    path = Path(unquote(urlparse(json.loads(text)["url"]).path))
    return path if path.exists() else None
