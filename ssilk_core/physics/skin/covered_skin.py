# SPDX-License-Identifier: Apache-2.0
"""The skin that a garment covers in the bind pose, and where it shows through the cloth.

Points are spread evenly over the body. A point is covered when cloth lies within `COVER_REACH` above it, along its
normal, in the bind pose. A covered point shows when cloth lies within `SHOW_DEPTH` beneath it and none within
`COVER_REACH` above it. The share of vertices inside the body counts cloth; this share counts what is seen. A covered
point is bare when neither is within reach: cloth that was thrown off, or swings away as a skirt may, shows nothing.
Skin that is not covered, such as hands, can be on either side. What is counted of it is the limbs that pierce the
cloth (`pierced`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints, Mesh, Scene, SkinWeights
from ...scene.mesh import topology
from ..collision import RayCaster, limb_axes
from ..collision.limb_axes import LimbPoser
from ..collision.pierced import Piercing
from ..collision.samples import vertex_samples
from ..skinning import Skinning
from .figures import COVER_REACH, SHOW_DEPTH, ShownSkin

SKIN_POINTS = 8000
NAMED_REGIONS = 3
MORTON_BITS = 12  # cells of half a millimetre on a person
PLASTIC = 1.32471795724474602596  # root of x^3 = x + 1; its powers make the most even sequence in the plane


@dataclass(frozen=True, eq=False)
class SkinStates:
    """Which covered points show, and which are bare, both bool (P, N), and which limbs pierce the cloth, bool (L, N).

    Nothing is known of limbs by default.
    """

    shows: Tensor
    bare: Tensor
    pierced: Tensor | None = None


@dataclass(frozen=True, eq=False)
class ShownCounts:
    """How much of the covered skin shows in frames of one clip; on the CPU.

    Attributes:
        shares, bare: shares of the covered points that show, and that are bare, in each frame, both of shape (N,).
        points: frames in which each covered point shows, shape (P,).
        frames: numbers of the frames in the clip, or their time codes, shape (N,).
        pierced: which limbs pierce the cloth in each frame, bool (L, N); None where nothing is known.
    """

    shares: Tensor
    bare: Tensor
    points: Tensor
    frames: Tensor
    pierced: Tensor | None = None

    @classmethod
    def of(cls, states: SkinStates, frames: Sequence[float] | None = None) -> ShownCounts:
        """Return the counts of a clip, from the states (P, N) in `frames`, by default the first N."""
        shares, bare = (found.double().mean(0).cpu() for found in (states.shows, states.bare))
        numbers = torch.arange(len(shares)) if frames is None else torch.from_numpy(np.asarray(frames))
        pierced = None if states.pierced is None else states.pierced.cpu()
        return cls(shares, bare, states.shows.sum(1).cpu(), numbers, pierced)

    @property
    def pierced_share(self) -> float | None:
        """Share of the frames in which any limb pierces the cloth; None where nothing is known."""
        return None if self.pierced is None else float(self.pierced.any(0).double().mean())

    @classmethod
    def joined(cls, parts: Sequence[ShownCounts]) -> ShownCounts:
        """Return the counts of several parts together."""
        pierced = [part.pierced for part in parts if part.pierced is not None]
        return cls(
            torch.cat([part.shares for part in parts]),
            torch.cat([part.bare for part in parts]),
            torch.stack([part.points for part in parts]).sum(0),
            torch.cat([part.frames for part in parts]),
            torch.cat(pierced, dim=1) if len(pierced) == len(parts) else None,
        )


class CoveredPoints:
    """Evenly spread points of a body that cloth covers in the bind pose.

    Args:
        body, cloth: in the bind pose.
        count: points on the whole body.

    Attributes:
        faces: the triangle of the body that each covered point lies on, shape (P,).
        weights: its barycentric coordinates there, shape (P, 3).
        vertices: vertices of the body at the corners of these triangles, shape (C,).
    """

    def __init__(self, body: Mesh, cloth: Mesh, *, count: int = SKIN_POINTS, device: torch.device) -> None:
        faces, weights = spread_points(body, count)
        normals = topology.vertex_normals(body.points, body.faces)
        covered = _covered(body, normals, faces, weights, cloth)
        self.faces, self.weights = faces[covered], weights[covered]
        self.vertices, place = np.unique(body.faces[self.faces], return_inverse=True)
        self._corners = torch.as_tensor(place.reshape(-1, 3), device=device)
        self._weights = torch.as_tensor(self.weights, dtype=torch.float32, device=device)[..., None, None]
        self._caster = RayCaster(cloth, device=device)

    def __len__(self) -> int:
        return len(self.faces)

    def place(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points [m] and unit normals, both (P, 3, N), on a body with these at `vertices` (C, 3, N)."""
        points, normals = ((values[self._corners] * self._weights).sum(1) for values in (points, normals))
        return points, normals / normals.norm(dim=1, keepdim=True).clamp_min(1e-8)

    def outermost(self, x: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the signed distance of the outermost cloth at points placed so [m], and its triangle, both (P, N).

        The distance is minus infinity where no cloth is within reach, above or beneath.
        """
        return self._caster.outermost(points, normals, x, above=COVER_REACH, beneath=SHOW_DEPTH)

    def states(self, x: Tensor, points: Tensor, normals: Tensor) -> SkinStates:
        """Tell which points show, and which are bare; all show in a frame where the cloth is not finite.

        Args:
            x: vertices of the cloth [m], shape (V, 3, N).
            points, normals: of the body at `vertices`, in the same frames [m], both (C, 3, N).
        """
        hits = self._caster.cast(*self.place(points, normals), x, above=COVER_REACH, beneath=SHOW_DEPTH)
        finite = x.isfinite().all(0).all(0)
        return SkinStates((hits.beneath & ~hits.above) | ~finite, ~(hits.beneath | hits.above) & finite)


class CoveredSkin:
    """The skin of a character that a garment covers in the bind pose.

    Attributes:
        points: evenly spread ones.
        regions: the joint with the largest skinning weight at each point, shape (P,).
        joint_names: names of the character's joints.
        limbs: the joint at the tip of each limb that loose cloth must not cross, shape (L,).
    """

    def __init__(self, scene: Scene, *, count: int = SKIN_POINTS, device: torch.device) -> None:
        merged = scene.character.merged_body()
        body, skin = merged.mesh, merged.skin
        self.points = CoveredPoints(body, scene.garment.mesh, count=count, device=device)
        self.joint_names = scene.character.skeleton.joint_names
        corners, vertices = body.faces[self.points.faces], self.points.vertices
        influence = np.zeros((len(corners), len(self.joint_names)))
        shares = skin.weights[corners] * self.points.weights[..., None]
        np.add.at(influence, (np.arange(len(corners))[:, None, None], skin.indices[corners]), shares)
        self.regions = influence.argmax(axis=1)
        self._skinning = None
        if len(vertices):
            moved = SkinWeights(skin.path, skin.indices[vertices], skin.weights[vertices])
            self._skinning = Skinning(moved).to(device)
        normals = topology.vertex_normals(body.points, body.faces)
        self._rest, self._normals = (
            torch.as_tensor(values[vertices], dtype=torch.float32, device=device) for values in (body.points, normals)
        )
        axes = limb_axes(scene)
        self.limbs = axes.tips if axes else np.zeros(0, dtype=int)
        self._poser = LimbPoser(axes, merged, device) if axes else None
        samples = vertex_samples(scene.garment.mesh.vertex_count)
        self._piercing = Piercing(scene, samples, device=device) if axes else None

    def __len__(self) -> int:
        return len(self.points)

    @torch.no_grad()
    def states(self, x: Tensor, character: Tensor) -> SkinStates:
        """Tell what shows, what is bare and what pierces; all shows in a frame where the cloth is not finite.

        Args:
            x: garment positions [m], shape (V, 3, N).
            character: skinning matrices of the character's joints in the same frames, shape (J, 3, 4, N).
        """
        if self._skinning is None:
            return SkinStates(*torch.zeros(2, 0, x.shape[2], dtype=torch.bool, device=x.device))
        found = self.points.states(x, *self._skinning.surface(self._rest, self._normals, character))
        pierced = torch.zeros(0, x.shape[2], dtype=torch.bool, device=x.device)
        if self._piercing and self._poser:
            pierced = self._piercing.find(x, self._poser.pose(character)).radius > 0
        return replace(found, pierced=pierced)

    def figures(self, clips: Sequence[tuple[str, ShownCounts]]) -> ShownSkin | None:
        """Return the figures of clips by name; None where the garment covers nothing.

        Raises:
            ValueError: there is no frame.
        """
        found = shown_skin(clips, self._regions)
        together = ShownCounts.joined([counts for _, counts in clips])
        if found is None or together.pierced is None:
            return found
        shares = together.pierced.double().mean(1).tolist()
        limbs = sorted(zip(shares, self.limbs.tolist()), key=lambda each: -each[0])
        return replace(
            found,
            pierced=together.pierced_share,
            limbs={self._name(joint): share for share, joint in limbs[:NAMED_REGIONS] if share},
        )

    def _name(self, joint: int) -> str:
        return self.joint_names[joint].rpartition("/")[2]

    def _regions(self, shown_frames: Tensor) -> dict[str, float]:
        """Return the shares of what shows at the joints with the largest ones."""
        shown = np.bincount(self.regions, shown_frames.numpy(), len(self.joint_names))
        largest = Counter(dict(enumerate(shown.tolist()))).most_common(NAMED_REGIONS)
        return {self._name(joint): n / float(shown.sum()) for joint, n in largest if n}


def shown_skin(
    clips: Sequence[tuple[str, ShownCounts]], regions: Callable[[Tensor], dict[str, float]] = lambda points: {}
) -> ShownSkin | None:
    """Return the figures of clips by name; None where nothing is covered.

    Args:
        regions: tells where, from how often each point shows, shape (P,).

    Raises:
        ValueError: there is no frame.
    """
    together = ShownCounts.joined([counts for _, counts in clips])
    if not len(together.points):
        return None
    clip, worst = max(clips, key=lambda each: float(each[1].shares.max()))
    return ShownSkin(
        frames=len(together.shares),
        covered=len(together.points),
        mean=float(together.shares.mean()),
        worst=float(worst.shares.max()),
        bare=float(together.bare.mean()),
        worst_bare=float(together.bare.max()),
        clip=clip,
        frame=worst.frames[worst.shares.argmax()].item(),
        regions=regions(together.points),
    )


def _covered(mesh: Mesh, normals: Floats, faces: Ints, weights: Floats, cloth: Mesh) -> np.ndarray:
    """Tell above which points of the body cloth lies in the bind pose, bool (P,)."""
    corners = mesh.faces[faces]
    points, directions = ((values[corners] * weights[..., None]).sum(1) for values in (mesh.points, normals))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-8)
    asked = (torch.from_numpy(values)[:, :, None] for values in (points, directions, cloth.points.copy()))
    caster = RayCaster(cloth, device=torch.device("cpu"))
    return caster.cast(*asked, above=COVER_REACH, beneath=0.0).above[:, 0].numpy()


def _cells(points: Floats) -> Ints:
    """Return the places of points (P, 3) on a Morton curve, along which neighbours mostly lie close together."""
    low = points.min(axis=0)
    cells = ((points - low) / max(float(np.ptp(points, axis=0).max()), 1e-9) * (2**MORTON_BITS - 1)).astype(np.int64)
    return sum(((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))


def spread_points(mesh: Mesh, count: int) -> tuple[Ints, Floats]:
    """Spread points evenly by area over a mesh, always in the same way.

    The surface is cut into so many parts of equal area, along a path through triangles that lie close together, and
    the point of each is on the triangle in its middle. Points on one triangle follow a sequence of low discrepancy.

    Returns:
        The triangle of each point (P,), and its barycentric coordinates (P, 3).
    """
    path = np.argsort(_cells(mesh.points[mesh.faces].mean(axis=1)), kind="stable")
    ends = np.cumsum(topology.face_areas(mesh.points, mesh.faces)[path])
    number = np.arange(count)
    place = np.searchsorted(ends, (number + 0.5) / count * ends[-1], side="right")
    u, v = ((0.5 + (number + 1) / PLASTIC**power) % 1 for power in (1, 2))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)  # the square's other half, turned onto it
    return path[place.clip(max=len(path) - 1)], np.stack([1 - u - v, u, v], axis=1)
