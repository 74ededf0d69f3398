# SPDX-License-Identifier: Apache-2.0
"""The inputs of a training run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..assets import LOOSE, PINNED, Motion, Scene
from ..config import ModelConfig, TrainConfig
from ..errors import fail
from ..fabrics import Fabric
from .recombine import recombined
from .state import canonical, scene_digest


@dataclass(frozen=True, kw_only=True)
class TrainJob:
    """Everything a training needs, cut down to what its scene requires.

    Garments with nothing loose are quasi-static: a stepper learns nothing there that the initialiser does not know.

    Attributes:
        scene: character with its body, garment, rig.
        motions, held_out: what is trained on, and what is validated on.
        output: the model file to write; the run's other files lie beside it.
        inputs: hashes of the input files by name, for the provenance.
        minutes: wall time to fill instead of the schedule's iterations; None for these. A resumed run may have more.
    """

    scene: Scene
    motions: Sequence[Motion]
    held_out: Sequence[Motion]
    model: ModelConfig
    train: TrainConfig
    fabric: Fabric
    output: Path
    device: str = "auto"
    resume: bool = False
    inputs: dict[str, str] | None = None
    minutes: float | None = None

    def __post_init__(self) -> None:
        if not self.has_loose:
            object.__setattr__(self, "model", replace(self.model, scheme="quasi_static"))
        if self.model.scheme == "quasi_static":  # nothing has a past to vary
            object.__setattr__(self, "train", replace(self.train, state_reuse=0, noise=0))
        if not self.learns:
            object.__setattr__(self, "model", replace(self.model, latent=1, widths=(1,), shapes=1))
            least = replace(self.train, iterations=1, batch=1, pretraining_batch=1, static_batch=1, recombinations=0)
            object.__setattr__(self, "train", least)

    @property
    def has_loose(self) -> bool:
        """Whether anything of the garment is loose."""
        return bool((self.scene.classes == LOOSE).any())

    @property
    def learns(self) -> bool:
        """Whether there is anything to learn; a garment that is pinned all over gets the least of networks."""
        return bool((self.scene.classes != PINNED).any())

    def trained_motions(self) -> list[Motion]:
        """Return the motions and what is recombined from them."""
        skeleton = self.scene.character.skeleton
        return [*self.motions, *recombined(self.motions, skeleton, self.train.recombinations, self.train.seed)]

    def identity(self) -> dict[str, Any]:
        """Return what makes a run the run it is, as it comes back from JSON; a resumed run must be asked the same."""
        return canonical(
            {
                "model": asdict(self.model),
                "train": asdict(self.train),
                "fabric": asdict(self.fabric),
                "inputs": self.inputs or {},
                "motions": _frames(self.motions),
                "held out": _frames(self.held_out),
                "garment": self.scene.garment.mesh.path,
                "scene": scene_digest(self.scene),
            }
        )


def _frames(motions: Sequence[Motion]) -> dict[str, list[tuple[float, int, float]]]:
    """Return (first frame, number of frames, rate) of the motions by path, which names the prim."""
    found: dict[str, list[tuple[float, int, float]]] = {}
    for motion in motions:
        found.setdefault(motion.path, []).append((motion.start, motion.frame_count, motion.fps))
    return found


def split_motions(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Return 80 % of the clips to train on and 20 % to validate on, spread evenly; one clip is cut in two."""
    if len(motions) == 1:
        cut = int(motions[0].frame_count * 0.8)
        if not cut > 0:
            fail(motions[0].path, "one motion of one frame", "longer motions are needed to train")
        return [motions[0].clip(0, cut)], [motions[0].clip(cut, motions[0].frame_count)]
    held = set(range(4, len(motions), 5)) or {len(motions) - 1}
    return [m for i, m in enumerate(motions) if i not in held], [m for i, m in enumerate(motions) if i in held]
