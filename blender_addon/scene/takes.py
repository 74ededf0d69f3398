# SPDX-License-Identifier: GPL-3.0-or-later
"""The motions chosen for a garment: sampled in Blender, or in USD files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..joints import Joints
from ..names import identifiers
from .gather import ROOT
from .handover import MOTIONS, loading_usd
from .motions import FILE, Source
from .sampling import SampledTake, prepare_takes, sample


@dataclass(frozen=True, eq=False)
class ChosenMotions:
    """Motions to train on.

    Attributes:
        takes: those that Blender plays, to be sampled.
        files: those that lie in USD files.
    """

    takes: list[SampledTake]
    files: list[Path]

    @classmethod
    def of(cls, garment: bpy.types.Object, armature: bpy.types.Object) -> ChosenMotions:
        """Return what was chosen for a garment.

        Raises:
            SetupError: a motion is gone, or the armature cannot be evaluated.
        """
        used = [item for item in garment.ssilk.training.motions if item.use]
        played = [Source(item.kind, item.name, item.track) for item in used if item.kind != FILE]
        files = [Path(bpy.path.abspath(item.name)) for item in used if item.kind == FILE]
        return cls(prepare_takes(armature, played) if played else [], files)

    @property
    def names(self) -> list[str]:
        """Names of the files that takes are written to."""
        return [f"{name}.usdc" for name in identifiers(take.source.name for take in self.takes)]

    @property
    def words(self) -> dict[str, str]:
        """Names of the motions by the files that they are written to, for `outside.wording`."""
        return {f"{MOTIONS}/{name}": f"'{take.source.name}'" for name, take in zip(self.names, self.takes)}

    def writing(self, armature: bpy.types.Object, joints: Joints, folder: Path) -> Iterator[float]:
        """Sample the takes and write them into a new folder, yielding the part of each of both that is done.

        Args:
            joints: of the character.

        Raises:
            SetupError: as `sample` does.
        """
        yield from sample(armature, joints, self.takes)
        yield from loading_usd()
        from ssilk_usd.writing.files import write_motion

        folder.mkdir()
        for done, (name, take) in enumerate(zip(self.names, self.takes)):
            yield done / len(self.takes)
            write_motion(folder / name, take.motion(joints), joints.skeleton(ROOT))
