# SPDX-License-Identifier: Apache-2.0
"""Variants for a sweep: models with one change each, and the quality levels, which have several."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...network.checkpoint import ModelFile
from ...network.latent_solver import LatentOptions
from ...network.packing import dequantize, quantize
from ..levels import QUALITIES
from ..reduction import ModelSize

WHOLE, SIMULATOR = "as trained", "simulator"
SHAPES, JOINTS = (0.75, 0.5, 0.25, 0.125, 0.0), (0.75, 0.5, 0.25, 0.0)  # shares of the model's numbers
INFLUENCES, RATES, REFINED = (6, 4, 3, 2, 1), (1 / 2, 1 / 3), (1, 2)
SOLVED = (1, 2, 4)  # iterations in latents

Array = np.ndarray
PRECISIONS: dict[str, Callable[[Array], Array]] = {
    "float32": lambda values: values,
    "int16": lambda values: dequantize(*quantize(values)) if values.ndim > 1 else values,
    "float16": lambda values: values.astype(np.float16).astype(np.float32),
    "bfloat16": lambda values: _bfloat16(values),
}


def _bfloat16(values: Array) -> Array:
    """Round to the 8-bit mantissa of bfloat16, to nearest with ties to even."""
    bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000).view(np.float32)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to play a garment.

    Attributes:
        swept, name: names of the sweep and of the variant, for tables.
        size: size of the model.
        precision: precision of the parameters, one of `PRECISIONS`.
        fps: frame rate of the shot [1/s].
        refine: solver iterations per frame.
        feedback: refined frames look back on refined ones.
        latents: how states are solved for in latents; None where the network takes the steps.
        simulated: the simulator computes the shot, from the network's first two states.
    """

    swept: str
    name: str
    size: ModelSize
    precision: str = "float32"
    fps: float
    refine: int = 0
    feedback: bool = False
    latents: LatentOptions | None = None
    simulated: bool = False

    @property
    def solved(self) -> bool:
        """Whether a solver makes the shot, or refines it."""
        return self.simulated or self.refine > 0 or self.latents is not None

    def in_precision(self, file: ModelFile) -> ModelFile:
        """Return a model with its parameters rounded to this precision."""
        parameters = {name: PRECISIONS[self.precision](value) for name, value in file.parameters.items()}
        return replace(file, parameters=parameters)


def variants(whole: ModelSize, fps: float, *, solved: bool = True) -> Iterator[Variant]:
    """Yield the whole model, then the variants of each sweep, then the quality levels.

    Args:
        whole: size of the model.
        fps: frame rate of the model.
        solved: include the solver, which takes a thousand times as long as everything else.
    """
    base = Variant(swept=WHOLE, name=WHOLE, size=whole, fps=fps)
    yield base
    for share in SHAPES:
        size = replace(whole, shapes=round(share * whole.shapes))
        yield replace(base, swept="blendshapes", name=f"{size.shapes} blendshapes", size=size)
    for share in JOINTS if whole.joints else ():
        size = replace(whole, joints=round(share * whole.joints))
        yield replace(base, swept="proxies", name=f"{size.joints} proxies", size=size)
    for count in (count for count in INFLUENCES if count < whole.influences):
        yield replace(base, swept="influences", name=f"{count} influences", size=replace(whole, influences=count))
    for name in list(PRECISIONS)[1:]:
        yield replace(base, swept="precision", name=name, precision=name)
    for share in RATES:
        yield replace(base, swept="frame rate", name=f"{share * fps:g} frames/s", fps=share * fps)
    for count in REFINED if solved else ():
        yield replace(base, swept="refinement", name=f"{count} iterations", refine=count)
    for count in SOLVED if solved else ():
        few = LatentOptions(iterations=count, sampled=True)
        yield replace(base, swept="latents", name=f"{count} in latents", latents=few)
    yield from _levels(base, solved=solved)
    if solved:
        yield replace(base, swept=SIMULATOR, name=SIMULATOR, simulated=True)


def other_network(whole: ModelSize, fps: float) -> Iterator[Variant]:
    """Yield another model of a garment whose variants were tried: the whole model, and the levels of the network."""
    base = Variant(swept=WHOLE, name=WHOLE, size=whole, fps=fps)
    yield base
    yield from _levels(base, solved=False)


def _levels(base: Variant, *, solved: bool) -> Iterator[Variant]:
    for level in QUALITIES.values():
        latents = LatentOptions(iterations=level.latent_iterations) if level.latent_iterations else None
        if solved or not (level.refine or latents):
            kept, fps = level.size.within(base.size), level.rate(base.fps)
            reduced = replace(base, swept="level", precision="int16")  # as 'ssilk reduce' writes models
            reduced = replace(reduced, refine=level.refine, feedback=level.feedback, latents=latents)
            yield replace(reduced, name=level.name, size=kept, fps=fps)
