"""Tests of the progress of a run on the terminal: bars, elapsed time and remaining time."""

from __future__ import annotations

import io
import re

from rich.console import Console

from bayeskin.cli.terminal import Terminal


class Watched:
    """A terminal with a clock that is set by hand, and what it shows."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
        self.terminal = Terminal(self.console, lambda: self.now_s)

    def hears(self, at_s: float, share: float, note: str = "", label: str = "sampling") -> str:
        self.now_s = at_s
        self.terminal.progress(label, share, note)
        return self.shows()

    def shows(self) -> str:
        with self.console.capture() as shown:
            self.console.print(self.terminal.bars.get_renderable())
        return re.sub(r"\s+", " ", shown.get())


def test_progress_shows_the_time_that_passed_and_the_time_that_is_left() -> None:
    watched = Watched()
    assert "left" not in watched.hears(0.0, 0.0)
    assert "0:01:00 0:03:00 left 2 of 8 runs" in watched.hears(60.0, 0.25, "2 of 8 runs")
    watched.now_s = 90.0  # nothing is heard for a while
    assert "0:01:30 0:02:30 left" in watched.shows()
    watched.now_s = 1000.0
    assert "0:00:00 left" in watched.shows()


def test_what_was_done_before_an_interruption_does_not_count_for_the_pace() -> None:
    watched = Watched()
    assert "left" not in watched.hears(0.0, 0.5)
    assert "0:00:40 left" in watched.hears(10.0, 0.6)


def test_another_round_begins_with_a_clock_of_its_own() -> None:
    watched = Watched()
    watched.hears(0.0, 0.1)
    assert watched.hears(100.0, 1.0).strip() == ""  # what is done goes
    assert "0:00:00" in watched.hears(200.0, 0.2)
    assert "0:00:10 0:00:30 left" in watched.hears(210.0, 0.4)


def test_each_label_has_a_line_that_is_not_wider_than_a_terminal() -> None:
    watched = Watched()
    for at_s, share in ((0.0, 0.0), (4000.0, 0.1)):
        watched.hears(at_s, share, "11 of 24 runs, 0 failed", "wave 1, held out")
        watched.hears(at_s, share, "", "recordings")
    with watched.console.capture() as shown:
        watched.console.print(watched.terminal.bars.get_renderable())
    lines = shown.get().strip().splitlines()
    assert len(lines) == 2
    assert "11 of 24 runs" in lines[0]
    assert lines[1].split()[-2:] == ["10:00:00", "left"]
