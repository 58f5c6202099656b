"""The one line that tells a user what is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from bayeskin.errors import CannotWrite, InputError, reason_of


def test_the_line_says_where_what_is_wrong_and_what_helps() -> None:
    error = InputError("skin.csv, row 14", "the force is 'abc'", "it must be a number")
    assert str(error) == "skin.csv, row 14: the force is 'abc'; it must be a number"
    assert (error.where, error.problem, error.remedy) == (
        "skin.csv, row 14", "the force is 'abc'", "it must be a number",
    )  # fmt: skip


def test_line_breaks_of_its_parts_become_blanks() -> None:
    error = InputError("a\nb", np.ones((2, 2)), "it must be\n  a number")
    assert str(error) == "a b: [[1. 1.] [1. 1.]]; it must be a number"


def test_a_file_that_cannot_be_written_is_named_with_the_reason_of_the_system() -> None:
    error = CannotWrite("runs/a.h5", OSError(28, "No space left on device"))
    assert str(error) == "cannot write runs/a.h5: no space left on device"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (PermissionError(13, "Permission denied", "a.csv"), "permission denied"),
        (ValueError("embedded null byte"), "embedded null byte"),
        (OSError(), "OSError"),
    ],
)
def test_the_reason_is_the_system_s_or_the_error_s_text_or_its_name(error: Exception, reason: str) -> None:
    assert reason_of(error) == reason
