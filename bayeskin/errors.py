"""Errors that the user can correct, which are kept apart from errors in the program."""

from __future__ import annotations


class InputError(ValueError):
    """Wrong input, described in one line: where it is, what was found and what was expected.

    The command line prints this line and exits with code 2. Nothing has been written then.

    Parameters
    ----------
    where : the file, field or row with the error, e.g. ``"runs/a.toml: design.points"``
    found : what was found there
    expected : what was expected there

    Line breaks in these texts become spaces.
    """

    def __init__(self, where: object, found: object, expected: object) -> None:
        self.where, self.found, self.expected = (
            " ".join(line.strip() for line in str(part).splitlines()) for part in (where, found, expected)
        )
        super().__init__(f"{self.where}: found {self.found}; expected {self.expected}")


class CannotWrite(InputError):
    """A file cannot be written, for example because the disk is full or the permission is missing."""

    def __init__(self, path: object, error: OSError) -> None:
        super().__init__(path, error.strerror, "free space and write permission")

    def __str__(self) -> str:
        return f"cannot write {self.where}: {self.found}"


class Unavailable(InputError):
    """Something that a run needs, such as a server, is not available at present.

    The error says nothing about the run itself, so no result is stored.
    """
