# SPDX-License-Identifier: Apache-2.0
"""Named quality levels, and the search for the best model within a budget."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

from ..errors import fail, fail_unknown
from ..events import Message, Reporter
from ..network.checkpoint import ModelFile
from ..network.runtime import Player
from ..scene.assets import Motion
from .cost import play_time
from .reduction import ModelSize, ReducedModel, Reducer

UNLIMITED = 1_000_000  # exceeds the number of shapes, joints or influences of any garment


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A quality level: the size to which a trained garment is reduced, its frame rate and its refinement.

    Attributes:
        shapes, joints, influences: largest numbers of blendshapes, proxies, and influences per vertex.
        fps: highest frame rate of a shot [1/s]; None for that of its motion.
        refine: solver iterations per frame, starting from the network's state.
        feedback: refined frames look back on refined ones.
        latent_iterations: iterations per frame of the solver in the model's latents, which takes the place of the
            network's own steps; 0 for these.
        about: one-line description.
    """

    name: str
    shapes: int = UNLIMITED
    joints: int = UNLIMITED
    influences: int = UNLIMITED
    fps: float | None = None
    refine: int = 0
    feedback: bool = False
    latent_iterations: int = 0
    about: str

    @property
    def size(self) -> ModelSize:
        return ModelSize(shapes=self.shapes, joints=self.joints, influences=self.influences)

    def rate(self, fps: float) -> float:
        """Return the frame rate [1/s] of a shot whose motion has the rate `fps`."""
        return fps if self.fps is None else min(self.fps, fps)


QUALITIES = {
    quality.name: quality
    for quality in (
        Quality(name="crowd", shapes=12, joints=8, influences=4, fps=15.0, about="many characters, far away"),
        Quality(name="game", shapes=32, joints=16, influences=4, fps=30.0, about="real time, four influences"),
        Quality(name="film", shapes=48, about="no visible difference from the full model"),
        Quality(name="latent", latent_iterations=2, about="the full model, its states solved for: slow, no larger"),
        Quality(name="hero", refine=8, feedback=True, about="the full model, carried on by the solver"),
    )
}


def quality_named(name: str) -> Quality:
    """Return a level; raise `SsilkError` for an unknown name."""
    if name not in QUALITIES:
        fail_unknown(f"quality '{name}'", "no such level", name, QUALITIES)
    return QUALITIES[name]


def size_at(quality: str | None, whole: ModelSize) -> ModelSize:
    """Return the size of a model at a level, or its full size without one; raise `SsilkError` for an unknown name."""
    return quality_named(quality).size.within(whole) if quality else whole


@dataclass(frozen=True, kw_only=True)
class SizeReduction:
    """Sizes of a model before and after a reduction, and the resulting error.

    Attributes:
        whole, kept: sizes of the model before and after.
        rms_mm, max_mm: RMS (weighted by mass) and maximum distance of vertices from the full model's [mm].
    """

    whole: ModelSize
    kept: ModelSize
    rms_mm: float
    max_mm: float

    @classmethod
    def of(cls, whole: ModelSize, found: ReducedModel) -> SizeReduction:
        """Return the sizes and errors of a reduced model."""
        return cls(whole=whole, kept=found.size, rms_mm=1000 * found.rms, max_mm=1000 * found.largest)

    def to_metadata(self) -> dict[str, object]:
        """Return the entries that files store."""
        return {
            "blendshapes": f"{self.kept.shapes} of {self.whole.shapes}",
            "proxies": f"{self.kept.joints} of {self.whole.joints}",
            "influences": f"{self.kept.influences} of {self.whole.influences}",
            "loses [mm RMS]": round(self.rms_mm, 3),
            "loses at most [mm]": round(self.max_mm, 2),
        }


@dataclass(frozen=True)
class Budget:
    """An upper limit of a cost in `unit`: "ms" per frame, or "bytes" on disk."""

    amount: float
    unit: str

    def __str__(self) -> str:
        return format_amount(self.amount, self.unit)


BYTES = {"kB": 1e3, "MB": 1e6, "GB": 1e9}


def format_amount(amount: float, unit: str) -> str:
    """Format an amount: "0.31 ms", "1.96 MB"."""
    if unit == "ms":
        return f"{amount:.3g} ms"
    name = next((name for name, size in BYTES.items() if amount < 1000 * size), "GB")
    return f"{amount / BYTES[name]:.3g} {name}"


def parse_budget(text: str) -> Budget:
    """Parse a budget: "0.3ms" per frame, or "2MB" (kB, GB) on disk.

    Raises:
        SsilkError: the text is not a budget.
    """
    found = re.fullmatch(r"\s*([0-9.eE+-]+?)\s*(ms|kB|MB|GB)\s*", text)
    try:
        amount = float(found[1]) if found else 0.0
    except ValueError:
        amount = 0.0
    if found is None or not 0 < amount < float("inf"):
        fail(f"--budget {text}", "not a budget", "a time for each frame, such as 0.3ms, or a size, such as 2MB")
    return Budget(amount, "ms") if found[2] == "ms" else Budget(amount * BYTES[found[2]], "bytes")


# Candidate sizes: shares of the model's blendshapes and proxy joints, and numbers of influences.
SHAPES, JOINTS, INFLUENCES = (1.0, 0.75, 0.5, 0.375, 0.25, 0.125, 0.0), (1.0, 0.5, 0.25, 0.0), (UNLIMITED, 4)


def candidate_sizes(whole: ModelSize) -> list[ModelSize]:
    """Return the candidate sizes for a budget, from the full model to one without shapes and proxies."""
    grid = product(JOINTS, INFLUENCES, SHAPES)  # shapes vary fastest: the reducer caches what the others need
    sizes = [
        ModelSize(shapes=round(share * whole.shapes), joints=round(joints * whole.joints), influences=most).within(
            whole
        )
        for joints, most, share in grid
    ]
    return list(dict.fromkeys(sizes))


@dataclass(frozen=True, eq=False)
class BudgetChoice:
    """The best model within a budget, and its cost in the budget's unit."""

    reduced: ReducedModel
    cost: float


def best_within(
    reducer: Reducer, budget: Budget, cost: Callable[[ModelFile], float], most: ModelSize
) -> BudgetChoice:
    """Return the model with the least predicted error among those whose measured cost is within a budget.

    Args:
        most: largest size.
        cost: measures a model in the budget's unit; it must not decrease with size.

    Raises:
        SsilkError: even the smallest model exceeds the budget.
    """
    tried = []
    for found in _cheaper(reducer, candidate_sizes(most), cost):
        tried.append(found.cost)
        if found.cost <= budget.amount:
            return found
    return fail(
        "--budget",
        f"nothing fits {budget}",
        f"this model needs at least {format_amount(min(tried), budget.unit)}",
        "raise the budget, or train a smaller network ('ssilk train --set widths=... --set latent=...')",
    )


def _cheaper(reducer: Reducer, sizes: list[ModelSize], cost: Callable[[ModelFile], float]) -> Iterator[BudgetChoice]:
    """Yield models in order of predicted error; skip those at least as large as one already yielded."""
    tried: list[ModelSize] = []
    for size in sorted(sizes, key=lambda size: (reducer.predict_error(size), sum(vars(size).values()))):
        if not any(other.within(size) == other for other in tried):
            tried.append(size)
            reduced = reducer.reduce(size)
            yield BudgetChoice(reduced, cost(reduced.file))


def spend(
    text: str,
    reducer: Reducer,
    most: ModelSize,
    motion: Motion,
    size_bytes: Callable[[ModelFile], float],
    report: Reporter,
) -> ReducedModel:
    """Return the best model within a budget, and report its size and cost.

    Args:
        text: the budget, for `parse_budget`.
        most: largest size.
        motion: motion on which models are timed.
        size_bytes: returns the size of a model on disk [bytes].

    Raises:
        SsilkError: nothing fits, or the text is not a budget.
    """
    budget = parse_budget(text)

    def cost(file: ModelFile) -> float:
        return size_bytes(file) if budget.unit == "bytes" else play_time(Player(file.on_base()), motion).median

    choice = best_within(reducer, budget, cost, most)
    kept = choice.reduced.size
    report(Message(f"within {budget}: {kept.shapes} blendshapes, {kept.joints} proxies and {kept.influences} "
                   f"influences take {format_amount(choice.cost, budget.unit)}"))  # fmt: skip
    return choice.reduced
