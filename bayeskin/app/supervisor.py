"""Runs the commands of one job, one after the other, and writes down how they ended.

It is a process of its own, which holds the job's lock for as long as it lives.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from bayeskin.app.jobs import END, INTERRUPTED, REQUEST
from bayeskin.json_files import write_json


def supervise(folder: Path) -> None:
    """Runs the commands of a job until one of them ends with another exit code than 0, or is interrupted."""
    interrupted = threading.Event()
    # With a handler, this process outlives Ctrl-C, and the commands get the usual behaviour back.
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    commands = json.loads((folder / REQUEST).read_text(encoding="utf-8"))["commands"]
    code = 0
    for command in commands:
        if interrupted.is_set():
            code = INTERRUPTED
        if code != 0:
            break
        code = subprocess.run([sys.executable, "-m", "bayeskin", *command], check=False).returncode
    write_json(folder / END, {"code": code, "ended_s": time.time()})


if __name__ == "__main__":
    supervise(Path(sys.argv[1]))
