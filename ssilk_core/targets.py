# SPDX-License-Identifier: Apache-2.0
"""What those who receive a bake can read: influences, units, axes, packaging."""

from __future__ import annotations

from dataclasses import dataclass, replace

from .assets import Body, Deformer, SkinWeights


@dataclass(frozen=True, kw_only=True)
class Target:
    """A kind of receiver.

    Attributes:
        influences: the most joints that move a vertex, or None for as many as the garment uses.
        meters_per_unit, up_axis: units and up axis of the file, or None for those of the character's stage.
        lean: leave joints that stay at rest out of the animation, and store the root's path as a translation of the
            SkelRoot: smaller, and exact far from the origin, but for readers that compose transforms as USD does.
        suffixes: of the files it takes.
        about: one line for people.
    """

    influences: int | None = None
    meters_per_unit: float | None = None
    up_axis: str | None = None
    lean: bool = False
    suffixes: tuple[str, ...] = (".usdc", ".usd", ".usda", ".usdz")
    about: str = ""


TARGETS = {
    "usd": Target(lean=True, about="film pipelines and renderers: the stage's units, nothing capped"),
    "blender": Target(meters_per_unit=1.0, up_axis="Z", about="metres, z up, every joint animated"),
    "game8": Target(influences=8, meters_per_unit=1.0, up_axis="Y", about="8 influences, as two sets of glTF hold"),
    "game4": Target(influences=4, meters_per_unit=1.0, up_axis="Y", about="4 influences, as one set of glTF holds"),
    "arkit": Target(
        influences=4, meters_per_unit=1.0, up_axis="Y", suffixes=(".usdz",), about="4 influences in one usdz package"
    ),
}


def fitted(deformer: Deformer, target: Target) -> Deformer:
    """Return a garment and its character's bodies with each vertex moved by its heaviest influences alone.

    What is left of a vertex's weights is scaled to a sum of one. Nothing changes where nothing is capped.
    """
    most = target.influences
    if most is None:
        return deformer
    scene = deformer.scene
    bodies = tuple(Body(body.mesh, _capped(body.skin, most)) for body in scene.character.bodies)
    scene = replace(scene, character=replace(scene.character, bodies=bodies))
    return replace(deformer, scene=scene, skin=_capped(deformer.skin, most))


def _capped(skin: SkinWeights, most: int) -> SkinWeights:
    return SkinWeights.from_dense(skin.path, skin.dense(int(skin.indices.max()) + 1), most)
