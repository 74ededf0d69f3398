# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment out to `ssilk rig`, and its answer back."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..contract.arrays import Dressed, Joints, Rig
from ..errors import need
from .objects import Pair

STAGE, RIGGED, REPAIRED = "dressed.usdc", "rigged.usdc", "repaired.usdc"
MOTIONS = "motions"  # folder of the sampled motions beside them
USD = ("Tf", "Ar", "Sdf", "Usd", "UsdGeom", "UsdSkel")  # modules of `pxr`, the ones that others need first


@dataclass(frozen=True)
class Handover:
    """What was given away: whose it was, and what its prims are called.

    Attributes:
        joints: the character's joints as they were written.
        prims: path of each mesh in the stage by the name of its object.
        stage: the file.
    """

    pair: Pair
    joints: Joints
    prims: dict[str, str]
    stage: Path

    @property
    def name(self) -> str:
        """The name that the garment had."""
        return self.pair.name

    def rig(self, folder: Path) -> Rig:
        """Return what was made of it."""
        from ..contract.read import read_rig

        return read_rig(folder / RIGGED, self.prims[self.name], self.joints)

    def in_blender_words(self, sentence: str) -> str:
        """Return a sentence with names of objects in place of files and prims."""
        for name, prim in sorted(self.prims.items(), key=lambda pair: -len(pair[1])):
            sentence = sentence.replace(f"{self.stage}:{prim}", f"'{name}'")
        return sentence.replace(f"{self.stage}:", "").replace(str(self.stage), "the character")


def hand_over(dressed: Dressed, pair: Pair, folder: Path) -> Handover:
    """Write a dressed character into a folder."""
    expose_usd()
    from ..contract.write import write_stage

    return Handover(pair, dressed.joints, write_stage(dressed, folder / STAGE), folder / STAGE)


def rig_command(python: str, folder: Path, handover: Handover, options: Sequence[str]) -> list[str]:
    """Return the command that rigs what was handed over."""
    stage, rigged = str(folder / STAGE), str(folder / RIGGED)
    prim = handover.prims[handover.name]
    return [python, "-m", "ssilk_core", "rig", stage, "--garment", prim, "-o", rigged, "--json", *options]


def inspect_command(python: str, folder: Path, handover: Handover, options: Sequence[str]) -> list[str]:
    """Return the command that inspects what was handed over."""
    prim = handover.prims[handover.name]
    return [python, "-m", "ssilk_core", "inspect", str(folder / STAGE), "--garment", prim, "--json", *options]


def loading_usd() -> Iterator[float]:
    """Import Blender's own `pxr` module by module, yielding the part that is done: at once it takes 0.1 s.

    Raises:
        SetupError: as `expose_usd` does.
    """
    expose_usd()
    for done, name in enumerate(USD):
        yield done / len(USD)
        importlib.import_module(f"pxr.{name}")


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
