"""Removes a recording with all that belongs to it. A file outside the page's folder is never touched."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import nullcontext

from bayeskin.app.questions import refuse_running
from bayeskin.app.recordings import RecordingFolder
from bayeskin.errors import InputError, reason_of
from bayeskin.workflow.folder import locked


def remove(folder: RecordingFolder, form: Mapping[str, str]) -> None:
    """Removes the folder of a recording: the copy of the dropped file, the configuration and all results.

    Links in the folder are removed, but not what they lead to. The folder is renamed first, so that the list
    never shows a part of a recording.

    form : must have the field "sure" with the value "yes"
    Raises InputError without this confirmation, while a job or a command works in the folder, and where the
    system refuses.
    """
    if form.get("sure") != "yes":
        raise InputError(folder.name, "the removal is not confirmed", "tick the box first")
    refuse_running(folder)
    removed = folder.path.with_name(f".removed-{folder.name}")
    try:
        with locked(folder.run) if folder.run.is_dir() else nullcontext():
            shutil.rmtree(removed, ignore_errors=True)
            folder.path.rename(removed)
        shutil.rmtree(removed)
    except OSError as error:
        problem = f"it cannot be removed ({reason_of(error)})"
        raise InputError(folder.name, problem, f"remove {removed.parent} by hand") from None
