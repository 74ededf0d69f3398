# SPDX-License-Identifier: Apache-2.0
"""The part of the body that a garment collides with, posed by skinning matrices."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Body, Ints, SkinWeights
from ...scene.mesh import topology
from ...scene.mesh.blocks import compact_blocks
from ..skinning import Skinning, blend_matrices, transform_directions, transform_points
from .closest_point import triangle_patches
from .distance import PosedBody
from .limb_axes import LimbAxes, LimbPoser
from .nearest_vertex import BODY_GROUP
from .one_ring import triangle_rings


class CollisionBody:
    """Body vertices and normals under skinning matrices, for the vertices candidates (all by default).

    Attributes:
        vertices: indices of its vertices in the whole body.
        limbs: poses the axes that loose cloth must not cross.

    Args:
        limbs: axes that loose cloth must not cross; none by default.
    """

    def __init__(
        self,
        body: Body,
        joint_count: int,
        *,
        vertices: Ints | None = None,
        limbs: LimbAxes | None = None,
        device: torch.device,
    ) -> None:
        chosen = np.arange(body.mesh.vertex_count) if vertices is None else vertices
        self.vertices = chosen
        body.skin.check_joints(joint_count)
        normals = topology.vertex_normals(body.mesh.points, body.mesh.faces)[chosen]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        faces = topology.faces_among(body.mesh, chosen)
        rings = triangle_rings(faces, len(chosen))
        self.faces = torch.as_tensor(faces, device=device)
        self.patches = torch.as_tensor(triangle_patches(body.mesh.points[chosen], faces), device=device)
        self.rings = torch.as_tensor(rings, device=device)
        self.groups = torch.as_tensor(compact_blocks(body.mesh.points[chosen], BODY_GROUP), device=device)
        skin = SkinWeights(body.skin.path, body.skin.indices[chosen], body.skin.weights[chosen])
        self.skin = Skinning(skin).to(device)
        self.limbs = LimbPoser(limbs, body, device) if limbs else None
        self.points = tensor(body.mesh.points[chosen])[:, :, None]
        self.normals = tensor(normals)[:, :, None]

    def reshape(self, points: Tensor, normals: Tensor) -> None:
        """Take other points and unit normals in the bind pose, (V, 3), in place."""
        self.points.copy_(points[:, :, None])
        self.normals.copy_(normals[:, :, None])

    @torch.no_grad()
    def pose(
        self,
        character: Tensor,
        *,
        surface: bool = True,
        exact: bool = False,
        limbs: bool = True,
        buried: Tensor | None = None,
        moves: Tensor | None = None,
    ) -> PosedBody:
        """Pose the body with skinning matrices (J, 3, 4, N); normals rotate with the blended matrices.

        Args:
            moves: of the whole body's vertices in the bind pose in each frame [m], shape (B, 3, N); the normals are
                those of the body that is moved so.
            surface: whether the nearest body point lies on the surface, or is the nearest vertex, which knows no
                limbs.
            exact: whether that of cloth with a patch of its own is the exact one too, not one around the nearest
                vertex (`PosedBody.rings`).
            limbs: whether loose cloth meets limbs that went through it.
            buried: limbs that do not count, where they are known (`LimbPoser.buried`).
        """
        if moves is None:
            points, normals = self.skin.surface(self.points[:, :, 0], self.normals[:, :, 0], character)
        else:
            points, normals = self._moved(moves, character)
        rings = self.rings if surface and not exact else None
        faces, patches = (self.faces, self.patches) if surface and len(self.faces) else (None, None)
        axes = self.limbs.pose(character, buried) if self.limbs and limbs and surface else None
        return PosedBody(points, normals, rings, self.groups, faces, patches, axes)

    def _moved(self, moves: Tensor, character: Tensor) -> tuple[Tensor, Tensor]:
        """Return skinned points and unit normals (V, 3, N) of a body of another shape in each frame."""
        rest = self.points + moves[torch.as_tensor(self.vertices, device=moves.device)]
        across = torch.linalg.cross(*(rest[self.faces[:, at]] - rest[self.faces[:, 0]] for at in (1, 2)), dim=1)
        turned = torch.zeros_like(rest)
        for corner in range(3):
            turned.index_add_(0, self.faces[:, corner], across)
        size = turned.norm(dim=1, keepdim=True)
        turned = torch.where(size > 0, turned / size.clamp_min(torch.finfo(size.dtype).tiny), self.normals)
        affine = blend_matrices(self.skin.dense(self.skin.weights), character[self.skin.used])
        normals = transform_directions(affine, turned)
        return transform_points(affine, rest), normals / normals.norm(dim=1, keepdim=True).clamp_min(1e-8)
