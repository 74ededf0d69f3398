# SPDX-License-Identifier: Apache-2.0
"""Blendshapes that are on: a mesh is read in the shape that UsdSkel shows at the earliest time of its stage.

Blendshapes make body types, and the shape that a garment was fitted to. Shots may animate them: those of bodies are
followed (`body_shapes`). Garments keep the shape of the character's stage, and `animated_shapes` says which ones a
motion changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats

from ..opening.shaped import weighed_offsets
from ..opening.stage import EARLIEST, PRIMS, StageLike, named, needs_whole_files, open_stage
from .mesh import is_garment
from .motion import find_animation
from .skeleton import bound_skeleton, find_skeleton
from .spaces import SkelSource

SAME = 1e-3  # difference of weights that nobody sees


def shape_offsets(prim: Usd.Prim, skel: SkelSource, code: Usd.TimeCode = EARLIEST) -> Floats | None:
    """Return how far the blendshapes that are on move a mesh's points in its own space, (V, 3); None without any."""
    weights = shape_weights(prim, skel, code)
    if weights is None or not np.any(weights):
        return None
    return weighed_offsets(prim, weights)


def shape_weights(prim: Usd.Prim, skel: SkelSource, code: Usd.TimeCode = EARLIEST) -> list[float] | None:
    """Return the weight of each blendshape of a mesh at a time; None where nothing weighs them."""
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(skel.root), PRIMS)
    query = cache.GetSkinningQuery(prim)
    animation = cache.GetSkelQuery(UsdSkel.Skeleton(skel.prim)).GetAnimQuery()
    if not (query and query.HasBlendShapes() and animation):
        return None
    found, mapper = animation.ComputeBlendShapeWeights(code), query.GetBlendShapeMapper()
    if found is None or mapper is None or mapper.IsNull():
        return None
    remapped = mapper.Remap(found)
    return None if remapped is None else [float(weight) for weight in remapped]


@dataclass(frozen=True)
class AnimatedShape:
    """A blendshape of a garment whose weight in a motion is another one than that it was read with.

    Attributes:
        mesh: name of its mesh.
        weight: that the character was read with; lowest, highest: in the motion.
    """

    name: str
    mesh: str
    weight: float
    lowest: float
    highest: float

    def __str__(self) -> str:
        course = (
            f"from {self.lowest:.3g} to {self.highest:.3g}" if self.lowest != self.highest else f"{self.lowest:.3g}"
        )
        return f"'{self.name}' of {self.mesh}, {course} where the character's stage has {self.weight:.3g}"


def tell_animated_shapes(motion: str, found: Sequence[AnimatedShape], report: Reporter) -> None:
    """Report the blendshapes of garments that a motion changes and that are not followed."""
    if found:
        firsts: dict[str, AnimatedShape] = {}
        for each in found:
            firsts.setdefault(each.mesh, each)  # those of one hide no other's
        text = f"{motion}: it weighs blendshapes that are not followed: {'; '.join(map(str, firsts.values()))}"
        more = f", and {len(found) - len(firsts)} more" if len(found) > len(firsts) else ""
        report(Message(f"{text}{more}; what is written has the garment of the character's stage", "warning"))


@needs_whole_files
def animated_shapes(
    source: StageLike, motion: str, *, root: str | None = None, garment: str | None = None
) -> list[AnimatedShape]:
    """Return the blendshapes of a character's garments that a motion weighs otherwise than its stage does.

    A shape that a shot's animation does not name is off in that shot; a clip that stands alone leaves it as it is.

    Args:
        source: the character's stage.
        motion: "file[:/Prim/Path]", as for `read_motion`.
        root: the character, if there are several.
        garment: a mesh that is not marked as one, by path or name.

    Raises:
        SsilkError: as `read_motion` and `read_character`.
    """
    file, prim = split_location(motion)
    of_motion = open_stage(file)
    found_animation, placed = find_animation(of_motion, prim, root)
    animation = UsdSkel.Animation(found_animation)
    names = [str(name) for name in animation.GetBlendShapesAttr().Get() or ()]
    if not names and placed is None:
        return []
    stage = open_stage(source)
    skel = find_skeleton(stage, root=root, garment=garment)
    attribute = animation.GetBlendShapeWeightsAttr()
    codes = attribute.GetTimeSamples() or [Usd.TimeCode.Default()]
    given = [row for row in (attribute.Get(code) for code in codes) if row is not None and len(row) == len(names)]
    rows = np.array(given if given or placed is None else [[0.0] * len(names)])
    found = []
    for mesh in Usd.PrimRange(skel.root, PRIMS):
        if not (len(rows) and mesh.IsA(UsdGeom.Mesh) and bound_skeleton(mesh) == skel.prim):
            continue
        if not (is_garment(mesh) or (garment and named([mesh], garment))):
            continue
        own = [str(name) for name in UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get() or ()]
        weights = shape_weights(mesh, skel) or [0.0] * len(own)
        for name, weight in zip(own, weights):
            unnamed = weight if placed is None else 0.0
            course = rows[:, names.index(name)] if name in names else np.array([unnamed])
            if np.abs(course - weight).max() > SAME:
                low, high = float(course.min()), float(course.max())
                found.append(AnimatedShape(name, mesh.GetName(), weight, low, high))
    return found
