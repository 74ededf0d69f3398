# SPDX-License-Identifier: Apache-2.0
"""Read a garment from the character's stage or from its own file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.scene.assets import Floats, Garment, Ints, Mesh, Skeleton, SkinWeights

from ..names import CLASS, LBS_SKIN, LEVEL, PIN, PROXIES, STIFFNESS
from ..opening.stage import (
    EARLIEST,
    PRIMS,
    StageLike,
    has_value,
    listed,
    location,
    named,
    needs_whole_files,
    open_stage,
    stage_name,
    world_matrix,
)
from ..opening.times import change_times
from ..units import StageUnits
from .bindings import need_skinned
from .carried import carried_by
from .character import geom_to_core, is_skinned
from .mesh import display_colour, is_drawn, is_garment, read_mesh, rendered
from .rebinding import blended_moves, character_source, common_move, joint_moves, need_one_motion, used_moves
from .shapes import shape_offsets
from .skeleton import bound_skeleton, character_skeleton, find_skeleton, skeletons
from .skin import match_joints, read_influences, read_skin, tell_method
from .spaces import SkelSource
from .surface import read_surface, tell_parts


@needs_whole_files
def read_garment(
    source: StageLike,
    skeleton: Skeleton,
    *,
    garment: str | None = None,
    root: str | None = None,
    shaped: bool = True,
    report: Reporter = silent,
) -> Garment:
    """Read a garment at rest, in the core's bind space [m], y up.

    A mesh with influences is placed by its geomBindTransform, as in UsdSkel; one that is bound to another Skeleton
    than the character's is brought into the character's bind pose (`rebinding`). One without influences is placed by
    its world transform: relative to the character in a stage with one, and absolutely in its own file. One without
    influences whose xforms move as a joint does is bound to that joint, at its bind pose.

    Args:
        source: the character's stage or a file with garments, each with its own units and axes.
        skeleton: skeleton of the character; weights are remapped to its joints by name.
        garment: the mesh, by path or name, if there are several.
        root: the character that the garment is fitted to, if the stage has several.
        shaped: with the blendshapes that are on at the earliest time; those of a baked garment move it in its shot.
        report: hears of weights that do not sum to one, of other skinning than linear blend skinning, and of fabrics
            of parts.

    Raises:
        SsilkError: there is no garment or several, or the data is malformed.
    """
    stage = open_stage(source)
    prim = find_garment(stage, garment, root)
    skel = fitted_skeleton(prim, root)
    place = garment_place(prim, skel, skeleton)
    mesh = read_mesh(prim, place.to_core, shape_offsets(prim, skel) if skel and shaped else None)
    mesh = mesh if place.moves is None else replace(mesh, points=place.moved(mesh.points))
    mesh = with_stiffness(mesh, prim)
    skin = lbs_skin(prim, skel.joints if skel else (), skeleton, report)
    if skel and is_skinned(prim, skel):
        need_skinned(prim)
        tell_method(prim, report)
    carried = carried_by(prim, skel) if skel and skin is None and not has_value(prim, PROXIES) else None
    if carried:
        assert skel is not None
        joint = match_joints((skel.joints[carried.joint],), skeleton.joint_names)[0]
        skin = SkinWeights.rigid(mesh.path, joint, mesh.vertex_count)
    pins, levels = (_per_point(prim, name) for name in (PIN, LEVEL))
    pinned = None if pins is None else (pins >= 0.5).astype(np.int64)  # may be painted as weights
    surface = read_surface(prim, mesh)
    tell_parts(prim, report)
    _tell_changes(prim, report)
    return Garment(mesh, skin, _whole(prim, _per_point(prim, CLASS)), pinned, levels, surface, display_colour(prim))


def with_stiffness(mesh: Mesh, prim: Usd.Prim) -> Mesh:
    """Return a garment's mesh with the stiffness that is painted on a prim of as many points."""
    return replace(mesh, stiffness=_per_point(prim, STIFFNESS))


def find_garment(stage: Usd.Stage, garment: str | None = None, root: str | None = None) -> Usd.Prim:
    """Find the garment mesh of a stage: the named one, the only marked one, or the only mesh without a character.

    Of several, it is the one beneath the SkelRoot that `root` names, itself or by its Skeleton.

    Raises:
        SsilkError: there is no such mesh, or no unique one; the message lists the meshes.
    """
    where = stage_name(stage)
    meshes = [prim for prim in Usd.PrimRange.Stage(stage, PRIMS) if prim.IsA(UsdGeom.Mesh)]
    marked = [prim for prim in meshes if is_garment(prim)]
    if garment is not None:
        found = named(meshes, garment)
        if not found:
            fail(where, f"no mesh is named '{garment}'", f"there are {listed(meshes)}", "choose one with --garment")
    else:
        found = marked if marked or skeletons(stage) else [prim for prim in meshes if is_drawn(prim)]
        if not found:
            fail(
                where,
                f"no mesh is marked as a garment; the meshes are {listed(meshes)}",
                "a garment has primvars:ssilk:class or ssilk:garment = true",
                "name it with --garment",
            )
        found = rendered(found)
    if len(found) > 1 and root is not None:
        tops = [top.GetPath() for top, skeleton in skeletons(stage) if named([top, skeleton], root)]
        found = [prim for prim in found if any(prim.GetPath().HasPrefix(top) for top in tops)] or found
    if len(found) != 1:
        many = "there are several garments" if garment is None else f"several meshes are, or lie beneath, '{garment}'"
        fail(where, f"{many}: {listed(found)}", "one is needed", "choose one with --garment")
    return found[0]


def fitted_skeleton(prim: Usd.Prim, root: str | None = None) -> SkelSource | None:
    """Return the skeleton in its stage that a garment is fitted to; None if the stage has no character."""
    stage = prim.GetStage()
    found, bound = skeletons(stage), bound_skeleton(prim)
    if not found:
        return None
    above = [skeleton for top, skeleton in found if prim.GetPath().HasPrefix(top.GetPath())]
    own = bound or (above[0] if len(above) == 1 else None)
    return find_skeleton(stage, root=str(own.GetPath()) if own else root, garment=str(prim.GetPath()))


@dataclass(frozen=True, eq=False)
class GarmentPlace:
    """Where a garment is in the character's bind pose.

    Attributes:
        to_core: from its local space to the core's bind space [m], column vectors, shape (4, 4).
        moves: what then moves each point, shape (V, 4, 4); None where all of them stay.
    """

    to_core: Floats
    moves: Floats | None = None

    def moved(self, points: Floats) -> Floats:
        """Return points (V, 3) [m], which `to_core` has transformed, where the garment is."""
        if self.moves is None:
            return points
        return (self.moves[:, :3, :3] @ points[:, :, None])[..., 0] + self.moves[:, :3, 3]

    def offsets_to_local(self, offsets: Floats, rows: Ints) -> Floats:
        """Return offsets (N, 3) [m] of the points in `rows` (N,) in the garment's local space."""
        if self.moves is not None:
            offsets = np.linalg.solve(self.moves[rows, :3, :3], offsets[:, :, None])[..., 0]
        return offsets @ np.linalg.inv(self.to_core[:3, :3]).T


def garment_place(prim: Usd.Prim, skel: SkelSource | None, skeleton: Skeleton | None) -> GarmentPlace:
    """Return where a garment is on the character with `skeleton`, or on that of its own stage without one.

    Args:
        skel: of `fitted_skeleton`.
    """
    if skel is None:
        return GarmentPlace(StageUnits.of(prim.GetStage()).matrix @ world_matrix(prim))
    if skeleton is None:
        skeleton = character_skeleton(skel)
    if is_skinned(prim, skel):
        return _rebound(prim, skel, skeleton)
    if carried := carried_by(prim, skel):
        moves, to_core = joint_moves(skel, skeleton), skel.bind_to_core @ carried.to_bind
        return GarmentPlace(to_core if moves is None else moves[carried.joint] @ to_core)
    skel = character_source(skel.stage, skeleton) or skel
    return GarmentPlace(skel.bind_to_core @ skel.world_to_bind @ world_matrix(prim))


def _rebound(prim: Usd.Prim, skel: SkelSource, skeleton: Skeleton) -> GarmentPlace:
    """Return where a skinned garment is, which may be bound to a Skeleton of its own."""
    to_core, moves = geom_to_core(prim, skel), joint_moves(skel, skeleton)
    if location(skel.prim) == skeleton.path:
        return GarmentPlace(to_core)
    influences = read_influences(prim, skel.joints)
    if influences is not None:
        need_one_motion(skel, skeleton, influences.used_joints())
    if moves is None or influences is None:
        return GarmentPlace(to_core)
    ordered, used = used_moves(moves, influences, skel.joints)
    common = common_move(used)
    if common is not None:
        return GarmentPlace(common @ to_core)
    return GarmentPlace(to_core, blended_moves(ordered, influences))


def lbs_skin(
    prim: Usd.Prim, joints: tuple[str, ...], skeleton: Skeleton, report: Reporter = silent
) -> SkinWeights | None:
    """Return a garment's LBS weights over the character's joints, or None.

    Weights that were saved separately next to a proxy rig take precedence.
    """
    if has_value(prim, LBS_SKIN[0]):
        influences = read_influences(prim, joints, LBS_SKIN)
        assert influences is not None
        return SkinWeights(influences.path, *influences.onto(skeleton.joint_names))
    return None if has_value(prim, PROXIES) else read_skin(prim, joints, skeleton.joint_names, report)


def _per_point(prim: Usd.Prim, name: str) -> Floats | None:
    """Return a primvar with one value for each point, or None; `Garment` checks the count."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name.removeprefix("primvars:"))
    if not primvar or not primvar.HasAuthoredValue():
        return None
    interpolation = primvar.GetInterpolation()
    if interpolation not in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying):
        fail(
            location(prim),
            f"{name} has {interpolation} interpolation",
            "it needs one value per point (vertex interpolation)",
            "paint it on points",
        )
    return np.array(primvar.ComputeFlattened(EARLIEST), dtype=np.float64).reshape(-1)


def _tell_changes(prim: Usd.Prim, report: Reporter) -> None:
    """Warn of a stiffness that changes in time: cloth has one."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(STIFFNESS.removeprefix("primvars:"))
    times = change_times([primvar.GetAttr()]) if primvar else []
    if len(times) < 2:
        return
    first = np.array(primvar.ComputeFlattened(times[0]))
    if any(not np.array_equal(first, np.array(primvar.ComputeFlattened(time))) for time in times[1:]):
        text = f"{STIFFNESS} changes from time code {times[0]:g} to {times[-1]:g}"
        report(Message(f"{location(prim)}: {text}; cloth has its value at the first of these throughout", "warning"))


def _whole(prim: Usd.Prim, classes: Floats | None) -> Ints | None:
    """Return vertex classes as integers; `Garment` checks their range."""
    if classes is None:
        return None
    broken = int(np.count_nonzero(classes != np.round(classes)))
    if broken:
        fail(location(prim), f"{broken} vertex classes are not integers", "classes are 0, 1 or 2", "paint them again")
    return classes.astype(np.int64)
