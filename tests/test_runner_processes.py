"""Worker processes of a design: they end with their parent, and have a thread each."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from toys import unreliable_models
from toys.closed_form_model import SPACE
from toys.design_runs import run

from bayeskin.design import first_wave
from bayeskin.execution.local import local

HERE = Path(__file__).parent


def test_workers_have_one_thread_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    design = run(tmp_path / "a.store", first_wave(SPACE, 1, 0, seed=1), unreliable_models.threads, local(1))
    assert design.messages == ("1,1,1",)
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def interruptible() -> None:
    """A shell that starts its commands in the background has them ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc")
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(tmp_path: Path, ending: signal.Signals) -> None:
    script = (
        "import sys; from functools import partial\n"
        "from toys import unreliable_models as models\n"
        "if __name__ == '__main__':\n"
        "    simulate = partial(models.stuck, folder=sys.argv[1])\n"
        "    with models.Store(models.Path(sys.argv[2]), 'toy') as store:\n"
        "        models.run_design(store, models.WAVE, models.COARSE_S, simulate, 'toy')\n"
    )
    (tmp_path / "program.py").write_text(script)
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path), str(tmp_path / "out" / "a.store")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    program = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=interruptible,
    )  # fmt: skip
    patience = time.monotonic() + 60
    while len(pids := [int(p.stem) for p in tmp_path.glob("*.pid")]) < 2 and time.monotonic() < patience:
        time.sleep(0.05)
    assert len(pids) == 2
    if ending == signal.SIGINT:
        os.killpg(program.pid, ending)  # a terminal's Ctrl-C reaches the workers as well
    else:
        program.send_signal(ending)
    _, complaint = program.communicate(timeout=60)
    while any(alive(pid) for pid in pids) and time.monotonic() < patience:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in pids)
    if ending == signal.SIGINT:
        assert complaint.rstrip().endswith("KeyboardInterrupt")
        assert complaint.count("Traceback") == 1, "the workers are silent"
        assert not list((tmp_path / "out").iterdir())


def test_workers_that_cannot_start_are_the_users_to_mend(tmp_path: Path) -> None:
    script = (
        "from toys.unreliable_models import *\n"
        "def homemade(theta): return toy_simulate(theta)\n"
        f"with Store(Path({str(tmp_path / 'a.store')!r}), 'toy') as store:\n"
        "    run_design(store, WAVE, COARSE_S, homemade, 'toy')\n"
    )
    (tmp_path / "unguarded.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    done = subprocess.run(
        [sys.executable, str(tmp_path / "unguarded.py")], env=environment, capture_output=True, text=True
    )
    assert "InputError: worker processes" in done.stderr.splitlines()[-1]
    assert "__main__" in done.stderr.splitlines()[-1]
