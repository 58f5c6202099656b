"""A design's journal: it gives back what it was given, and a damaged line costs that run only."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
from toys.design_runs import run
from toys.unreliable_models import COARSE_S, WAVE

from bayeskin.errors import InputError
from bayeskin.journal import Journal, Run

RUN = Run(WAVE.theta[0], np.arange(3.0) / 7.0, True, "", 1.5)
LOST = Run(WAVE.theta[1], np.full(3, np.nan), False, "Newton stalled é\n", float("nan"))


def test_a_journal_gives_back_what_it_was_given(tmp_path: Path) -> None:
    path = tmp_path / "j"
    with Journal(path, "a", bins=3) as journal:
        journal.append(RUN)
        journal.append(LOST)
    with Journal(path, "a", bins=3) as journal:
        for before, after in zip((RUN, LOST), journal.runs.values(), strict=True):
            for x, y in zip(before, after, strict=True):
                np.testing.assert_array_equal(x, y)
        journal.forget({RUN.theta.tobytes()})
    with Journal(path, "a", bins=3) as journal:
        assert list(journal.runs) == [LOST.theta.tobytes()]
        journal.forget(set(journal.runs))
    assert not path.exists()


def test_a_journal_cut_at_any_byte_keeps_the_whole_lines_and_can_be_continued(tmp_path: Path) -> None:
    path = tmp_path / "j"
    with Journal(path, "a", bins=3) as journal:
        journal.append(RUN)
        first = path.stat().st_size
        journal.append(LOST)
    text = path.read_bytes()
    for cut in range(first, len(text)):
        path.write_bytes(text[:cut])
        with Journal(path, "a", bins=3) as journal:
            whole_but_for_its_end = cut == len(text) - 1
            assert len(journal.runs) == (2 if whole_but_for_its_end else 1)
            journal.append(LOST)
        with Journal(path, "a", bins=3) as journal:
            assert list(journal.runs) == [RUN.theta.tobytes(), LOST.theta.tobytes()]


def test_a_flipped_bit_in_a_journal_costs_that_run_only(tmp_path: Path) -> None:
    path = tmp_path / "j"
    with Journal(path, "a", bins=3) as journal:
        journal.append(RUN)
        first = path.stat().st_size
        journal.append(LOST)
    text = path.read_bytes()
    for at in range(0, first - 1):
        path.write_bytes(text[:at] + bytes([text[at] ^ 1]) + text[at + 1 :])
        with Journal(path, "a", bins=3) as journal:
            assert list(journal.runs) == [LOST.theta.tobytes()]


def test_unfinished_runs_of_another_model_are_refused_and_kept(tmp_path: Path) -> None:
    journal = tmp_path / "design.h5.journal"
    with Journal(journal, "of another design", len(COARSE_S) - 1) as other:
        other.append(RUN)
    before = journal.read_bytes()
    with pytest.raises(InputError, match="another model"):
        run(tmp_path / "design.h5")
    assert journal.read_bytes() == before


@pytest.mark.parametrize(
    "contents",
    [b'{"design": "a"}', b"{", b"[]", b"3", b'{"design": "a", "theta": "x", "force_n": null}', b"[" * 9999],
)
def test_a_line_with_the_right_checksum_that_is_no_run_is_refused(tmp_path: Path, contents: bytes) -> None:
    path = tmp_path / "j"
    path.write_bytes(b"%08x %d %s\n" % (zlib.crc32(contents), len(contents), contents))
    with pytest.raises(
        InputError, match=r"j, line 1: found a line that is not a run; expected a run that bayeskin wrote"
    ):
        Journal(path, "a", bins=3)
