# SPDX-License-Identifier: Apache-2.0
"""What rides on a garment, so that every format that skins a mesh carries it.

Rigid things, such as buttons, brooches and feathers, get a joint of their own, which follows the cloth beneath them.

The joint stands where a point of the cloth goes that the rider lies on. It turns as the triangles beneath the rider
do on the whole: the rotation that takes their corners at rest nearest to where they are, by least squares weighted
with area [Kabsch 1976]. Three vertices that an artist chose carry a rider as Blender's vertex parenting does: their
mean, turned as the first edge and the normal.

Soft things, such as trims, have the weights and blendshapes of the cloth beneath each of their points. That is where
the cloth is as far as its weights change evenly from corner to corner: products of two barycentric coordinates stand
in for one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import fail
from .assets import Body, Deformer, Floats, GarmentPose, Ints, Mesh, Motion, ProxyRig, SkinWeights
from .kinematics import (
    combined_transforms,
    invert_rigid,
    local_transforms,
    quaternion_from_matrix,
    rigid,
    skin_points,
    skinning_matrices,
)
from .mesh.stitches import closest_shares, shares_on_plane

FARTHEST = 0.05  # [m] of a rider from its garment at rest
TOUCH = 0.005  # [m] beyond a rider's nearest vertex: what is as near lies on the cloth
SLIVER = 1e-6  # of the square of an edge: three vertices with less area name no direction
NAME_BYTES = 63  # of a joint, which is all that Blender keeps
PAIRS_AT_ONCE = 1 << 17


@dataclass(frozen=True, eq=False)
class Attachment:
    """The vertices of a garment that carry a rider.

    Attributes:
        vertices: shape (N,).
        shares: of each in the place where the rider is attached, they sum to one, shape (N,).
        weights: of each in the rider's rotation, shape (N,).
        chosen: three vertices that turn it by their first edge and normal, in place of a fit.
    """

    vertices: Ints
    shares: Floats
    weights: Floats
    chosen: bool = False

    @classmethod
    def to_vertices(cls, vertices: Sequence[int], mesh: Mesh, path: str) -> Attachment:
        """Attach a rider to three vertices of a garment.

        Raises:
            SsilkError: no such vertices, or three in a line.
        """
        found = np.array(vertices)
        if found.shape != (3,) or len(set(vertices)) != 3 or not ((found >= 0) & (found < mesh.vertex_count)).all():
            text = f"three different vertices of {mesh.path} are needed, from 0 to {mesh.vertex_count - 1}"
            fail(path, f"it rides on the vertices {str(list(vertices))[1:60].rstrip(']') or 'none'}", text)
        sides = np.diff(mesh.points[found], axis=0)
        if not np.linalg.norm(np.cross(*sides)) > SLIVER * (sides**2).sum():
            allowed = "three vertices that span a triangle are needed"
            fail(path, f"the vertices {', '.join(map(str, vertices))} lie in a line", allowed)
        return cls(found, np.full(3, 1 / 3), np.ones(3), chosen=True)

    @classmethod
    def beneath(cls, points: Floats, mesh: Mesh, path: str) -> Attachment:
        """Attach a rider with points (M, 3) [m] at rest to the triangles of a garment that it lies on.

        Raises:
            SsilkError: it is far from the garment.
        """
        face, place, touched = _lies_on(points, mesh, path)
        under = np.union1d(touched, face)
        corners = mesh.points[mesh.faces[under]]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        vertices = np.unique(mesh.faces[under])
        weights = np.bincount(np.searchsorted(vertices, mesh.faces[under]).ravel(), np.repeat(areas, 3))
        at = np.zeros(len(vertices))
        at[np.searchsorted(vertices, mesh.faces[face])] = place
        return cls(vertices, at, weights / weights.sum())

    def spread(self, rest: Floats) -> float:
        """Return how far apart the vertices (N, 3) are at rest, across the narrower way [m]: rotations are as exact
        as places, divided by it."""
        away = np.sqrt(self.weights / self.weights.sum())[:, None] * (rest - self.shares @ rest)
        return float(np.linalg.svd(away, compute_uv=False)[1])

    def frame(self, rest: Floats) -> Floats:
        """Return where the rider's joint is bound [m], shape (4, 4): along the first edge and the normal."""
        order = np.argsort(-self.weights, kind="stable")[:3] if not self.chosen else np.arange(3)
        turned = _edge_frames(rest[order][None])
        if not np.isfinite(turned).all():
            turned = np.eye(3)[None]
        return rigid(turned, (self.shares @ rest)[None])[0]

    def transforms(self, rest: Floats, posed: Floats) -> Floats:
        """Return what takes the rider from rest to its place, rigid [m], shape (F, 4, 4).

        Args:
            rest, posed: the vertices at rest, shape (N, 3), and in each frame, shape (F, N, 3).
        """
        before, after = self.shares @ rest, np.einsum("n,fnc->fc", self.shares, posed)
        moments = np.einsum("n,fna,nb->fab", self.weights, posed - after[:, None], rest - before)
        left, _, right = np.linalg.svd(moments)
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        turned = left @ right
        if self.chosen:
            edges = _edge_frames(posed) @ _edge_frames(rest[None]).swapaxes(1, 2)
            sound = np.isfinite(edges).all(axis=(1, 2))
            turned[sound] = edges[sound]
        return rigid(turned, after - turned @ before)


@dataclass(frozen=True, eq=False)
class Rider:
    """A thing on a garment, at the bind pose.

    Attributes:
        path: where it comes from, for messages.
        name: of its joint.
        meshes: what is drawn of it.
        attachment: what carries it; None where it is soft, and goes with the cloth beneath each of its points.
    """

    path: str
    name: str
    meshes: tuple[Mesh, ...]
    attachment: Attachment | None


def triangle_beneath(points: Floats, mesh: Mesh, path: str) -> Ints:
    """Return the vertices (3,) of the triangle beneath the middle of where a rider with points (M, 3) [m] lies.

    Raises:
        SsilkError: it is far from the garment.
    """
    return mesh.faces[_lies_on(points, mesh, path)[0]]


class RiderJoints:
    """A garment with a joint for each rigid rider, after its proxies.

    A joint hangs on the one that moves most of the cloth beneath it: between frames, and in corrections by hand,
    riders follow that.

    Args:
        influences: most joints that move a point of a soft rider; None for all of the cloth beneath it.

    Attributes:
        deformer: the garment with these joints; without any as it was.
        bodies: the riders' meshes, bound to the joints that move them.
        shapes: of each, offsets by the deformer's blendshapes [m], shape (K, M, 3); None where it is rigid.
        names: paths of the joints.
    """

    def __init__(self, deformer: Deformer, riders: Sequence[Rider], influences: int | None = None) -> None:
        self._own, self._all, scene = deformer, tuple(riders), deformer.scene
        rest = scene.garment.mesh.points
        self._riders = [(rider, rider.attachment) for rider in riders if rider.attachment]
        self._rest = [rest[attachment.vertices] for _, attachment in self._riders]
        frames = [attachment.frame(own) for (_, attachment), own in zip(self._riders, self._rest)]
        self._binds = np.array(frames).reshape(-1, 4, 4)
        self._parents = [_carrier(attachment, deformer) for _, attachment in self._riders]
        self.names = _joint_paths([rider for rider, _ in self._riders], self._parents, scene.joint_names)
        self.deformer = deformer
        if self._riders:
            rig = scene.rig
            rig = ProxyRig(
                rig.path,
                (*rig.joint_names, *self.names),
                np.concatenate([rig.parents, self._parents]),
                np.concatenate([rig.bind_transforms, self._binds]),
                rig.skin,
            )
            self.deformer = replace(deformer, scene=replace(scene, rig=rig))
        self._feet: dict[Mesh, tuple[Ints, Floats]] = {}  # of soft meshes: corners and shares, shapes (M, 3)
        joints = iter(range(len(scene.joint_names), len(self.deformer.scene.joint_names)))
        bound = [each for rider in riders for each in self._bound(rider, joints, influences)]
        self.bodies = tuple(body for body, _ in bound)
        self.shapes = tuple(shapes for _, shapes in bound)

    def __len__(self) -> int:
        return len(self._all)

    def _bound(
        self, rider: Rider, joints: Iterator[int], influences: int | None
    ) -> Iterator[tuple[Body, Floats | None]]:
        """Yield the meshes of a rider with what moves them."""
        if rider.attachment:
            joint = next(joints)
            for mesh in rider.meshes:
                yield Body(mesh, SkinWeights.rigid(mesh.path, joint, mesh.vertex_count)), None
            return
        cloth, skin = self._own.scene.garment.mesh, self._own.skin
        weights = skin.dense(len(self._own.scene.joint_names))
        for mesh in rider.meshes:
            faces, shares, _ = _feet(mesh.points, cloth)
            corners = cloth.faces[faces]
            self._feet[mesh] = corners, shares
            mixed = SkinWeights.from_dense(mesh.path, np.einsum("mn,mnj->mj", shares, weights[corners]), influences)
            yield Body(mesh, mixed), np.einsum("mn,kmnc->kmc", shares, self._own.shapes[:, corners])

    def poses(
        self, motion: Motion, poses: Iterable[GarmentPose], points: Iterable[Floats] | None = None
    ) -> Iterator[GarmentPose]:
        """Yield poses with those of the riders' joints.

        Args:
            motion: of the character; `poses` cover it in order.
            points: garment vertices of each frame in the world [m], shape (V, 3), where others are shown than those
                that the poses give.
        """
        if not self._riders:
            yield from poses
            return
        shown = None if points is None else iter(points)
        scene = self._own.scene
        joints = scene.character.skeleton.joint_count
        places = local_transforms(scene.bind_transforms, scene.parents)[joints:, :3, 3]
        used = np.unique(np.concatenate([attachment.vertices for _, attachment in self._riders]))
        for pose in poses:
            world = combined_transforms(self._own, motion, pose)
            if shown is None:
                posed = self._skinned(world, pose, used)
            else:
                posed = np.stack([next(shown)[used] for _ in range(pose.frame_count)])
            placed = np.stack(list(self._placed(posed, used)), axis=1) @ self._binds
            local = invert_rigid(world[:, self._parents]) @ placed
            moved = pose.translations
            if moved is None:
                moved = np.broadcast_to(places, (pose.frame_count, *places.shape))
            turned = np.concatenate([pose.rotations, quaternion_from_matrix(local[..., :3, :3])], axis=1)
            yield replace(pose, rotations=turned, translations=np.concatenate([moved, local[..., :3, 3]], axis=1))

    def rider_points(self, garment: Floats) -> Iterator[tuple[Floats, float]]:
        """Yield where the cloth (V, 3) [m] carries each of `bodies`, shape (M, 3), and by how much it multiplies what
        the cloth is off there; infinite where the rider is soft, and may differ."""
        rigid_rests, cloth = iter(self._rest), self._own.scene.garment.mesh
        for rider in self._all:
            if rider.attachment is None:
                for mesh in rider.meshes:
                    yield _on_cloth(mesh.points, *self._feet[mesh], cloth.points, garment), np.inf
                continue
            attachment, rest = rider.attachment, next(rigid_rests)
            moved = attachment.transforms(rest, garment[attachment.vertices][None])[0]
            for mesh in rider.meshes:
                reach = np.linalg.norm(mesh.points - attachment.shares @ rest, axis=1).max()
                yield mesh.points @ moved[:3, :3].T + moved[:3, 3], float(1 + reach / attachment.spread(rest))

    def _placed(self, posed: Floats, used: Ints) -> Iterator[Floats]:
        for (_, attachment), rest in zip(self._riders, self._rest):
            yield attachment.transforms(rest, posed[:, np.searchsorted(used, attachment.vertices)])

    def _skinned(self, world: Floats, pose: GarmentPose, rows: Ints) -> Floats:
        """Return some vertices of the garment in the world [m], shape (F, N, 3)."""
        deformer, mesh = self._own, self._own.scene.garment.mesh
        shapes = deformer.shapes[:, rows]
        rest = mesh.points[rows] + np.einsum("fk,kvc->fvc", pose.weights.astype(np.float64), shapes)
        skin = SkinWeights(deformer.skin.path, deformer.skin.indices[rows], deformer.skin.weights[rows])
        return skin_points(rest, skin, skinning_matrices(world, deformer.scene.bind_transforms))


def _carrier(attachment: Attachment, deformer: Deformer) -> int:
    """Return the joint that moves most of what carries a rider."""
    skin, rows = deformer.skin, attachment.vertices
    shares = attachment.shares[:, None] * skin.weights[rows]
    return int(np.bincount(skin.indices[rows].ravel(), shares.ravel()).argmax())


def _joint_paths(riders: Sequence[Rider], parents: Sequence[int], joints: Sequence[str]) -> tuple[str, ...]:
    taken, found = {joint.rpartition("/")[2] for joint in joints}, []
    for rider, parent in zip(riders, parents):
        tries = (ending and f"_{ending}" for ending in ["", *range(2, len(taken) + 3)])
        cut = (rider.name.encode()[: NAME_BYTES - len(str(end))].decode(errors="ignore") + str(end) for end in tries)
        own = next(name for name in cut if name not in taken)
        taken.add(own)
        found.append(f"{joints[parent]}/{own}")
    return tuple(found)


def _on_cloth(points: Floats, corners: Ints, shares: Floats, rest: Floats, posed: Floats) -> Floats:
    """Return where points (M, 3) at rest are on posed cloth: each with its triangle, turned as that is.

    Args:
        corners, shares: the triangle of each point and the barycentric coordinates of its foot, shapes (M, 3).
        rest, posed: vertices of the cloth, shape (V, 3).
    """
    before, after = rest[corners], posed[corners]
    turned = np.nan_to_num(_edge_frames(after) @ _edge_frames(before).swapaxes(1, 2))
    feet, moved = (np.einsum("mn,mnc->mc", shares, each) for each in (before, after))
    return moved + (turned @ (points - feet)[..., None])[..., 0]


def _edge_frames(corners: Floats) -> Floats:
    """Return rotations (F, 3, 3) with the x axis along the first edge of triangles (F, 3, 3) and z along the normal;
    not finite where a triangle has no area."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = np.cross(first, second)
        z = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        x = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _lies_on(points: Floats, mesh: Mesh, path: str) -> tuple[int, Floats, Ints]:
    """Return the triangle beneath the middle of where a rider touches a mesh, the barycentric coordinates of this
    place, shape (3,), and all triangles that it touches.

    Raises:
        SsilkError: it is far from the mesh.
    """
    faces, shares, distances = _feet(points, mesh)
    nearest = float(distances.min())
    if not nearest <= FARTHEST:
        allowed = f"a rider lies within {1000 * FARTHEST:g} mm of its garment at rest"
        todo = "move it there, or choose three vertices that carry it (ssilk:rideVertices)"
        fail(path, f"it is {1000 * nearest:.3g} mm away from {mesh.path}", allowed, todo)
    touching = distances <= nearest + TOUCH
    feet = (shares[touching, :, None] * mesh.points[mesh.faces[faces[touching]]]).sum(axis=1)
    (face,), (place,), _ = _feet(feet.mean(axis=0)[None], mesh)
    return int(face), place, np.unique(faces[touching])


def _feet(points: Floats, mesh: Mesh) -> tuple[Ints, Floats, Floats]:
    """Return the closest triangle of a mesh to each point (M, 3), the barycentric coordinates of the closest point
    on it, shape (M, 3), and its distance [m], shape (M,)."""
    corners = mesh.points[mesh.faces]
    sides = corners[:, 1:] - corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    sound = np.flatnonzero(np.linalg.norm(normals, axis=1) > SLIVER * (sides**2).sum(axis=(1, 2)))
    if not len(sound):
        fail(mesh.path, "its triangles have no area", "a rider needs cloth to ride on")
    middle, radius = corners[sound].mean(axis=1), np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=2)
    centre = points.mean(axis=0)
    reach = np.linalg.norm(points - centre, axis=1).max()
    # The closest point of the mesh to any of the points is no farther than a corner is.
    least = np.linalg.norm(mesh.points[mesh.faces[sound]].reshape(-1, 3) - centre, axis=1).min() + reach
    near = np.linalg.norm(middle - centre, axis=1) <= least + reach + radius[sound].max(axis=1)
    faces = sound[near]
    found, step = [], max(1, PAIRS_AT_ONCE // len(faces))
    for start in range(0, len(points), step):
        part = points[start : start + step]
        pairs = np.tile(faces, len(part))
        offset = (part[:, None] - corners[faces, 0]).reshape(-1, 3)
        shares = closest_shares(shares_on_plane(offset, sides[pairs], normals[pairs]), offset, sides[pairs])
        away = offset - np.einsum("mk,mkc->mc", shares[:, 1:], sides[pairs])
        distances = np.linalg.norm(away, axis=1).reshape(len(part), -1)
        best = distances.argmin(axis=1)
        rows = np.arange(len(part))
        found.append((faces[best], shares.reshape(len(part), -1, 3)[rows, best], distances[rows, best]))
    chosen, at, distance = (np.concatenate(each) for each in zip(*found))
    return chosen, at, distance
