"""Errors that are the user's to mend, told apart from those that are ours."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input: one line that says where it is, what was found and what was expected.

    The command line prints the line and exits with code 2; nothing has been written.

    Parameters
    ----------
    where : file, field or row at fault, e.g. ``"runs/a.toml: design.points"``
    found : what stands there
    expected : what should stand there

    Line breaks in these become spaces.
    """

    def __init__(self, where: object, found: object, expected: object) -> None:
        self.where, self.found, self.expected = (
            " ".join(line.strip() for line in str(part).splitlines()) for part in (where, found, expected)
        )
        super().__init__(f"{self.where}: found {self.found}; expected {self.expected}")


class Unavailable(InputError):
    """Something that a run needs cannot be had now, which says nothing about the run: nothing is stored."""
