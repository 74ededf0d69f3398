# SPDX-License-Identifier: Apache-2.0
"""How long the steps of a run take, and those that are left."""

from __future__ import annotations


class StepTimes:
    """Durations of steps of static and of dynamic training, by the time that steps took in this process so far.

    The first step of either does not count: it compiles, captures or settles what the others find ready.

    Args:
        ratio: expected duration of a dynamic step over that of a static one, until there are two dynamic ones.
    """

    def __init__(self, ratio: float) -> None:
        self.ratio = ratio
        self._first: dict[bool, tuple[int, float]] = {}
        self._last: dict[bool, tuple[int, float]] = {}

    def took(self, is_static: bool, iteration: int, seconds: float) -> None:
        """Take in that a step of one phase ended: the iterations that are done, and the time in steps so far [s]."""
        self._first.setdefault(is_static, (iteration, seconds))
        self._last[is_static] = iteration, seconds

    def left(self, static: int, dynamic: int) -> float | None:
        """Return how long so many steps of each phase take [s]; None while nothing is known."""
        of_static, of_dynamic = self.static, self._each(False)
        if of_dynamic is None:
            of_dynamic = of_static and of_static * self.ratio
        if of_dynamic is None:
            return None
        return static * (of_dynamic / self.ratio if of_static is None else of_static) + dynamic * of_dynamic

    @property
    def static(self) -> float | None:
        """The mean duration of a static step [s]; None before the second one of this process."""
        return self._each(True)

    def _each(self, is_static: bool) -> float | None:
        """Return the mean duration of a step [s], from the second of a phase on; None before that."""
        if is_static not in self._first:
            return None
        (first, began), (last, ended) = self._first[is_static], self._last[is_static]
        return (ended - began) / (last - first) if last > first else None
