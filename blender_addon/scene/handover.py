# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment out to `ssilk rig`, and its answer back."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..contract.arrays import Dressed, Joints, Rig
from ..errors import need

STAGE, RIGGED, REPAIRED = "dressed.usdc", "rigged.usdc", "repaired.usdc"


@dataclass(frozen=True)
class Handover:
    """What was given away: whose it was, and what its prims are called.

    Attributes:
        garment, armature: session_uid of the objects; they may be deleted or renamed meanwhile.
        joints: the character's joints as they were written.
        prims: path of each mesh in the stage by the name of its object.
        stage: the file.
    """

    garment: int
    armature: int
    name: str
    joints: Joints
    prims: dict[str, str]
    stage: Path

    def objects(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Return the garment and the armature.

        Raises:
            SetupError: one was deleted.
        """
        found = {thing.session_uid: thing for thing in bpy.context.scene.objects}
        gone = [uid for uid in (self.garment, self.armature) if uid not in found]
        need(not gone, f"'{self.name}' or its armature was deleted meanwhile; nothing was changed.")
        return found[self.garment], found[self.armature]

    def rig(self, folder: Path) -> Rig:
        """Return what was made of it."""
        from ..contract.read import read_rig

        return read_rig(folder / RIGGED, self.prims[self.name], self.joints)

    def in_blender_words(self, sentence: str) -> str:
        """Return a sentence with names of objects in place of files and prims."""
        for name, prim in sorted(self.prims.items(), key=lambda pair: -len(pair[1])):
            sentence = sentence.replace(f"{self.stage}:{prim}", f"'{name}'")
        return sentence.replace(f"{self.stage}:", "").replace(str(self.stage), "the character")


def hand_over(dressed: Dressed, garment: bpy.types.Object, armature: bpy.types.Object, folder: Path) -> Handover:
    """Write a dressed character into a folder."""
    expose_usd()
    from ..contract.write import write_stage

    prims = write_stage(dressed, folder / STAGE)
    uids = (garment.session_uid, armature.session_uid)
    return Handover(*uids, garment.name, dressed.joints, prims, folder / STAGE)


def rig_command(python: str, folder: Path, handover: Handover, options: Sequence[str]) -> list[str]:
    """Return the command that rigs what was handed over."""
    stage, rigged = str(folder / STAGE), str(folder / RIGGED)
    prim = handover.prims[handover.name]
    return [python, "-m", "ssilk_core", "rig", stage, "--garment", prim, "-o", rigged, "--json", *options]


def inspect_command(python: str, folder: Path, handover: Handover, *, repaired: bool) -> list[str]:
    """Return the command that inspects what was handed over, and writes a repaired copy where that is asked for."""
    fix = ["--fix", str(folder / REPAIRED)] if repaired else []
    prim = handover.prims[handover.name]
    return [python, "-m", "ssilk_core", "inspect", str(folder / STAGE), "--garment", prim, "--json", *fix]


def expose_usd() -> None:
    """Make Blender's own `pxr` importable; the bpy module hides it, Blender does not.

    Raises:
        SetupError: this Blender was built without USD, as those of some Linux distributions are.
    """
    expose = getattr(bpy.utils, "expose_bundled_modules", None)
    if expose:
        expose()
    built = importlib.util.find_spec("pxr")
    need(built, "This Blender was built without USD; take one from blender.org.")
