# SPDX-License-Identifier: Apache-2.0
"""The skin that a garment covers in the bind pose, and where it shows through the cloth.

Points are spread evenly over the body. A point is covered when cloth lies within `COVER_REACH` above it, along its
normal, in the bind pose. A covered point shows when cloth lies within `SHOW_DEPTH` beneath it and none within
`COVER_REACH` above it. The share of vertices inside the body counts cloth; this share counts what is seen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..assets import Floats, Ints, Mesh, Scene, SkinWeights
from ..mesh import topology
from ..skinning import Skinning
from .nearest_vertex import compact_blocks
from .ray_casting import RayCaster, RayHits

SKIN_POINTS = 8000
COVER_REACH, SHOW_DEPTH = 0.08, 0.03  # [m]
NAMED_REGIONS = 3
PLASTIC = 1.32471795724474602596  # root of x^3 = x + 1; its powers make the most even sequence in the plane


@dataclass(frozen=True, kw_only=True)
class ShownSkin:
    """The share of covered skin that shows, over frames.

    Attributes:
        covered: points that the garment covers.
        mean, worst: mean share over frames, and that of the worst frame.
        clip, frame: the worst frame; of several equal ones the first.
        regions: share of what shows, of all frames together, at the joints that move most of it, largest first.
    """

    covered: int
    mean: float
    worst: float
    clip: str
    frame: int
    regions: dict[str, float]


@dataclass(frozen=True, eq=False)
class ShownCounts:
    """Which covered points show, summed over one clip's frames and kept for each frame; on the CPU.

    Attributes:
        shares: share of the covered points that show in each frame, shape (N,).
        points: frames in which each covered point shows, shape (P,).
    """

    shares: Tensor
    points: Tensor

    @classmethod
    def of(cls, shows: Tensor) -> ShownCounts:
        """Return the counts of a clip, from what shows (P, N)."""
        return cls(shows.double().mean(0).cpu(), shows.sum(1).cpu())

    @classmethod
    def joined(cls, parts: Sequence[ShownCounts]) -> ShownCounts:
        """Return the counts of consecutive parts together."""
        return cls(torch.cat([part.shares for part in parts]), sum((part.points for part in parts), torch.tensor(0)))


class CoveredSkin:
    """Evenly spread points of a body's skin that a garment covers in the bind pose.

    Args:
        count: points on the whole body.

    Attributes:
        faces: the triangle of the merged body that each covered point lies on, shape (P,).
        weights: its barycentric coordinates there, shape (P, 3).
        regions: the joint with the largest skinning weight at each point, shape (P,).
        joint_names: names of the character's joints.
    """

    def __init__(self, scene: Scene, *, count: int = SKIN_POINTS, device: torch.device) -> None:
        body, cloth = scene.character.merged_body(), scene.garment.mesh
        faces, weights = spread_points(body.mesh, count)
        normals = topology.vertex_normals(body.mesh.points, body.mesh.faces)
        covered = _covered(body.mesh, normals, faces, weights, cloth)
        self.faces, self.weights = faces[covered], weights[covered]
        corners = body.mesh.faces[self.faces]
        vertices, place = np.unique(corners, return_inverse=True)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self._corners = torch.as_tensor(place.reshape(-1, 3), device=device)
        self._weights = tensor(self.weights)
        self._points, self._normals = tensor(body.mesh.points[vertices]), tensor(normals[vertices])
        skin = body.skin
        self._skin = None
        if len(vertices):
            self._skin = Skinning(SkinWeights(skin.path, skin.indices[vertices], skin.weights[vertices])).to(device)
        self._caster = RayCaster(cloth, device=device)
        self.joint_names = scene.character.skeleton.joint_names
        influence = np.zeros((len(corners), len(self.joint_names)))
        shares = skin.weights[corners] * self.weights[..., None]
        np.add.at(influence, (np.arange(len(corners))[:, None, None], skin.indices[corners]), shares)
        self.regions = influence.argmax(axis=1)

    def __len__(self) -> int:
        return len(self.faces)

    @torch.no_grad()
    def pose(self, character: Tensor) -> tuple[Tensor, Tensor]:
        """Return points [m] and unit normals of the covered skin, both (P, 3, N).

        Args:
            character: skinning matrices of the character's joints, shape (J, 3, 4, N).
        """
        if self._skin is None:
            nothing = character.new_zeros(0, 3, character.shape[3])
            return nothing, nothing
        posed = self._skin.surface(self._points, self._normals, character)
        points, normals = ((values[self._corners] * self._weights[..., None, None]).sum(1) for values in posed)
        return points, normals / normals.norm(dim=1, keepdim=True).clamp_min(1e-8)

    def hits(self, x: Tensor, character: Tensor) -> RayHits:
        """Tell above and beneath which covered points cloth lies, of garment positions x (V, 3, N) [m].

        Args:
            character: skinning matrices of the same frames, shape (J, 3, 4, N).
        """
        return self._caster.cast(*self.pose(character), x, above=COVER_REACH, beneath=SHOW_DEPTH)

    def shows(self, x: Tensor, character: Tensor) -> Tensor:
        """Tell which covered points show, bool (P, N); arguments are those of `hits`."""
        found = self.hits(x, character)
        return found.beneath & ~found.above

    def figures(self, clips: Sequence[tuple[str, ShownCounts]]) -> ShownSkin | None:
        """Return the figures of clips by name; None where the garment covers nothing.

        Raises:
            ValueError: there is no frame.
        """
        if not len(self):
            return None
        together = ShownCounts.joined([counts for _, counts in clips])
        clip, worst = max(clips, key=lambda each: float(each[1].shares.max()))
        return ShownSkin(
            covered=len(self),
            mean=float(together.shares.mean()),
            worst=float(worst.shares.max()),
            clip=clip,
            frame=int(worst.shares.argmax()),
            regions=self._regions(together.points),
        )

    def _regions(self, points: Tensor) -> dict[str, float]:
        """Return the shares of frames of points that show at the joints with the largest ones."""
        shown = np.bincount(self.regions, points.numpy(), len(self.joint_names))
        largest = Counter(dict(enumerate(shown.tolist()))).most_common(NAMED_REGIONS)
        return {self.joint_names[j].rpartition("/")[2]: n / float(shown.sum()) for j, n in largest if n}


def _covered(mesh: Mesh, normals: Floats, faces: Ints, weights: Floats, cloth: Mesh) -> np.ndarray:
    """Tell above which points of the body cloth lies in the bind pose, bool (P,)."""
    corners = mesh.faces[faces]
    points, directions = ((values[corners] * weights[..., None]).sum(1) for values in (mesh.points, normals))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-8)
    asked = (torch.from_numpy(values)[:, :, None] for values in (points, directions, cloth.points.copy()))
    caster = RayCaster(cloth, device=torch.device("cpu"))
    return caster.cast(*asked, above=COVER_REACH, beneath=0.0).above[:, 0].numpy()


def spread_points(mesh: Mesh, count: int) -> tuple[Ints, Floats]:
    """Spread points evenly by area over a mesh, always in the same way.

    The surface is cut into so many parts of equal area, along a path through triangles that lie close together, and
    the point of each is on the triangle in its middle. Points on one triangle follow a sequence of low discrepancy.

    Returns:
        The triangle of each point (P,), and its barycentric coordinates (P, 3).
    """
    path = compact_blocks(mesh.points[mesh.faces].mean(axis=1), 1)[:, 0]
    ends = np.cumsum(topology.face_areas(mesh.points, mesh.faces)[path])
    number = np.arange(count)
    place = np.searchsorted(ends, (number + 0.5) / count * ends[-1], side="right")
    u, v = ((0.5 + (number + 1) / PLASTIC**power) % 1 for power in (1, 2))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)  # the square's other half, turned onto it
    return path[place.clip(max=len(path) - 1)], np.stack([1 - u - v, u, v], axis=1)
