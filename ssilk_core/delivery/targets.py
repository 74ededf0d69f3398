# SPDX-License-Identifier: Apache-2.0
"""Targets of a bake: the influences, units, axes and file formats that each receiving application supports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from ..errors import fail
from ..scene.assets import Body, Deformer, SkinWeights

GLB = ".glb"  # suffix of a glTF binary, which is written and read without USD


@dataclass(frozen=True, kw_only=True)
class Target:
    """Requirements of one kind of receiving application.

    Attributes:
        influences: largest number of joints per vertex; None for no limit.
        meters_per_unit, up_axis: units [m] and up axis of the file; None for those of the character's stage.
        lean: omit joints at rest from the animation, and store the root's path as a translation of the SkelRoot.
            The layer is smaller, and exact far from the origin. The receiver must compose transforms as USD does.
        variants: it selects variants, so that a single file keeps hidden faces of bodies as one. For others these
            faces are left out of it. Layers keep them for all, because whoever reads layers composes them.
        suffixes: file suffixes that it accepts; layers need ".usdc".
        about: one-line description.
    """

    influences: int | None = None
    meters_per_unit: float | None = None
    up_axis: Literal["Y", "Z"] | None = None
    lean: bool = False
    variants: bool = False
    suffixes: tuple[str, ...] = (".usdc", ".usd", ".usda", ".usdz")
    about: str = ""


# To add a target, add an entry: options, checks, bakes and their tests use this table.
TARGETS = {
    "usd": Target(lean=True, variants=True, about="film pipelines and renderers: the stage's units, nothing capped"),
    "blender": Target(meters_per_unit=1.0, up_axis="Z", variants=True, about="metres, z up, every joint animated"),
    "game8": Target(influences=8, meters_per_unit=1.0, up_axis="Y", about="8 influences, as two sets of glTF hold"),
    "game4": Target(influences=4, meters_per_unit=1.0, up_axis="Y", about="4 influences, as one set of glTF holds"),
    "arkit": Target(
        influences=4, meters_per_unit=1.0, up_axis="Y", suffixes=(".usdz",), about="4 influences in one usdz package"
    ),
    "glb": Target(meters_per_unit=1.0, up_axis="Y", suffixes=(GLB,), about="one glTF binary, four influences a set"),
    "glb4": Target(
        influences=4,
        meters_per_unit=1.0,
        up_axis="Y",
        suffixes=(GLB,),
        about="one glTF binary, a single set",
    ),
}


def check_influences(found: int, name: str, model: str) -> None:
    """Raise `SsilkError` if a model has more influences per vertex, `found`, than target `name` supports."""
    most = TARGETS[name].influences
    if not (most is None or found <= most):
        fail(
            model,
            f"{found} joints move a vertex",
            f"--target {name} takes {most}",
            f"reduce them with 'ssilk reduce --influences {most}' and the motions of the shots",
        )


def cap_influences(deformer: Deformer, target: Target) -> Deformer:
    """Keep only the heaviest influences of each vertex of a garment and its character's bodies.

    The remaining weights of a vertex are scaled to a sum of one. This serves bodies and linear blend skinning. A
    trained garment with too many influences has already been reduced or refused (`check_influences`).
    """
    most = target.influences
    if most is None:
        return deformer
    scene = deformer.scene
    bodies = tuple(Body(body.mesh, _heaviest(body.skin, most)) for body in scene.character.bodies)
    scene = replace(scene, character=replace(scene.character, bodies=bodies))
    return replace(deformer, scene=scene, skin=_heaviest(deformer.skin, most))


def _heaviest(skin: SkinWeights, most: int) -> SkinWeights:
    return SkinWeights.from_dense(skin.path, skin.dense(int(skin.indices.max()) + 1), most)
