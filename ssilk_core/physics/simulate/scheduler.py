# SPDX-License-Identifier: Apache-2.0
"""Steps of many shots at once, of which none waits for another.

A step takes between a few iterations and hundreds, where it is split. The steps of all shots are solved together, and
a shot whose step is solved goes on with its next one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from torch import Tensor

from .characters import PosedCharacters
from .history import StepHistory
from .newton import Search, Solution

EVERY = 8  # iterations, after which solved steps go on

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Asked:
    """A step of one shot that is to be solved.

    Attributes:
        dt: its length [s].
        search: returns the search for the ends of such steps, by numbers of N shots, and the length of all or of
            each, (N,).
        past: before the step.
        poses: at its end.
    """

    dt: float
    search: Callable[[PosedCharacters, StepHistory, Sequence[int], float | Tensor], Search]
    past: StepHistory
    poses: PosedCharacters

    @property
    def kind(self) -> Hashable:
        """What all steps that are solved together have in common: what is known of them, and mostly their length.

        A GPU solves those of all lengths together, since each kind of steps takes as long as one step at least.
        """
        past, poses = (
            tuple(name for name, value in vars(each).items() if value is None) for each in (self.past, self.poses)
        )
        world = self.poses.world
        dt = None if self.on_gpu and self.past.friction is None else self.dt
        return dt, past, poses, world is not None and world.has_colliders

    @property
    def on_gpu(self) -> bool:
        """Whether a GPU solves it."""
        return self.past.last.device.type == "cuda"


Course = Generator[Asked, Solution, T]
"""What asks for one solution after the other, and returns what becomes of them."""


@dataclass(eq=False)
class _Steps:
    """Steps of one kind: those to begin with, each with its number, and the search for the others."""

    waiting: list[tuple[int, Asked]] = field(default_factory=list)
    search: Search | None = None


class Scheduler(Generic[T]):
    """Follows courses, each by a number, and solves what all of them ask for together."""

    def __init__(self) -> None:
        self._courses: dict[int, Course[T]] = {}
        self._steps: dict[Hashable, _Steps] = {}

    def __len__(self) -> int:
        """The number of courses that have not ended."""
        return len(self._courses)

    def begin(self, number: int, course: Course[T]) -> None:
        """Follow one more course."""
        self._ask(number, course, next(course))

    def run(self) -> list[tuple[int, T]]:
        """Make some iterations of all steps; return the courses that ended, with what they returned."""
        ended: list[tuple[int, T]] = []
        for steps in list(self._steps.values()):
            for number, solution in _iterate(steps):
                course = self._courses.pop(number)
                try:
                    asked = course.send(solution)
                except StopIteration as end:
                    ended.append((number, end.value))
                else:
                    self._ask(number, course, asked)
        return ended

    def _ask(self, number: int, course: Course[T], asked: Asked) -> None:
        self._courses[number] = course
        self._steps.setdefault(asked.kind, _Steps()).waiting.append((number, asked))


def _iterate(steps: _Steps) -> list[tuple[int, Solution]]:
    """Make some iterations of steps of one kind; return the solutions that were found, by number."""
    if steps.waiting:
        numbers, asked = zip(*steps.waiting)
        steps.waiting = []
        poses = PosedCharacters.concatenated([each.poses for each in asked])
        past, dt = StepHistory.concatenated([each.past for each in asked]), asked[0].dt
        lengths = past.last.new_tensor([each.dt for each in asked]) if asked[0].on_gpu else dt
        search = asked[0].search(poses, past, numbers, lengths)
        if steps.search:
            steps.search.join(search)
        else:
            steps.search = search
    found = []
    if steps.search:
        found = steps.search.leave()
        for _ in range(EVERY):
            if not len(steps.search):
                break
            steps.search.advance()
            found += steps.search.leave()
        if not len(steps.search):
            steps.search = None
    return [each for numbers, solution in found for each in zip(numbers.tolist(), solution.split())]
