# SPDX-License-Identifier: GPL-3.0-or-later
"""Faces of bodies, and of garments beneath, that a garment covers in every frame, hidden by a Mask modifier on a
vertex group."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ssilk_core.physics.skin.hidden_cloth import HiddenCloth
from ssilk_core.physics.skin.hidden_faces import HiddenFaces, hidden_polygons
from ssilk_core.scene.assets import Mesh

from ..errors import SetupError
from ..scene.garment import armature_of, beneath, bodies_of
from ..scene.gather import gather
from ..scene.linked import home
from ..scene.masks import mask, show
from ..scene.modifiers import cage_points
from ..scene.objects import found_again, scene_units


class CoveredSkinSearch:
    """Looks for the faces of bodies that a garment covers, and of garments beneath it, frame by frame as shown.

    Of garments beneath, those that are hidden or linked are left out.

    Raises:
        SetupError: something is missing, not visible, or has other vertices than its mesh.
    """

    def __init__(self, garment: bpy.types.Object) -> None:
        bodies = bodies_of(garment, armature_of(garment))
        _need_editable(bodies)
        scene = gather(garment, classes=False, proxies=False)
        body, cloth = scene.character.merged_body().mesh, scene.garment.mesh
        self.meshes: Sequence[Mesh] = [each.mesh for each in scene.character.bodies]
        self.found = HiddenFaces(body, cloth)
        inner = [each for each in beneath(garment) if each.visible_get() and not _is_linked(each)]
        self._inner = [(each.session_uid, each.name) for each in inner]
        self._inner_meshes = [gather(each, classes=False, proxies=False).garment.mesh for each in inner]
        self._cloth = [HiddenCloth(mesh, cloth, body) for mesh in self._inner_meshes]

    def add(self, garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
        """Take the frame that is shown into account.

        Raises:
            SetupError: bodies or garments are not visible, or have other vertices than before.
        """
        posed = [_posed(thing, depsgraph) for thing in (garment, *bodies_of(garment, armature_of(garment)))]
        inner = [_posed(found_again(*each), depsgraph) for each in self._inner]
        if [len(points) for points in posed[1:]] != [mesh.vertex_count for mesh in self.meshes]:
            raise SetupError(f"The bodies of '{garment.name}' were edited meanwhile; hide their skin again.")
        if [len(points) for points in inner] != [mesh.vertex_count for mesh in self._inner_meshes]:
            raise SetupError(f"Garments beneath '{garment.name}' were edited meanwhile; hide them again.")
        body = np.concatenate(posed[1:])
        self.found.add(body, posed[0])
        for cloth, points in zip(self._cloth, inner):
            cloth.add(points, posed[0], body)

    def hide(self, garment: bpy.types.Object) -> tuple[int, int, int]:
        """Hide the covered faces in place of those hidden before; return how many of the bodies, of how many, and
        how many of garments beneath.

        A vertex is hidden where all its faces are, so that no other face loses one.

        Raises:
            SetupError: the bodies, or garments beneath, have other faces than before.
        """
        bodies = bodies_of(garment, armature_of(garment))
        inner = [found_again(*each) for each in self._inner]
        for things, meshes in ((bodies, self.meshes), (inner, self._inner_meshes)):
            if [len(thing.data.polygons) for thing in things] != [len(mesh.polygon_counts) for mesh in meshes]:
                what = "The bodies of" if things is bodies else "Garments beneath"
                raise SetupError(f"{what} '{garment.name}' were edited meanwhile; hide what it covers again.")
        show(garment)
        of_bodies = zip(bodies, self.meshes, hidden_polygons(self.found.mask(), self.meshes))
        hidden = sum(_mask(thing, garment, mesh, chosen) for thing, mesh, chosen in of_bodies)
        cloth = sum(
            _mask(thing, garment, mesh, hidden_polygons(found.mask(), [mesh])[0])
            for thing, mesh, found in zip(inner, self._inner_meshes, self._cloth)
        )
        return hidden, sum(len(mesh.polygon_counts) for mesh in self.meshes), cloth


def _mask(thing: bpy.types.Object, garment: bpy.types.Object, mesh: Mesh, chosen: np.ndarray) -> int:
    """Hide the vertices of an object all of whose polygons are chosen; return how many polygons lose some."""
    corners = np.repeat(chosen, mesh.polygon_counts)
    inside = np.zeros(mesh.vertex_count, dtype=bool)
    inside[mesh.indices_of_corners[corners]] = True
    inside[mesh.indices_of_corners[~corners]] = False
    if inside.any():
        mask(thing, garment, np.flatnonzero(inside))
    owners = np.repeat(np.arange(len(chosen)), mesh.polygon_counts)
    return len(np.unique(owners[inside[mesh.indices_of_corners]]))


def _is_linked(thing: bpy.types.Object) -> bool:
    return bool(thing.data.library or thing.data.override_library)


def _need_editable(bodies: Sequence[bpy.types.Object]) -> None:
    linked = next((body for body in bodies if _is_linked(body)), None)
    if linked:
        raise SetupError(
            f"The mesh of '{linked.name}' belongs to '{home(linked.data).name}'; hide its skin there, or make it "
            "local."
        )


def _posed(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """Return the vertices of an object as they are shown [m], y up, shape (V, 3)."""
    if not thing.visible_get():
        raise SetupError(f"'{thing.name}' is not visible; show it to compare skin and cloth.")
    return scene_units().points_to_core(cage_points(thing, depsgraph))
