# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames that are solved for a garment that is played, where its level of quality asks for it."""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import GarmentPose

from ..errors import SetupError
from .dressed import DressedGarment
from .models import TrainedGarment
from .rolled import PRE_ROLL, RolledMotion
from .solving import SOLVED, Solving, need_solver

QUIET = 0.3  # seconds after a pose was found to differ before the motion is solved again


class SolvedFrames:
    """What is solved at a level of quality, while the network is played where nothing is yet.

    Attributes:
        level: as `GarmentSettings.live_quality` names it.
        solving: what solves for frames; None where the network alone is played.
        keyed: solved frames that keys show.

    Raises:
        SetupError: nothing can solve at this level.
    """

    def __init__(self, level: str) -> None:
        need_solver(level)
        self.level, self.keyed = level, 0
        self.solving: Solving | None = None
        self._refused = ""  # why nothing solves though the level asks for it
        self._solved_with: tuple[float, ...] = ()  # when the model was written that the solver has, and its fabric
        self._noticed: float | None = None  # when a pose differed that the solver does not know yet

    @property
    def frames(self) -> list[GarmentPose]:
        """The solved frames, one pose each, from the first one on."""
        return self.solving.frames if self.solving else []

    @property
    def wrong(self) -> str:
        """Why frames are not solved though the level asks for it, in a sentence; empty otherwise."""
        return self._refused or (self.solving.error if self.solving else "")

    @property
    def noticed(self) -> bool:
        """Whether a pose was found to differ that the solver does not know yet."""
        return self._noticed is not None

    @property
    def waits(self) -> bool:
        """Whether more will be solved."""
        return bool(self.solving and self.solving.waits) or self.noticed

    def prepare(self, dressed: DressedGarment, model: Path, trained: TrainedGarment, written: float) -> None:
        """Prepare what solves for frames with a model as it was written then, where the level asks for it."""
        asked = written, *trained.factors.tolist()
        if self.solving and self._solved_with == asked:
            return
        self.close()
        self._refused, self._solved_with = "", asked
        if self.level not in SOLVED:
            return
        try:
            garment, armature = dressed.objects()
            if not dressed.ready():
                raise SetupError(f"'{garment.name}' is not in Object Mode; go there and choose the quality again.")
            self.solving = Solving(garment, armature, model, trained, self.level, PRE_ROLL)
        except SsilkError as error:
            self._refused = str(error)

    def follow(self, rolled: RolledMotion) -> None:
        """Solve for the motion as it is known by now."""
        self._noticed = None
        if self.solving and rolled.free is not None:
            self.close()
            self._refused = "A garment that is held is played by the network; a bake at this quality solves for it."
        if self.solving:
            self.solving.follow(rolled.motion())
            self.keyed = min(self.keyed, len(self.frames))

    def take_in(self, rolled: RolledMotion) -> bool:
        """Take in what was solved for a motion; return whether it is complete, and keys do not show all of it."""
        if self._noticed is not None:
            if time.monotonic() - self._noticed < QUIET and not bpy.app.background:
                return False
            self.follow(rolled)
        if self.solving is None:
            return False
        self.solving.poll()
        return self.solving.complete and self.keyed < self.solving.total

    def forget_from(self, index: int) -> None:
        """Forget frames from one on whose pose was found to differ."""
        if self.solving:
            self.solving.forget_from(index)
            self.keyed, self._noticed = min(self.keyed, len(self.frames)), time.monotonic()

    def close(self) -> None:
        """End what runs outside."""
        if self.solving:
            self.solving.close()
        self.solving, self.keyed, self._noticed = None, 0, None
