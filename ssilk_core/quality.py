# SPDX-License-Identifier: Apache-2.0
"""Quality levels by name, and the best model within a budget."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

from .checkpoint import ModelFile
from .errors import fail
from .reduction import ModelSize, Reduced, Reducer

ALL = 1_000_000  # more than any garment has


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A level of quality: what is kept of a trained garment, and what is done beyond it.

    Attributes:
        shapes, joints, influences: kept of what the model has.
        fps: most frames per second of a shot; None for those of its motion.
        refine: solver iterations for each frame, from the network's state.
        about: one line for people.
    """

    name: str
    shapes: int = ALL
    joints: int = ALL
    influences: int = ALL
    fps: float | None = None
    refine: int = 0
    about: str

    @property
    def size(self) -> ModelSize:
        return ModelSize(shapes=self.shapes, joints=self.joints, influences=self.influences)

    def rate(self, fps: float) -> float:
        """Return the frames per second of a shot whose motion has `fps`."""
        return fps if self.fps is None else min(self.fps, fps)


QUALITIES = {
    quality.name: quality
    for quality in (
        Quality(name="crowd", shapes=12, joints=8, influences=4, fps=15.0, about="many characters, far away"),
        Quality(name="game", shapes=32, joints=16, influences=4, fps=30.0, about="real time, four influences"),
        Quality(name="film", shapes=48, about="what cannot be told from the whole model"),
        Quality(name="hero", refine=4, about="the whole model, refined by the solver"),
    )
}


def quality_named(name: str) -> Quality:
    """Return a level; raise `SsilkError` for an unknown name."""
    if name not in QUALITIES:
        fail(f"quality '{name}'", "no such level", f"it is one of {', '.join(QUALITIES)}")
    return QUALITIES[name]


@dataclass(frozen=True)
class Budget:
    """The most that something may cost, in `unit`: "ms" for each frame, or bytes on disk."""

    amount: float
    unit: str

    def __str__(self) -> str:
        return in_units(self.amount, self.unit)


BYTES = {"kB": 1e3, "MB": 1e6, "GB": 1e9}


def in_units(amount: float, unit: str) -> str:
    """Return an amount as people read it: "0.31 ms", "1.96 MB"."""
    if unit == "ms":
        return f"{amount:.3g} ms"
    name = next((name for name, size in BYTES.items() if amount < 1000 * size), "GB")
    return f"{amount / BYTES[name]:.3g} {name}"


def budget_of(text: str) -> Budget:
    """Read a budget: "0.3ms" for each frame, or "2MB" (kB, GB) on disk.

    Raises:
        SsilkError: it is none.
    """
    found = re.fullmatch(r"\s*([0-9.eE+-]+?)\s*(ms|kB|MB|GB)\s*", text)
    try:
        amount = float(found[1]) if found else 0.0
    except ValueError:
        amount = 0.0
    if found is None or not 0 < amount < float("inf"):
        fail(f"--budget {text}", "not a budget", "a time for each frame, such as 0.3ms, or a size, such as 2MB")
    return Budget(amount, "ms") if found[2] == "ms" else Budget(amount * BYTES[found[2]], "bytes")


# What is tried, as shares of what there is, and as numbers.
SHAPES, JOINTS, INFLUENCES = (1.0, 0.75, 0.5, 0.375, 0.25, 0.125, 0.0), (1.0, 0.5, 0.25, 0.0), (ALL, 4)


def candidates(whole: ModelSize) -> list[ModelSize]:
    """Return the sizes that a budget is spent on, from all to nothing."""
    grid = product(JOINTS, INFLUENCES, SHAPES)  # shapes last: what others need is worked out once
    sizes = [
        ModelSize(shapes=round(share * whole.shapes), joints=round(joints * whole.joints), influences=most).within(
            whole
        )
        for joints, most, share in grid
    ]
    return list(dict.fromkeys(sizes))


@dataclass(frozen=True, eq=False)
class Choice:
    """The model that a budget buys, and what it costs in the budget's unit."""

    reduced: Reduced
    cost: float


def best_within(reducer: Reducer, budget: Budget, cost: Callable[[ModelFile], float], most: ModelSize) -> Choice:
    """Return the model that loses least, as predicted, of those that cost no more than a budget, as measured.

    Args:
        most: what may be kept.
        cost: measures a model in the budget's unit; it does not fall where more is kept.

    Raises:
        SsilkError: not even the smallest model fits.
    """
    tried = []
    for found in _cheaper(reducer, candidates(most), cost):
        tried.append(found.cost)
        if found.cost <= budget.amount:
            return found
    return fail(
        "--budget",
        f"nothing fits {budget}",
        f"the smallest that this model can be cut to takes {in_units(min(tried), budget.unit)}",
        "allow more, or train a smaller network ('ssilk train --set widths=... --set latent=...')",
    )


def _cheaper(reducer: Reducer, sizes: list[ModelSize], cost: Callable[[ModelFile], float]) -> Iterator[Choice]:
    """Yield models by what they lose, each without those that hold no less than one before."""
    tried: list[ModelSize] = []
    for size in sorted(sizes, key=lambda size: (reducer.predicted(size), sum(vars(size).values()))):
        if not any(other.within(size) == other for other in tried):
            tried.append(size)
            reduced = reducer.reduced(size)
            yield Choice(reduced, cost(reduced.file))
