# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment with its character from Blender's data, at rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np
from ssilk_usd.units import StageUnits

from ssilk_core.scene.assets import Body, Character, Garment, Mesh, ProxyRig, SkinWeights

from ..arrays.joints import Joints, identifiers
from ..errors import SetupError
from .armature import leader_of, read_joints
from .classes import current_classes
from .garment import (
    armature_of,
    bodies_of,
    carried_weights,
    is_carried,
    need_left,
    need_linear,
    need_plain_parent,
    rest_world,
)
from .masks import unmasked
from .meshes import rendered_map
from .modifiers import need_plain_modifiers, reshapes
from .objects import scene_units
from .shapes import worn_points
from .weights import PLAIN, own_groups, read_groups, read_kept

HALF = 0.5  # weight from which on a vertex is in a group
ROOT, SKELETON = "/Character", "Skeleton"  # prims of the stage that is handed over


@dataclass(frozen=True, eq=False)
class GatheredScene:
    """A garment with its character as ssilk has them: metres, y up.

    Attributes:
        units: of Blender's scene.
        joints: the bones that were gathered.
        character, garment, rig: at the bind pose; no rig where there are no proxies.
        meshes: by the name of its object each mesh, whose path is its prim's: the garment, then the bodies.
    """

    units: StageUnits
    joints: Joints
    character: Character
    garment: Garment
    rig: ProxyRig | None
    meshes: dict[str, Mesh]

    def moved(self, matrix: np.ndarray) -> GatheredScene:
        """Return this moved rigidly as a whole [m], by a matrix (4, 4)."""
        joints = replace(self.joints, binds=matrix @ self.joints.binds)
        bodies = tuple(replace(body, mesh=moved_mesh(body.mesh, matrix)) for body in self.character.bodies)
        mesh = moved_mesh(self.garment.mesh, matrix)
        skeleton = joints.skeleton(self.character.skeleton.path, bodies)
        proxies = joints.binds[joints.character_count :]
        return replace(
            self,
            joints=joints,
            character=replace(self.character, skeleton=skeleton, bodies=bodies),
            garment=replace(self.garment, mesh=mesh),
            rig=None if self.rig is None else replace(self.rig, bind_transforms=proxies),
            meshes=dict(zip(self.meshes, (mesh, *(body.mesh for body in bodies)))),
        )


def moved_mesh(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """Return a mesh moved by a matrix (4, 4) [m]."""
    return replace(mesh, points=mesh.points @ matrix[:3, :3].T + matrix[:3, 3])


def gather(
    garment: bpy.types.Object,
    *,
    classes: bool = True,
    proxies: bool = True,
    simulated: bool = False,
    joints: Joints | None = None,
) -> GatheredScene:
    """Return a garment with its armature and bodies. In object mode.

    Args:
        classes: whether to take the painted classes along.
        proxies: whether to take the proxies and their weights along; without, the garment's own weights are.
        simulated: whether modifiers may simulate the garment.
        joints: the armature's, where they are to be called otherwise than its bones.

    Raises:
        SetupError: something is missing or cannot be used; the sentence names the object.
    """
    bpy.context.view_layer.update()  # what was just linked is in no list of the view layer yet
    armature = armature_of(garment)
    need_plain_modifiers(garment, simulated=simulated)
    need_plain_parent(garment)
    joints = joints or read_joints(armature, garment)
    things = [garment, *bodies_of(garment, armature)]
    with evaluated(things):
        return _gathered(things, armature, joints, classes=classes, proxies=proxies)


def _gathered(
    things: Sequence[bpy.types.Object], armature: bpy.types.Object, joints: Joints, *, classes: bool, proxies: bool
) -> GatheredScene:
    garment = things[0]
    paths = [f"{ROOT}/{name}" for name in identifiers((thing.name for thing in things), taken=(SKELETON,))]
    lbs = own_weights(armature, garment, joints)
    mesh = read_mesh(garment, garment.data, paths[0], worn_points(garment))
    mesh = replace(mesh, stiffness=_stiffness(garment))
    rig = _proxy_rig(armature, garment, joints, paths[0]) if proxies and joints.proxy_count else None
    bodies = [read_body(thing, armature, joints.character, path) for thing, path in zip(things[1:], paths[1:])]
    return GatheredScene(
        units=scene_units(),
        joints=joints if rig else joints.character,
        character=Character(ROOT, joints.skeleton(f"{ROOT}/{SKELETON}", bodies), tuple(bodies)),
        garment=Garment(
            mesh,
            None if lbs is None else SkinWeights.from_dense(paths[0], lbs),
            current_classes(garment.data) if classes else None,
            None if classes else _pins(garment),
        ),
        rig=rig,
        meshes=dict(zip((thing.name for thing in things), (mesh, *(body.mesh for body in bodies)))),
    )


def own_weights(armature: bpy.types.Object, garment: bpy.types.Object, joints: Joints) -> np.ndarray | None:
    """Return the weights that the artist gave a garment over the character's joints, (V, J); None without.

    Weights kept beside a rig have priority; the weights of a rig itself are not the artist's.
    """
    names = joints.character.names
    kept = read_kept(garment.data, PLAIN, names)
    if kept is not None or joints.proxy_count:
        return kept
    if is_carried(garment, (armature, leader_of(armature))):
        return carried_weights(garment, joints.character, len(garment.data.vertices))
    weights = own_groups(armature, garment, names)
    bare = int(np.count_nonzero(~weights.any(axis=1)))
    if bare == len(weights):
        return None
    if bare:
        raise SetupError(
            f"{bare} of {len(weights)} vertices of '{garment.name}' have no bone's weight; paint these, or remove "
            "the vertex groups so that all weights are taken from the body."
        )
    return weights


def _pins(garment: bpy.types.Object) -> np.ndarray | None:
    """Return which vertices are in the group of pins, by half at least, shape (V,); None without such a group."""
    name = garment.ssilk.pins
    if not name:
        return None
    if name not in garment.vertex_groups:
        raise SetupError(f"'{garment.name}' has no vertex group '{name}' for its pins; choose another, or none.")
    return (read_groups(garment, garment.data, [name])[:, 0] >= HALF).astype(np.int8)


def _stiffness(garment: bpy.types.Object) -> np.ndarray | None:
    """Return how stiff the cloth is at each vertex beside its fabric, shape (V,); None where it is its own.

    Halfway between weights of zero and one it is halfway on a logarithmic scale.
    """
    name = garment.ssilk.stiff
    if not name:
        return None
    if name not in garment.vertex_groups:
        raise SetupError(f"'{garment.name}' has no vertex group '{name}' to be stiffer in; choose another, or none.")
    return garment.ssilk.stiffness ** read_groups(garment, garment.data, [name])[:, 0].astype(np.float64)


def _proxy_rig(armature: bpy.types.Object, garment: bpy.types.Object, joints: Joints, path: str) -> ProxyRig:
    weights = own_groups(armature, garment, joints.names)
    bare = int(np.count_nonzero(~weights.any(axis=1)))
    if bare:
        raise SetupError(
            f"{bare} vertices of '{garment.name}' have no bone's weight, as where a proxy was deleted; generate its "
            "rig again, or paint them."
        )
    proxies, skin = slice(joints.character_count, None), SkinWeights.from_dense(path, weights)
    return ProxyRig(path, joints.paths[proxies], joints.parents[proxies], joints.binds[proxies], skin)


def read_body(thing: bpy.types.Object, armature: bpy.types.Object, joints: Joints, path: str) -> Body:
    """Return a body at rest; evaluated where modifiers shape it before its armature does.

    Raises:
        SetupError: Blender deforms it otherwise than by linear blend skinning, vertices have no weight, or it is
            being edited.
    """
    need_left(thing)
    need_linear(thing, armature)
    if not reshapes(thing):
        return _bound(thing, thing.data, armature, joints, path, worn_points(thing))
    with _at_rest(armature) as depsgraph:
        evaluated = thing.evaluated_get(depsgraph)
        try:
            return _bound(thing, evaluated.to_mesh(), armature, joints, path)
        finally:
            evaluated.to_mesh_clear()


def _bound(
    thing: bpy.types.Object,
    mesh: bpy.types.Mesh,
    armature: bpy.types.Object,
    joints: Joints,
    path: str,
    points: np.ndarray | None = None,
) -> Body:
    if is_carried(thing, (armature, leader_of(armature))):
        weights = carried_weights(thing, joints, len(mesh.vertices))
    else:
        weights = read_groups(thing, mesh, joints.names)
    bare = int(np.count_nonzero(~weights.any(axis=1)))
    if bare:
        raise SetupError(f"{bare} of {len(weights)} vertices of '{thing.name}' have no bone's weight; paint these.")
    return Body(read_mesh(thing, mesh, path, points), SkinWeights.from_dense(path, weights))


@contextmanager
def evaluated(things: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Let Blender evaluate objects, those too that are disabled in viewports, themselves or with their collections.

    It passes them over otherwise, and their modifiers and drivers do nothing.
    """
    own = bpy.context.scene.collection
    hidden = [thing for thing in things if not thing.library and thing.hide_viewport]
    away = [thing for thing in things if all(group.hide_viewport for group in thing.users_collection)]
    lent = [thing for thing in away if thing.name not in own.objects]
    try:
        for thing in hidden:
            thing.hide_viewport = False
        for thing in lent:
            own.objects.link(thing)
        bpy.context.view_layer.update()
        yield
    finally:
        for thing in hidden:
            thing.hide_viewport = True
        for thing in lent:
            own.objects.unlink(thing)


@contextmanager
def _at_rest(armature: bpy.types.Object) -> Iterator[bpy.types.Depsgraph]:
    before = armature.data.pose_position
    armature.data.pose_position = "REST"
    try:
        with unmasked():
            yield bpy.context.evaluated_depsgraph_get()
    finally:
        armature.data.pose_position = before


def read_mesh(thing: bpy.types.Object, mesh: bpy.types.Mesh, path: str, points: np.ndarray | None = None) -> Mesh:
    """Return a mesh of an object at its place at rest, as the core has it.

    Args:
        points: in place of the mesh's own, in the object's space, shape (V, 3).
    """
    world = np.array(rest_world(thing))
    own = _values(mesh.vertices, "co", 3).reshape(-1, 3) if points is None else points
    points = own @ world[:3, :3].T + world[:3, 3]
    counts = _values(mesh.polygons, "loop_total", 1, np.int32)
    corners = np.arange(len(mesh.loops))
    mesh.calc_loop_triangles()
    faces = _values(mesh.loop_triangles, "vertices", 3, np.int32).reshape(-1, 3)
    if np.linalg.det(world[:3, :3]) < 0:  # mirrored: its faces would turn the other way
        faces = faces[:, ::-1]
        corners = np.repeat(2 * (np.cumsum(counts) - counts) + counts - 1, counts) - corners
    layer = rendered_map(mesh)
    return Mesh(
        path,
        scene_units().points_to_core(points),
        faces,
        counts,
        _values(mesh.loops, "vertex_index", 1, np.int32)[corners],
        _values(layer.uv, "vector", 2).reshape(-1, 2)[corners] if layer else None,
    )


def _values(items: bpy.types.bpy_prop_collection, name: str, width: int, kind: type = np.float32) -> np.ndarray:
    array = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(name, array)
    return array
