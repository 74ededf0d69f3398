# SPDX-License-Identifier: Apache-2.0
"""Bodies of a family in training: each step is done on one of them, drawn as poses are.

A body is a random point of a triangle of members, drawn evenly, and as far again from the members' mean as `BEYOND`
says. The garment that it wears is the same for all: the energy keeps the base's rest shape, so that a large body
stretches it. One that is graded has the rest shape in which it lies on each (`physics.energy.graded`). A window that
goes on does so on another body: its latents are taken along as a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..physics.collision import CollisionBody
from ..physics.collision.limb_axes import body_axes
from ..scene.assets import Floats, Scene
from ..scene.family import BodyFamily

BEYOND = 0.1  # how much farther from the members' mean bodies are drawn than members are
CORNERS = 3  # members among which a body is drawn


class BodyWearer(Protocol):
    """Whatever knows the body that it is on."""

    def wear(self, place: Tensor, /) -> None: ...


def random_body(family: BodyFamily, generator: np.random.Generator) -> Floats:
    """Return the coordinates of a random body, shape (K,)."""
    corners = generator.choice(len(family.members), min(CORNERS, len(family.members)), replace=False)
    middle = family.members.mean(axis=0)
    found = generator.dirichlet(np.ones(len(corners))) @ family.members[corners]
    return middle + (1 + BEYOND) * (found - middle)


class DrawnBodies:
    """Draws the body of each step, by its number, and puts it on all that know it.

    Attributes:
        place: its coordinates, shape (K,); a captured graph reads them.
    """

    def __init__(self, family: BodyFamily, wearers: Sequence[BodyWearer], seed: int, device: torch.device) -> None:
        self.family, self.wearers, self.seed = family, wearers, seed
        self.place = torch.zeros(family.size, device=device)

    def draw(self, iteration: int) -> None:
        """Draw the body of an iteration, which a resumed run draws again."""
        drawn = random_body(self.family, np.random.default_rng([self.seed, iteration]))
        self.place.copy_(torch.from_numpy(drawn))

    def put_on(self) -> None:
        """Put on the body that was drawn: part of the step, so that a captured graph does it too."""
        for wearer in self.wearers:
            wearer.wear(self.place)

    def wear(self, coordinates: Floats) -> None:
        """Put on the body at coordinates (K,)."""
        self.place.copy_(torch.as_tensor(coordinates))
        self.put_on()

    def take_off(self) -> None:
        """Put on the base."""
        self.wear(np.zeros(self.family.size))


class FamilyBody:
    """Gives a body that garments collide with the shape of any body of a family, in place.

    Points move as the family says, and normals are those of the moved surface. Axes of limbs, their radii and lengths
    are taken to be linear in the coordinates, which their ends at joints are.
    """

    def __init__(self, body: CollisionBody, scene: Scene, family: BodyFamily) -> None:
        self.body, device = body, body.points.device
        whole, skeleton = scene.character.merged_body(), scene.character.skeleton

        def tensor(values: Floats) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.float32, device=device)

        self.points, self.moves = tensor(whole.mesh.points), tensor(family.point_moves)
        self.faces = torch.as_tensor(np.array(whole.mesh.faces), device=device)
        self.vertices = torch.as_tensor(np.array(body.vertices), device=device)
        self.axes: tuple[list[Tensor], list[Tensor]] | None = None
        if body.limbs:
            base = body_axes(whole, skeleton)
            units = [
                body_axes(family.body_at(whole, unit), family.skeleton_at(skeleton, unit))
                for unit in np.eye(family.size)
            ]
            kept = [list(map(tuple, base.paths.tolist())).index(tuple(path)) for path in body.limbs.paths.tolist()]
            own = [base.ends, base.radii, base.beyond[kept]]
            theirs = [np.stack(each) for each in zip(*((u.ends, u.radii, u.beyond[kept]) for u in units))]
            self.axes = [tensor(v) for v in own], [tensor(t - v) for t, v in zip(theirs, own)]

    @torch.no_grad()
    def wear(self, place: Tensor) -> None:
        """Take the shape of the body at coordinates (K,)."""
        points = self.points + torch.tensordot(place, self.moves, 1)
        a, b, c = points[self.faces].unbind(1)
        across = torch.linalg.cross(b - a, c - a, dim=1)
        normals = torch.zeros_like(points).index_add(0, self.faces.T.reshape(-1), across.repeat(3, 1))
        normals = torch.nn.functional.normalize(normals, dim=1)
        self.body.reshape(points[self.vertices], normals[self.vertices])
        if self.axes and self.body.limbs:
            self.body.limbs.reshape(*(v + torch.tensordot(place, moves, 1) for v, moves in zip(*self.axes)))
