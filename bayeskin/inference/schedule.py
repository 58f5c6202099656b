"""The times at which ensembles wait for each other, to judge convergence and to fit proposals to draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """The schedule of ensembles; all numbers of steps count from their start.

    first_check, between : steps before convergence is judged first, and the least number between judgements
    lessons : steps at which the proposals of the moves are fitted to the draws so far, each with the power of
        the density from which the steps up to it draw. At low powers, separate parts of the posterior are
        still connected. The last fit is at the power 0.7, which makes the proposals wider than the posterior:
        tails that a proposal lacks would hardly be visited. All steps before the last fit are burn-in.
    late : share of the steps so far that such a fit leaves out
    points : largest number of draws for such a fit
    refresh : steps between two reports of progress
    """

    first_check: int = 500
    between: int = 250
    lessons: tuple[tuple[int, float], ...] = (
        (30, 0.1), (60, 0.1), (90, 0.2), (120, 0.2), (150, 0.35), (180, 0.35), (210, 0.5), (240, 0.5),
        (270, 0.7), (300, 0.7),
    )  # fmt: skip
    late: float = 0.4
    points: int = 16000
    refresh: int = 100

    def is_lesson(self, step: int) -> bool:
        """Returns whether the proposals are fitted at a step."""
        return any(at == step for at, _ in self.lessons)

    def power(self, goal: int) -> float:
        """Returns the power of the density from which the steps up to a checkpoint `goal` draw."""
        return next((power for at, power in self.lessons if at >= goal), 1.0)

    def checkpoints(self, max_steps: int) -> Iterator[tuple[int, bool]]:
        """Yields the steps at which the ensembles wait for each other, and whether convergence is judged.

        They depend on the step count alone, so that an interruption cannot change the step at which a run
        stops.
        """
        check = 0
        while check < max_steps:
            before, later = check, check + max(self.between, check // 5)
            check = min(max(self.first_check, later), max_steps)
            yield from ((at, False) for at, _ in self.lessons if before < at < check)
            yield check, True


SCHEDULE = Schedule()
