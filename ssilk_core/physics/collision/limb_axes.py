# SPDX-License-Identifier: Apache-2.0
"""The axes of a character's limbs, which loose cloth must not cross.

Contact with the nearest point of the skin cannot free a thin limb that went through the cloth: it pushes the cloth
around a finger to all sides, where it stays. The axis of a limb runs along the bones from the root joint to its tip.
Cloth that crosses it an odd number of times lies across the limb. An even number is a fold, or a dent that nearest
points mend. Limbs that are crossed in the bind pose do not count, as where a mesh is closed around one. Nor does a
limb while it is buried: while its tip lies in another part of the body, as a thumb in a thigh, which cloth cannot
keep apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.assets import LOOSE, Body, Floats, Ints, Mesh, Scene, Skeleton
from ...scene.mesh import topology
from ..framed import Framed
from ..skinning import Skinning, transform_points
from .ray_casting import RayCaster
from .winding_number import ENCLOSED, winding_number

MAX_RADIUS = 0.08  # [m] of a bone
RADIUS_PERCENTILE = 90  # of the distances of a bone's skin from its line
MIN_LENGTH = 1e-6  # [m], so that a bone of no length has a direction
# Of the body's diagonal. Nothing is buried in skin so near to a tip at rest: the fingers of a fist lie in its palm.
TIP_REACH = 0.1
FRAMES_AT_ONCE = 256
MAX_PAIRS = 1 << 21  # of points and triangles in all frames at once


@dataclass(frozen=True, eq=False)
class LimbAxes:
    """M bones between joints, and the paths along them from the root to the tips of L limbs.

    Attributes:
        joints: that move the start and the end of each bone, shape (M, 2).
        ends: start and end in the bind pose [m], shape (M, 2, 3).
        radii: how far the skin is from each bone [m], shape (M,).
        paths: bones of each limb from the root on, padded with M, shape (L, K).
        beyond: length of a limb from the end of each of its bones to its tip [m], shape (L, K).
    """

    joints: Ints
    ends: Floats
    radii: Floats
    paths: Ints
    beyond: Floats

    @property
    def last(self) -> Ints:
        """The bone at the tip of each limb, shape (L,)."""
        count = (self.paths < len(self.joints)).sum(axis=1)
        return self.paths[np.arange(len(count)), count - 1]

    @property
    def tips(self) -> Ints:
        """The joint at the tip of each limb, shape (L,)."""
        return self.joints[self.last, 0]

    def chosen(self, limbs: NDArray[np.bool_]) -> LimbAxes | None:
        """Return those of some limbs (L,); None where there are none."""
        return replace(self, paths=self.paths[limbs], beyond=self.beyond[limbs]) if limbs.any() else None


def limb_axes(scene: Scene) -> LimbAxes | None:
    """Return the axes that the garment's loose cloth must not cross; None where there are none."""
    if not scene.character.bodies or not len(loose_faces(scene)):
        return None
    axes = body_axes(scene.character.merged_body(), scene.character.skeleton)
    return axes.chosen(clear_limbs(scene, axes))


def outfit_axes(scenes: Sequence[Scene]) -> tuple[LimbAxes | None, list[NDArray[np.bool_]]]:
    """Return the axes that some of an outfit's garments must not cross, and which of these each may not, bool (L,).

    Args:
        scenes: of the garments, on one character.
    """
    none = np.zeros(0, dtype=bool)
    if not scenes[0].character.bodies or not any(len(loose_faces(scene)) for scene in scenes):
        return None, [none] * len(scenes)
    axes = body_axes(scenes[0].character.merged_body(), scenes[0].character.skeleton)
    clear = [clear_limbs(scene, axes) for scene in scenes]
    kept = np.any(clear, axis=0)
    return axes.chosen(kept), [each[kept] for each in clear]


def clear_limbs(scene: Scene, axes: LimbAxes) -> NDArray[np.bool_]:
    """Tell which limbs of a body do not cross the garment's loose cloth in the bind pose, shape (L,)."""
    faces, mesh = loose_faces(scene), scene.garment.mesh
    if not len(faces):
        return np.zeros(len(axes.paths), dtype=bool)
    caster = RayCaster(replace(mesh, faces=faces), device=torch.device("cpu"))
    start, end = torch.tensor(axes.ends, dtype=torch.float32).unbind(1)
    points = torch.tensor(mesh.points, dtype=torch.float32)
    counts, *_ = caster.crossings(start[..., None], end[..., None], points[..., None])
    clear: NDArray[np.bool_] = (along_paths(counts, torch.as_tensor(axes.paths)).sum(1) % 2 == 0)[:, 0].numpy()
    return clear


def loose_faces(scene: Scene) -> Ints:
    """Return the triangles of the garment whose corners are all loose, shape (F, 3)."""
    faces = scene.garment.mesh.faces
    return faces[(scene.classes[faces] == LOOSE).all(axis=1)]


def body_axes(body: Body, skeleton: Skeleton) -> LimbAxes:
    """Return the axes of all limbs of a body, along the joints that move most of some of its skin."""
    mover = body.skin.indices[np.arange(body.mesh.vertex_count), body.skin.weights.argmax(axis=1)]
    origins, moving = skeleton.bind_transforms[:, :3, 3], np.unique(mover).tolist()
    chains = {joint: _chain(joint, skeleton.parents, set(moving)) for joint in moving}
    inner = {joint for chain in chains.values() for joint in chain[:-1]}
    joints, ends = [], []
    for joint in moving:  # the bone that ends in each joint but roots
        parent = chains[joint][-2] if len(chains[joint]) > 1 else joint
        joints.append((parent, joint))
        ends.append((origins[parent], origins[joint]))
    place, paths = {joint: number for number, joint in enumerate(moving)}, []
    for joint in (joint for joint in moving if joint not in inner):
        paths.append([*(place[each] for each in chains[joint][1:]), len(joints)])
        joints.append((joint, joint))
        ends.append((origins[joint], _tip(body.mesh.points[mover == joint], origins[joint])))
    bones = np.array(ends)
    lengths = np.append(np.linalg.norm(bones[:, 1] - bones[:, 0], axis=1), 0)
    radii = [_radius(body.mesh.points[mover == joint], *bone) for (joint, _), bone in zip(joints, bones)]
    padded = np.full((len(paths), max(map(len, paths))), len(joints))
    for row, path in zip(padded, paths):
        row[: len(path)] = path
    onward = lengths[padded][:, ::-1].cumsum(axis=1)[:, ::-1]
    return LimbAxes(np.array(joints), bones, np.array(radii), padded, onward - lengths[padded])


def _chain(joint: int, parents: Ints, moving: set[int]) -> list[int]:
    """Return the joints that move skin from the root down to `joint`."""
    chain, at = [], joint
    while at >= 0:
        if at in moving:
            chain.append(at)
        at = int(parents[at])
    return chain[::-1]


def _tip(skin: Floats, origin: Floats) -> Floats:
    """Return the end of the skin (P, 3) on the line from its joint through its middle."""
    away = skin.mean(axis=0) - origin
    away /= max(float(np.linalg.norm(away)), MIN_LENGTH)
    return origin + away * max(float(((skin - origin) @ away).max()), 0)


def _radius(skin: Floats, start: Floats, end: Floats) -> float:
    """Return how far skin (P, 3) is from the line through a bone [m]."""
    along = (end - start) / max(float(np.linalg.norm(end - start)), MIN_LENGTH)
    away = skin - start
    apart = np.linalg.norm(away - (away @ along)[:, None] * along, axis=1)
    return min(float(np.percentile(apart, RADIUS_PERCENTILE)), MAX_RADIUS)


def along_paths(values: Tensor, paths: Tensor) -> Tensor:
    """Return the values (M, N) of the bones of each path (L, K), zero where it is padded, shape (L, K, N)."""
    return torch.cat([values, torch.zeros_like(values[:1])])[paths]


@dataclass(frozen=True, eq=False)
class PosedLimbs(Framed):
    """Axes of limbs in N frames.

    Attributes:
        start, end: of each bone [m], shape (M, 3, N).
        radii: shape (M,); paths, beyond: shape (L, K); as in `LimbAxes`.
        buried: whether the tip of each limb lies in another part of the body, bool (L, N).
    """

    SHARED = frozenset({"radii", "paths", "beyond"})

    start: Tensor
    end: Tensor
    radii: Tensor
    paths: Tensor
    beyond: Tensor
    buried: Tensor


class LimbPoser:
    """Poses the axes of a body's limbs with skinning matrices.

    Args:
        body: all of it, also where only a part collides.
    """

    def __init__(self, axes: LimbAxes, body: Body, device: torch.device) -> None:
        def tensor(values: Floats) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.float32, device=device)

        self._joints = torch.as_tensor(axes.joints, device=device).T
        self._ends = tensor(axes.ends).transpose(0, 1)[..., None]
        self._radii, self._beyond = tensor(axes.radii), tensor(axes.beyond)
        self._paths, self._last = (torch.as_tensor(each, device=device) for each in (axes.paths, axes.last))
        self._faces = None
        if part := _away_from_tips(body, axes):
            self._faces = torch.as_tensor(np.array(part.mesh.faces), device=device)
            self._rest, self._skin = tensor(part.mesh.points), Skinning(part.skin).to(device)
            self._at_rest = inside(self._ends[1, self._last], self._rest[..., None], self._faces)

    @property
    def paths(self) -> Tensor:
        """Bones of each limb, as `LimbAxes.paths`."""
        return self._paths

    def reshape(self, ends: Tensor, radii: Tensor, beyond: Tensor) -> None:
        """Take other ends (M, 2, 3), radii (M,) and lengths (L, K) [m], in place; what is buried stays as it was."""
        self._ends.copy_(ends.transpose(0, 1)[..., None])
        self._radii.copy_(radii)
        self._beyond.copy_(beyond)

    def pose(self, character: Tensor, buried: Tensor | None = None) -> PosedLimbs:
        """Pose the axes with skinning matrices (J, 3, 4, N).

        Args:
            buried: the result of `buried` in these frames, where it is known.
        """
        start, end = (transform_points(character[joints], at) for joints, at in zip(self._joints, self._ends))
        buried = self.buried(character) if buried is None else buried
        return PosedLimbs(start, end, self._radii, self._paths, self._beyond, buried)

    @torch.no_grad()
    def buried(self, character: Tensor) -> Tensor:
        """Tell which limbs have their tip in another part of the body, and not so in the bind pose, bool (L, N).

        Skin near the tips of limbs does not count.
        """
        if self._faces is None:
            return torch.zeros(len(self._paths), character.shape[-1], dtype=torch.bool, device=character.device)
        joints = self._joints[1, self._last]
        found = []
        for part in character.split(FRAMES_AT_ONCE, dim=-1):
            skin = self._skin(self._rest, None, self._skin.weights, part)
            found.append(inside(transform_points(part[joints], self._ends[1, self._last]), skin, self._faces))
        return torch.cat(found, dim=1) & ~self._at_rest


def inside(points: Tensor, x: Tensor, faces: Tensor) -> Tensor:
    """Tell which points (P, 3, N) lie inside a surface with the vertices x (V, 3, N), bool (P, N).

    The surface may be inside out. A hole in it takes away its solid angle alone.
    """
    points, x, found = points.permute(0, 2, 1), x.permute(2, 0, 1), []
    at_once = max(1, MAX_PAIRS // max(1, len(points) * len(faces)))
    for frames in torch.arange(len(x), device=x.device).split(at_once):
        corners = x[frames][:, faces] - points[:, frames, None, None]  # (P, n, F, 3, 3)
        found.append(winding_number(corners.flatten(0, 1)).view(len(points), -1).abs() > ENCLOSED)
    return torch.cat(found, dim=1)


def _away_from_tips(body: Body, axes: LimbAxes) -> Body | None:
    """Return the part of a body that is away from the tips of all limbs; None where there is none."""
    from scipy.spatial import cKDTree

    mesh, skin = body.mesh, body.skin
    apart, _ = cKDTree(axes.ends[axes.last, 1]).query(mesh.points)
    chosen = np.flatnonzero(apart > TIP_REACH * mesh.diagonal)
    faces = topology.faces_among(mesh, chosen)
    if not len(faces):
        return None
    part = replace(skin, indices=skin.indices[chosen], weights=skin.weights[chosen])
    return Body(Mesh(mesh.path, mesh.points[chosen], faces), part)
