# SPDX-License-Identifier: GPL-3.0-or-later
"""Faces of bodies that a garment covers in every frame, hidden by a Mask modifier on a vertex group."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ssilk_core.physics.skin.hidden_faces import HiddenFaces, hidden_polygons
from ssilk_core.scene.assets import Mesh

from ..errors import SetupError
from ..scene.garment import armature_of, bodies_of
from ..scene.gather import gather
from ..scene.linked import home
from ..scene.masks import mask, show
from ..scene.modifiers import cage_points
from ..scene.objects import scene_units


class CoveredSkinSearch:
    """Looks for the faces of bodies that a garment covers, frame by frame as they are shown.

    Raises:
        SetupError: something is missing, not visible, or has other vertices than its mesh.
    """

    def __init__(self, garment: bpy.types.Object) -> None:
        bodies = bodies_of(garment, armature_of(garment))
        _need_editable(bodies)
        scene = gather(garment, classes=False, proxies=False)
        self.meshes: Sequence[Mesh] = [body.mesh for body in scene.character.bodies]
        self.found = HiddenFaces(scene.character.merged_body().mesh, scene.garment.mesh)

    def add(self, garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
        """Take the frame that is shown into account.

        Raises:
            SetupError: bodies or garment are not visible, or have other vertices than before.
        """
        posed = [_posed(thing, depsgraph) for thing in (garment, *bodies_of(garment, armature_of(garment)))]
        if [len(points) for points in posed[1:]] != [mesh.vertex_count for mesh in self.meshes]:
            raise SetupError(f"The bodies of '{garment.name}' were edited meanwhile; hide their skin again.")
        self.found.add(np.concatenate(posed[1:]), posed[0])

    def hide(self, garment: bpy.types.Object) -> tuple[int, int]:
        """Hide the covered faces in place of those hidden before; return how many, and of how many.

        A vertex is hidden where all its faces are, so that no other face loses one.

        Raises:
            SetupError: the bodies have other faces than before.
        """
        bodies = bodies_of(garment, armature_of(garment))
        if [len(body.data.polygons) for body in bodies] != [len(mesh.polygon_counts) for mesh in self.meshes]:
            raise SetupError(f"The bodies of '{garment.name}' were edited meanwhile; hide their skin again.")
        show(garment)
        hidden = 0
        for body, mesh, chosen in zip(bodies, self.meshes, hidden_polygons(self.found.mask(), self.meshes)):
            corners = np.repeat(chosen, mesh.polygon_counts)
            inside = np.zeros(mesh.vertex_count, dtype=bool)
            inside[mesh.indices_of_corners[corners]] = True
            inside[mesh.indices_of_corners[~corners]] = False
            owners = np.repeat(np.arange(len(chosen)), mesh.polygon_counts)
            hidden += len(np.unique(owners[inside[mesh.indices_of_corners]]))
            if inside.any():
                mask(body, garment, np.flatnonzero(inside))
        return hidden, sum(len(mesh.polygon_counts) for mesh in self.meshes)


def _need_editable(bodies: Sequence[bpy.types.Object]) -> None:
    linked = next((body for body in bodies if body.data.library or body.data.override_library), None)
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
