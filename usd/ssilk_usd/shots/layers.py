# SPDX-License-Identifier: Apache-2.0
"""A bake as layers: a lasting asset, and for each shot one small layer that a new bake replaces.

    FOLDER/assets/cape/asset.usda        component; payload and variants
    FOLDER/assets/cape/geometry.usdc     the payload: meshes, skeleton, blendshapes
    FOLDER/assets/cape/info.usda         a sublayer of the component: what it says of itself, such as its version
    FOLDER/assets/cape/used.json         what the name is used for; `ssilk_core.delivery.bake.names_used` writes it
    FOLDER/shots/walk/cape/anim.usdc     what moves; opens by itself
    FOLDER/shots/walk/cape/points.usdc   a point cache, where one is asked for
    FOLDER/shots/walk/shot.usda          every garment of the shot

Artists put layers of their own above these: nothing here is edited in place, and what has not changed is not touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

from .samples import PATH_OP

DEFORMATION, QUALITY, LEVEL = "deformation", "quality", "level"


@dataclass(frozen=True)
class Layout:
    """Paths of the files of one garment in one shot; `garment` is also the name of its prim."""

    folder: Path
    garment: str
    shot: str

    @property
    def asset(self) -> Path:
        return self.folder / "assets" / self.garment / "asset.usda"

    @property
    def geometry(self) -> Path:
        return self.asset.with_name("geometry.usdc")

    @property
    def info(self) -> Path:
        return self.asset.with_name("info.usda")

    @property
    def animation(self) -> Path:
        return self.folder / "shots" / self.shot / self.garment / "anim.usdc"

    @property
    def points(self) -> Path:
        return self.animation.with_name("points.usdc")

    @property
    def stage(self) -> Path:
        return self.folder / "shots" / self.shot / "shot.usda"


def variant(prim: Usd.Prim, name: str, choice: str) -> Usd.EditContext:
    """Add a variant and select it; return the context that authors in it."""
    variants = prim.GetVariantSets().AddVariantSet(name)
    variants.AddVariant(choice)
    variants.SetVariantSelection(choice)
    return Usd.EditContext(prim.GetStage(), variants.GetVariantEditTarget())


def define_path(root: Usd.Prim) -> Usd.Attribute:
    """Make the path of the character's root the translation of a SkelRoot."""
    UsdGeom.Xformable(root).CreateXformOpOrderAttr([PATH_OP])
    return root.CreateAttribute(PATH_OP, Sdf.ValueTypeNames.Double3, False)
