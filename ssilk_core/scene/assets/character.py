# SPDX-License-Identifier: Apache-2.0
"""A skeleton with the body meshes that it deforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from .arrays import assign
from .mesh import Mesh
from .skeleton import Skeleton
from .skin import SkinWeights


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh that a skeleton deforms and garments collide with.

    `purpose` says who draws it, as UsdGeom has it: "default", "render" or "proxy".
    """

    mesh: Mesh
    skin: SkinWeights
    purpose: str = "default"

    def __post_init__(self) -> None:
        if self.skin.vertex_count != self.mesh.vertex_count:
            fail(
                self.mesh.path,
                f"{self.skin.vertex_count} weight rows for {self.mesh.vertex_count} points",
                "one row for each point is needed",
                "bind the mesh again",
            )


@dataclass(frozen=True, eq=False)
class Character:
    """A skeleton and the body meshes it deforms.

    Attributes:
        path: source of the character, for messages.
        skeleton: its joints.
        bodies: what garments collide with.
        stand_ins: meshes that viewports draw in place of the bodies; nothing collides with them.
    """

    path: str
    skeleton: Skeleton
    bodies: tuple[Body, ...]
    stand_ins: tuple[Body, ...] = ()

    def __post_init__(self) -> None:
        assign(self, bodies=tuple(self.bodies), stand_ins=tuple(self.stand_ins))
        for body in (*self.bodies, *self.stand_ins):
            body.skin.check_joints(self.skeleton.joint_count)

    def merged_body(self) -> Body:
        """Return all body meshes as one, with point and face indices in their order.

        Raises:
            SsilkError: the character has no body mesh.
        """
        if not self.bodies:
            fail(
                self.path,
                "the character has no skinned body mesh",
                "a garment collides with at least one",
                "bind a mesh to the skeleton, or name it with --body",
            )
        if len(self.bodies) == 1:
            return self.bodies[0]
        offsets = np.cumsum([0] + [body.mesh.vertex_count for body in self.bodies])
        width = max(body.skin.indices.shape[1] for body in self.bodies)

        def padded(array: NDArray) -> NDArray:
            return np.pad(array, ((0, 0), (0, width - array.shape[1])))

        mesh = Mesh(
            self.path,
            np.concatenate([body.mesh.points for body in self.bodies]),
            np.concatenate([body.mesh.faces + offset for body, offset in zip(self.bodies, offsets)]),
        )
        skin = SkinWeights(
            self.path,
            np.concatenate([padded(body.skin.indices) for body in self.bodies]),
            np.concatenate([padded(body.skin.weights) for body in self.bodies]),
        )
        return Body(mesh, skin)
