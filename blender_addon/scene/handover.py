# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment out to `ssilk rig` and `ssilk inspect`, and their answers back."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.scene.assets import Garment, ProxyRig

from ..errors import SetupError
from ..outside.wording import reworded, with_bones
from .gather import GatheredScene
from .objects import Pair

STAGE, RIGGED, REPAIRED = "dressed.usdc", "rigged.usdc", "repaired.usdc"
MOTIONS = "motions"  # folder of the sampled motions beside them
# Modules that are imported one after another, those that others need first.
USD = ("pxr.Tf", "pxr.Ar", "pxr.Sdf", "pxr.Usd", "pxr.UsdGeom", "pxr.UsdSkel", "pxr.UsdUtils",
       "ssilk_usd.writing.files", "ssilk_usd.shots.read")  # fmt: skip


@dataclass(frozen=True)
class Handover:
    """What was given away: whose it was, and the file."""

    pair: Pair
    scene: GatheredScene
    stage: Path

    @property
    def name(self) -> str:
        """The name that the garment had."""
        return self.pair.name

    @property
    def prim(self) -> str:
        """The path of the garment's prim."""
        return self.scene.garment.mesh.path

    def rig(self, folder: Path) -> tuple[Garment, ProxyRig]:
        """Return the garment with classes, and the rig, that were made of it."""
        from ssilk_usd.reading.garment import read_garment
        from ssilk_usd.reading.rig import read_proxy_rig

        path, skeleton = folder / RIGGED, self.scene.character.skeleton
        rig = read_proxy_rig(path, skeleton, garment=self.prim)
        assert rig is not None  # `ssilk rig` always writes one
        return read_garment(path, skeleton, garment=self.prim), rig

    def repaired_points(self, folder: Path) -> np.ndarray:
        """Return the points of the garment, repaired, in Blender's world, shape (V, 3)."""
        from ssilk_usd.reading.garment import read_garment

        repaired = read_garment(folder / REPAIRED, self.scene.character.skeleton, garment=self.prim)
        return self.scene.units.points_from_core(repaired.mesh.points)

    @property
    def words(self) -> dict[str, str]:
        """Names of the objects by what was made of them, for `outside.wording`."""
        things = {mesh.path: name for name, mesh in self.scene.meshes.items()}
        things[self.scene.character.skeleton.path] = self.pair.armature[1]
        named = {f"{file}:{prim}": f"'{name}'" for file in (STAGE, RIGGED, REPAIRED) for prim, name in things.items()}
        return {**named, STAGE: "the character", RIGGED: "its rig", REPAIRED: "the repaired character"}

    def in_blender_words(self, sentence: str) -> str:
        """Return a sentence with names of objects and bones in place of files, prims and joints."""
        return with_bones(reworded(sentence, self.stage.parent, self.words), self.scene.joints.bones)


def hand_over(scene: GatheredScene, pair: Pair, folder: Path) -> Handover:
    """Write a garment with its character into a folder.

    Blender's own exporter would not do: it renames `primvars:ssilk:class`, drops modifiers after the armature and
    knows no proxies.
    """
    expose_usd()
    from ssilk_usd.writing.files import write_scene

    write_scene(folder / STAGE, scene.character, scene.garment, scene.rig, units=scene.units)
    return Handover(pair, scene, folder / STAGE)


def rig_command(python: str, folder: Path, handover: Handover, options: Sequence[str]) -> list[str]:
    """Return the command that rigs what was handed over."""
    stage, rigged = str(folder / STAGE), str(folder / RIGGED)
    known = ["--garment", handover.prim, "-o", rigged, "--json", "--keep-shape"]  # the mesh in Blender stays as it is
    return [python, "-m", "ssilk_core", "rig", stage, *known, *options]


def inspect_command(python: str, folder: Path, handover: Handover, options: Sequence[str]) -> list[str]:
    """Return the command that inspects what was handed over."""
    stage = str(folder / STAGE)
    return [python, "-m", "ssilk_core", "inspect", stage, "--garment", handover.prim, "--json", *options]


def loading_usd() -> Iterator[float]:
    """Import what writes and reads stages module by module, yielding the part that is done: at once it takes 0.3 s.

    Raises:
        SetupError: as `expose_usd` does.
    """
    expose_usd()
    for done, name in enumerate(USD):
        yield done / len(USD)
        importlib.import_module(name)


def expose_usd() -> None:
    """Make Blender's own `pxr` importable; the bpy module hides it, Blender does not.

    Raises:
        SetupError: this Blender was built without USD, as those of some Linux distributions are.
    """
    expose = getattr(bpy.utils, "expose_bundled_modules", None)
    if expose:
        expose()
    if not importlib.util.find_spec("pxr"):
        raise SetupError("This Blender was built without USD; take one from blender.org.")
