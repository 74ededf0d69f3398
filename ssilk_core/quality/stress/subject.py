# SPDX-License-Identifier: Apache-2.0
"""The subject of a stress test: a trained garment on its character, a base motion, and the effort to spend."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from ...network.checkpoint import ModelFile, network
from ...network.model.network import GarmentModel
from ...scene.assets import Floats, Motion, Scene
from ...scene.fabrics import Fabric
from .drives import ProceduralMotion, loop_clip, sway
from .meter import positions
from .worlds import resize_garment


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Amount of work in each case.

    Attributes:
        seconds: duration of the motion in most cases [s].
        frames: share of the frames in the names of long cases that is computed.
        steps: optimiser steps of trial trainings.
        simulated: frames of trial simulations.
        vertices: largest number of vertices of a trial garment.
        patch: vertices of the patch of a garment that is simulated; None for the whole garment.
    """

    seconds: float = 20.0
    frames: float = 1.0
    steps: int = 60
    simulated: int = 10
    vertices: int = 200_000
    patch: int | None = None


FULL = Effort()
QUICK = Effort(seconds=3.0, frames=0.1, steps=12, simulated=3, vertices=20_000, patch=600)


@dataclass(frozen=True, eq=False)
class StressSubject:
    """A model file, its scene with the character's bodies, and a clip (None for a procedural motion)."""

    file: ModelFile
    scene: Scene
    clip: Motion | None
    effort: Effort

    @property
    def fabric(self) -> Fabric:
        return self.file.fabric

    @property
    def fps(self) -> float:
        return self.file.config.fps

    @cached_property
    def base(self) -> ProceduralMotion:
        """The motion that the cases modify."""
        skeleton = self.scene.character.skeleton
        endless = loop_clip(self.clip, self.fps) if self.clip else sway(skeleton, self.fps)
        return endless.with_loops(self.effort.seconds)

    @cached_property
    def model(self) -> GarmentModel:
        return self.in_precision(torch.float32)

    @cached_property
    def free(self) -> Floats:
        """Where the network has its cloth over `base`, relative to the root [m], shape (F, V, 3)."""
        return positions(self.model, self.base)

    @cached_property
    def cloth(self) -> Scene:
        """The scene with what is simulated of the garment."""
        return self.scene if self.effort.patch is None else resize_garment(self.scene, self.effort.patch)

    def in_precision(self, dtype: torch.dtype) -> GarmentModel:
        """Return the network with all parameters and buffers in `dtype`."""
        return network(self.file, self.scene).to(dtype)
