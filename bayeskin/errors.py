"""Errors that the user can correct, which are kept apart from errors in the program."""

from __future__ import annotations


class InputError(ValueError):
    """Wrong input, described in one line: where it is, what is wrong, and what helps.

    The command line prints this line and exits with code 2. Nothing has been written then.

    Parameters
    ----------
    where : the file, field or row with the error, e.g. ``"runs/a.toml: design.points"``
    problem : a clause that says what is there, e.g. ``"3 points are too few"``
    remedy : a clause that says what must be there or what helps, e.g. ``"use at least 8"``

    Line breaks in these texts become spaces.
    """

    def __init__(self, where: object, problem: object, remedy: object) -> None:
        self.where, self.problem, self.remedy = (
            " ".join(line.strip() for line in str(part).splitlines()) for part in (where, problem, remedy)
        )
        super().__init__(f"{self.where}: {self.problem}; {self.remedy}")


class CannotWrite(InputError):
    """A file cannot be written, for example because the disk is full or the permission is missing."""

    def __init__(self, path: object, error: OSError) -> None:
        super().__init__(path, reason_of(error), "free space and write permission are needed")

    def __str__(self) -> str:
        return f"cannot write {self.where}: {self.problem}"


class Unavailable(InputError):
    """Something that a run needs, such as a server, is not available at present.

    The error says nothing about the run itself, so no result is stored.
    """


def reason_of(error: Exception) -> str:
    """Returns why a file could not be read or written, e.g. "permission denied"."""
    reason = getattr(error, "strerror", None) or str(error)
    return reason[:1].lower() + reason[1:] if reason else type(error).__name__
