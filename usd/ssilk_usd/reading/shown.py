# SPDX-License-Identifier: Apache-2.0
"""How a shot shows a character's meshes otherwise than the character's stage, which is what cloth meets.

Blendshapes that it weighs otherwise or alone has, points that it has moved, point caches, and parts that it hides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats

from ..opening.stage import EARLIEST, PRIMS, StageLike, apply, needs_whole_files, open_stage
from ..opening.times import change_times, visibility_attributes
from .animation import animation_source
from .character import geom_to_core, is_skinned
from .clips import spread
from .mesh import is_drawn, is_garment, is_rider
from .motion import find_animation
from .shapes import animated_shapes, shape_offsets, tell_animated_shapes
from .skeleton import bound_skeleton, find_skeleton
from .skin import match_joints
from .spaces import SkelSource

SAME = 1e-3  # of a mesh's size, by which its points may differ unseen
LOOKED_AT = 32  # times at which points are compared


def tell_shown_otherwise(
    source: StageLike,
    motions: Iterable[str],
    report: Reporter,
    *,
    root: str | None = None,
    garment: str | None = None,
) -> None:
    """Report what of a character's meshes motions show otherwise than its stage, in which cloth does not meet them.

    Args are those of `animated_shapes`, for each of several motions.

    Raises:
        SsilkError: as `animated_shapes`.
    """
    for motion in motions:
        weighed = animated_shapes(source, motion, root=root, garment=garment)
        tell_animated_shapes(motion, weighed, report)
        known = {found.mesh for found in weighed}
        for text in shown_otherwise(source, motion, root=root, garment=garment, known=known):
            report(Message(f"{motion}: {text}", "warning"))


@needs_whole_files
def shown_otherwise(
    source: StageLike,
    motion: str,
    *,
    root: str | None = None,
    garment: str | None = None,
    known: Iterable[str] = (),
) -> list[str]:
    """Return in words what a motion's stage shows of a character's meshes otherwise than the character's stage.

    A motion that stands alone shows no mesh. Meshes are the same where their names are, or where their faces are.

    Args:
        source, motion, root, garment: as for `animated_shapes`.
        known: names of meshes whose shape is known to differ.
    """
    stage, (file, prim) = open_stage(source), split_location(motion)
    skel = find_skeleton(stage, root=root, garment=garment)
    own = {mesh.GetName(): mesh for mesh in _meshes(skel) if is_drawn(mesh)}
    found = [_hidden(mesh, skel, " of its own stage") for mesh in own.values()]
    _, placed = find_animation(of_motion := open_stage(file), prim, root)
    if placed is None:
        return [*filter(None, found)]
    try:
        there = find_skeleton(of_motion, root=str(placed.GetPath()), garment=garment)
    except SsilkError:  # a motion plays on a skeleton that nothing can be bound to, without bind pose
        return [*filter(None, found)]
    if there.prim == skel.prim:
        return [*filter(None, found)]
    same = _same_meshes(there, own)
    for mesh, original in same.items():
        if not is_garment(original) and _is_cache(mesh, there):
            text = f"{mesh.GetName()} is a point cache, which is not followed"
            found.append(f"{text}; cloth meets it as its joints move it")
    for mesh, original in same.items():
        if bound_skeleton(mesh) != there.prim:
            continue
        name, known_by = mesh.GetName(), original.GetName()
        if not is_garment(original) and known_by not in known and (away := _moved(original, skel, mesh, there)):
            text = f"it shapes {name} otherwise, by up to {1000 * away:.3g} mm"
            found.append(f"{text}; cloth meets the shape of the character's stage throughout")
        found.append(_hidden(mesh, there))
    return [*filter(None, found)]


def _meshes(skel: SkelSource) -> Iterator[Usd.Prim]:
    """Yield the meshes that are bound to a skeleton; what rides on a garment is placed by its cloth."""
    for prim in Usd.PrimRange(skel.root, PRIMS):
        if prim.IsA(UsdGeom.Mesh) and bound_skeleton(prim) == skel.prim and not is_rider(prim):
            yield prim


def _same_meshes(there: SkelSource, own: Mapping[str, Usd.Prim]) -> dict[Usd.Prim, Usd.Prim]:
    """Return for meshes of a shot which of a character's own meshes they are.

    They have its name, or its faces alone: programs add a namespace to names, or a number.
    """
    meshes = [prim for prim in Usd.PrimRange(there.root, PRIMS) if prim.IsA(UsdGeom.Mesh)]
    found = {mesh: own[mesh.GetName()] for mesh in meshes if mesh.GetName() in own}
    others = [mesh for mesh in meshes if mesh not in found]
    missing = [mesh for mesh in own.values() if others and mesh not in found.values()]
    for faces in dict.fromkeys(map(_faces, missing)):
        pairs = [[mesh for mesh in each if _faces(mesh) == faces] for each in (others, missing)]
        if len(pairs[0]) == len(pairs[1]):  # such as two shoes, in the order of their stages
            found.update(zip(*pairs))
    return found


def _faces(mesh: Usd.Prim) -> tuple[bytes, bytes]:
    """Return the faces of a mesh, to be compared."""
    described = UsdGeom.Mesh(mesh)
    values = (described.GetFaceVertexCountsAttr().Get(EARLIEST), described.GetFaceVertexIndicesAttr().Get(EARLIEST))
    counts, indices = (np.array(each or [], dtype=np.int32).tobytes() for each in values)
    return counts, indices


def _is_cache(mesh: Usd.Prim, skel: SkelSource) -> bool:
    """Return whether no joint moves a mesh, and its points change over time."""
    return not is_skinned(mesh, skel) and len(change_times([UsdGeom.Mesh(mesh).GetPointsAttr()])) > 1


def _moved(own: Usd.Prim, skel: SkelSource, other: Usd.Prim, there: SkelSource) -> float:
    """Return how far points of a mesh in a shot are at most from where its character has them [m]; 0 if unseen.

    The same points are compared: a mesh of another number of points, or in another bind pose, is another one.
    """
    if not _same_binds(skel, there):
        return 0.0
    before = _core_points(own, skel, EARLIEST)
    away = 0.0
    for code in _codes(other, there):
        after = _core_points(other, there, code)
        if len(after) != len(before) or not len(before):
            return 0.0
        away = max(away, float(np.linalg.norm(after - before, axis=1).max()))
    return away if away > SAME * float(np.ptp(before, axis=0).max(initial=0)) else 0.0


def _codes(mesh: Usd.Prim, skel: SkelSource) -> list[Usd.TimeCode]:
    """Return times at which blendshapes of a mesh change, some of them if many; the earliest if none."""
    animation = animation_source(skel.prim).prim
    shaped = animation and UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get()
    attributes = [UsdSkel.Animation(animation).GetBlendShapeWeightsAttr()] if shaped else []
    times = spread(np.array(change_times(attributes)), LOOKED_AT)
    return [Usd.TimeCode(time) for time in times.tolist()] or [EARLIEST]


def _core_points(mesh: Usd.Prim, skel: SkelSource, code: Usd.TimeCode) -> Floats:
    """Return the points of a mesh with the blendshapes that are on, in the core's bind space [m], shape (V, 3).

    UsdSkel begins with the earliest points, whatever later ones are.
    """
    points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get(EARLIEST) or [], dtype=np.float64).reshape(-1, 3)
    offsets = shape_offsets(mesh, skel, code)
    shaped = points if offsets is None or len(offsets) != len(points) else points + offsets
    return apply(geom_to_core(mesh, skel), shaped)


def _same_binds(one: SkelSource, other: SkelSource) -> bool:
    """Return whether the joints that two skeletons have in common are bound alike."""
    match = np.array(match_joints(one.joints, other.joints))
    binds = (one.binds_to_core(one.bind[match >= 0]), other.binds_to_core(other.bind[match[match >= 0]]))
    size = float(np.abs(binds[0][:, :3, 3]).max(initial=0)) + SAME
    return bool(np.abs(binds[0] - binds[1]).max(initial=0) < SAME * max(size, 1))


def _hidden(mesh: Usd.Prim, skel: SkelSource, where: str = "") -> str:
    """Return in words that a mesh is hidden while its skeleton, by which a shot is hidden, is not; else empty."""
    for code in change_times([*visibility_attributes(mesh), *visibility_attributes(skel.prim)]) or [0.0]:
        at = (UsdGeom.Imageable(prim).ComputeVisibility(Usd.TimeCode(code)) for prim in (mesh, skel.prim))
        of_mesh, of_character = at
        if of_mesh == UsdGeom.Tokens.invisible != of_character:
            text = f"{mesh.GetName()} is hidden at time code {code:g}{where}"
            return f"{text}; it is met, and seen in what is written, as long as the character is"
    return ""
