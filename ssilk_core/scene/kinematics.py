# SPDX-License-Identifier: Apache-2.0
"""Rotations, forward kinematics and skinning in float64 numpy, the reference implementation of the fast paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .assets import Character, Deformer, Floats, GarmentPose, Ints, Motion, ProxyRig, Scene, Skeleton, SkinWeights
from .assets.body_shape import shaped

POSES_AT_ONCE = 256  # frames in each chunk of LBS poses


def matrix_from_quaternion(quaternions: Floats) -> Floats:
    """Return rotation matrices, shape (..., 3, 3), of unit quaternions (w, x, y, z), shape (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternions, dtype=np.float64), -1, 0).copy()
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    entries = (1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy), 2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
               2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy))  # fmt: skip
    return np.stack(entries, axis=-1).reshape(*np.shape(w), 3, 3)


def quaternion_from_matrix(matrices: Floats) -> Floats:
    """Return unit quaternions (w, x, y, z), w >= 0, shape (..., 4), of rotation matrices (..., 3, 3)."""
    m = np.asarray(matrices, dtype=np.float64)
    diagonal = np.moveaxis(np.diagonal(m, axis1=-2, axis2=-1), -1, 0)
    trace = diagonal.sum(axis=0)
    # Four candidates, each accurate where its own component is large; take the best-conditioned one.
    squares = np.stack([trace, *(2 * diagonal - trace)], axis=-1)
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 1, 0] + m[..., 0, 1]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 2, 1] + m[..., 1, 2]
    s = squares + 1
    candidates = np.stack(
        [
            np.stack([s[..., 0], a, b, c], axis=-1),
            np.stack([a, s[..., 1], d, e], axis=-1),
            np.stack([b, d, s[..., 2], f], axis=-1),
            np.stack([c, e, f, s[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)[..., None, None]
    q = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def multiply_quaternions(p: Floats, q: Floats) -> Floats:
    """Return the products p * q (first q, then p), shape (..., 4)."""
    pw, px, py, pz = np.moveaxis(np.asarray(p), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def slerp(p: Floats, q: Floats, t: Floats) -> Floats:
    """Interpolate unit quaternions (..., 4) along the shorter great arc; `t` in [0, 1] broadcasts over (...)."""
    cosine = np.sum(p * q, axis=-1)
    q = np.where(cosine[..., None] < 0, -q, q)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6  # the arc is a line to machine precision
    safe = np.where(near, 1.0, sine)
    a = np.where(near, 1 - t, np.sin((1 - t) * angle) / safe)
    b = np.where(near, t, np.sin(t * angle) / safe)
    mixed = a[..., None] * p + b[..., None] * q
    return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)


def continuous(rotations: Floats, before: Floats | None = None) -> Floats:
    """Choose the signs of quaternions (F, J, 4) so that none flips between frames: some readers mix them
    componentwise.

    Args:
        before: the quaternions of the frame before the first one, shape (1, J, 4).
    """
    first = rotations[:1] if before is None else before
    steps = np.sum(np.concatenate([first, rotations[:-1]]) * rotations, axis=-1)
    return rotations * np.cumprod(np.where(steps < 0, -1.0, 1.0), axis=0)[..., None]


def rigid(rotations: Floats, translations: Floats) -> Floats:
    """Return (..., 4, 4) transforms from rotation matrices (..., 3, 3) and translations (..., 3)."""
    result = np.zeros((*rotations.shape[:-2], 4, 4))
    result[..., :3, :3] = rotations
    result[..., :3, 3] = translations
    result[..., 3, 3] = 1
    return result


def invert_rigid(transforms: Floats) -> Floats:
    """Return the inverses of rigid transforms, shape (..., 4, 4)."""
    rotation = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return rigid(rotation, -(rotation @ transforms[..., :3, 3:])[..., 0])


def world_transforms(local: Floats, parents: Ints) -> Floats:
    """Return joint-to-world from joint-to-parent transforms, both (..., J, 4, 4); parents precede children."""
    world = np.array(local, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[..., joint, :, :] = world[..., parent, :, :] @ local[..., joint, :, :]
    return world


def local_transforms(world: Floats, parents: Ints) -> Floats:
    """Return joint-to-parent from joint-to-world transforms, both (..., J, 4, 4)."""
    local = np.array(world, dtype=np.float64)
    children = np.flatnonzero(np.asarray(parents) >= 0)
    above = np.asarray(parents)[children]
    local[..., children, :, :] = invert_rigid(world[..., above, :, :]) @ world[..., children, :, :]
    return local


def bind_pose(skeleton: Skeleton) -> tuple[Floats, Floats]:
    """Return the joints' rotations (J, 4) and translations (J, 3) [m] in the bind pose, joint to parent."""
    local = local_transforms(skeleton.bind_transforms, skeleton.parents)
    return quaternion_from_matrix(local[:, :3, :3]), local[:, :3, 3]


def hub_places(skeleton: Skeleton, rotations: Floats, translations: Floats) -> Floats:
    """Return the hub's positions [m], shape (F, 3), of local rotations (F, J, 4) and translations (F, J, 3)."""
    *above, hub = skeleton.hub_path
    places = translations[:, hub]
    for joint in reversed(above):
        places = (matrix_from_quaternion(rotations[:, joint]) @ places[..., None])[..., 0] + translations[:, joint]
    return places


def first_place(motion: Motion, skeleton: Skeleton) -> Floats:
    """Return the hub's position in the first frame of a motion [m], shape (3,)."""
    return hub_places(skeleton, motion.rotations[:1], motion.translations[:1])[0].copy()


def motion_transforms(motion: Motion, parents: Ints) -> Floats:
    """Return joint-to-world transforms for every frame of a motion [m], shape (F, J, 4, 4)."""
    return world_transforms(rigid(matrix_from_quaternion(motion.rotations), motion.translations), parents)


def frames_at(frame_count: int, source: float, target: float) -> int:
    """Return the number of frames at rate `target` within the duration of `frame_count` frames at rate `source`.

    Both ends of the duration count.
    """
    return int(np.floor((frame_count - 1) * target / source + 1e-6)) + 1


def resample(motion: Motion, fps: float, *, cover: bool = False) -> Motion:
    """Resample a motion to `fps`, with slerp for rotations and linear interpolation for translations.

    The last frame lies at or before the end of the motion. With `cover` it lies at or after the end, and repeats
    the last pose.
    """
    if abs(motion.fps - fps) < 1e-9 * fps:
        return motion
    last = motion.frame_count - 1
    count = (
        int(np.ceil(last * fps / motion.fps - 1e-6)) + 1 if cover else frames_at(motion.frame_count, motion.fps, fps)
    )
    position = np.minimum(np.arange(count) * motion.fps / fps, last)
    return Motion(motion.path, fps, *sample_motion(motion, position), **sample_felt(motion, position))


MAX_HOLD = 100  # frames for which a garment's pose is held
MIN_FPS, MAX_FPS = 0.01, 10_000  # [1/s] of motions: beyond them, time codes and frames cannot be counted
EASE = 0.25  # [s] in which a run-up accelerates from rest to the speed of the motion


def run_up(motion: Motion, seconds: float) -> Motion:
    """Return frames to put before a motion: its first pose at rest, then eased into the speed of its first step.

    Args:
        seconds: duration [s], rounded to frames, at least one.
    """
    count = max(round(seconds * motion.fps), 1)
    easing = min(count, EASE * motion.fps)
    away = np.arange(count, 0, -1.0).clip(max=easing)
    away -= away**2 / (2 * easing)  # distance from the first frame [steps]; the speed rises from zero to one
    first, second = (motion.clip(frame, frame + 1) for frame in (0, min(1, motion.frame_count - 1)))
    rotations = slerp(first.rotations, second.rotations, -away[:, None])
    translations = first.translations - away[:, None, None] * (second.translations - first.translations)
    felt = {name: values.repeat(count, axis=0) for name, values in first.felt.items()}
    return Motion(motion.path, motion.fps, rotations, translations, shapes=motion.shapes, **felt)


CUT_SPEED = 25.0  # [m/s] deviation from the median velocity above which the hub was teleported, not animated
CUT_WINDOW = 5  # frames on either side for that median, so that a fast vehicle is not a jump

# Flips of captured joints are faster than this [rad/s], human motion is slower; the garment must not learn from
# flips.
MAX_JOINT_SPEED = 40.0


def split_at_cuts(motion: Motion, skeleton: Skeleton, *, max_joint_speed: float = np.inf) -> list[Motion]:
    """Split a motion at jumps of the hub (teleports, edits) and return the spans in order.

    A jump is a step that deviates from the median of the steps around it by more than `CUT_SPEED`. With
    `max_joint_speed` [rad/s] the motion is also split where a joint rotates faster, such as a flip in captured data.
    """
    step = (
        _deviation_from_median(np.diff(hub_places(skeleton, motion.rotations, motion.translations), axis=0))
        * motion.fps
    )
    cosine = np.abs((motion.rotations[1:] * motion.rotations[:-1]).sum(-1)).clip(max=1.0)
    turn = 2 * np.arccos(cosine).max(axis=1) * motion.fps
    ends = [*(np.flatnonzero((step > CUT_SPEED) | (turn > max_joint_speed)) + 1), motion.frame_count]
    return [motion.clip(start, stop) for start, stop in zip([0, *ends[:-1]], ends)]


def held_at_cuts(motion: Motion, skeleton: Skeleton, position: Floats) -> Floats:
    """Return fractional frames, shape (N,), without those between a cut's two frames: the first of them is held."""
    firsts = np.cumsum([span.frame_count for span in split_at_cuts(motion, skeleton)])[:-1]
    low = np.floor(position)
    return np.where(np.isin(low + 1, firsts), low, position)


def _deviation_from_median(steps: Floats) -> Floats:
    """Return the distance of each step (N, 3) from the median of those around it [m], shape (N,)."""
    if not len(steps):
        return np.zeros(0)
    padded = np.pad(steps, ((CUT_WINDOW, CUT_WINDOW), (0, 0)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * CUT_WINDOW + 1, axis=0)
    return np.linalg.norm(steps - np.median(around, axis=-1), axis=1)


def sample_motion(motion: Motion, position: Floats) -> tuple[Floats, Floats]:
    """Return rotations (N, J, 4) and translations (N, J, 3) at fractional frames `position`, shape (N,)."""
    low = np.minimum(position.astype(int), motion.frame_count - 1)
    high = np.minimum(low + 1, motion.frame_count - 1)
    t = (position - low)[:, None]
    rotations = slerp(motion.rotations[low], motion.rotations[high], t)
    translations = motion.translations[low] * (1 - t[..., None]) + motion.translations[high] * t[..., None]
    return rotations, translations


def sample_felt(motion: Motion, position: Floats) -> dict[str, Any]:
    """Return `Motion.felt` at fractional frames (N,), linear between frames, and the shapes that it weighs."""
    low = np.minimum(position.astype(int), motion.frame_count - 1)
    high = np.minimum(low + 1, motion.frame_count - 1)

    def between(values: Floats) -> Floats:
        t = (position - low).reshape(-1, *[1] * (values.ndim - 1))
        return values[low] * (1 - t) + values[high] * t

    felt: dict[str, Any] = {name: between(values) for name, values in motion.felt.items()}
    return {**felt, "shapes": motion.shapes} if motion.shapes else felt


def sample_shapes(motion: Motion, position: Floats) -> dict[str, Any]:
    """Return of `sample_felt` the character's shapes and their weights alone; nothing where it has none."""
    felt = sample_felt(motion, position) if motion.shapes else {}
    return {name: values for name, values in felt.items() if name in ("shapes", "shape_weights")}


def skin_points(points: Floats, skin: SkinWeights, matrices: Floats) -> Floats:
    """Apply linear blend skinning.

    Args:
        points: rest positions [m], shape (V, 3) or (F, V, 3).
        skin: weights of the V points.
        matrices: transform of each joint from bind pose to posed world, shape (F, J, 4, 4).

    Returns:
        Posed positions [m], shape (F, V, 3).
    """
    points = np.broadcast_to(points, (len(matrices), *points.shape[-2:]))
    posed = np.zeros(points.shape)
    for index, weight in zip(skin.indices.T, skin.weights.T):
        joint = matrices[:, index]
        posed += weight[:, None] * ((joint[..., :3, :3] @ points[..., None])[..., 0] + joint[..., :3, 3])
    return posed


def body_at_rest(character: Character, motion: Motion, frames: slice | Ints = slice(None)) -> Floats:
    """Return the points of `Character.merged_body` in the bind pose [m]: as its stage has them, shape (B, 3), or as a
    motion shapes them in some frames, shape (F, B, 3)."""
    points = character.merged_body().mesh.points
    if motion.shape_weights is None:
        return points
    parts = [
        shaped(body.mesh.points, motion.shapes, motion.shape_weights[frames], number)
        for number, body in enumerate(character.bodies)
    ]
    return np.concatenate(parts, axis=1)


def sorted_influences(skin: SkinWeights) -> tuple[Ints, Floats]:
    """Return joint indices (int32) and weights (float32), heaviest first, each joint once, shape (V, I)."""
    # By way of the dense matrix a joint that a row names twice is added up, where Blender keeps the last one only.
    merged = SkinWeights.from_dense(skin.path, skin.dense(int(skin.indices.max()) + 1))
    weights = merged.weights.astype(np.float32)
    # Far from the origin an error in the sum moves the vertex: let the heaviest weight take up the rounding.
    weights[:, 0] = 1 - weights[:, 1:].sum(axis=1, dtype=np.float64)
    # Beside equal ones it may be lighter then: thirds become 0.33333331, 0.33333334, 0.33333334.
    order = np.argsort(-weights, axis=1, kind="stable")
    return np.take_along_axis(merged.indices, order, axis=1), np.take_along_axis(weights, order, axis=1)


def skinning_matrices(world: Floats, bind_transforms: Floats) -> Floats:
    """Return the transform of each joint from bind pose to posed world, shape (F, J, 4, 4)."""
    return world @ invert_rigid(bind_transforms)


def combined_transforms(deformer: Deformer, motion: Motion, pose: GarmentPose) -> Floats:
    """Return joint-to-world transforms of joints, then proxies, for the frames of `pose`, shape (F, J + P, 4, 4)."""
    scene = deformer.scene
    skeleton, rig = scene.character.skeleton, scene.rig
    frames = slice(pose.start, pose.start + pose.frame_count)
    character = rigid(matrix_from_quaternion(motion.rotations[frames]), motion.translations[frames])
    translations = pose.translations
    if translations is None:
        rest = local_transforms(scene.bind_transforms, scene.parents)[skeleton.joint_count :]
        translations = np.broadcast_to(rest[:, :3, 3], (pose.frame_count, rig.proxy_count, 3))
    proxies = rigid(matrix_from_quaternion(pose.rotations), translations)
    return world_transforms(np.concatenate([character, proxies], axis=1), scene.parents)


@dataclass(frozen=True, eq=False)
class ProxyAxes:
    """Converts proxy transforms between the axes of the bind pose, as networks use them, and those of files.

    Attributes:
        above, own: bind rotations of the parents and of the proxies, shape (P, 3, 3).
        places: local translations of the proxies in the bind pose [m], shape (P, 3).
    """

    above: Floats
    own: Floats
    places: Floats

    @classmethod
    def of(cls, scene: Scene) -> ProxyAxes:
        binds, joints = scene.bind_transforms, scene.character.skeleton.joint_count
        places = local_transforms(binds, scene.parents)[joints:, :3, 3]
        return cls(binds[scene.rig.parents][:, :3, :3], binds[joints:, :3, :3], places)

    def to_local(self, transforms: Floats) -> tuple[Floats, Floats]:
        """Return local rotations (F, P, 4) and translations (F, P, 3) [m] of transforms (F, P, 3, 4)."""
        to_parent = np.swapaxes(self.above, -1, -2)
        turned = to_parent @ transforms[..., :3].astype(np.float64) @ self.own
        moved = (to_parent @ transforms[..., 3:].astype(np.float64))[..., 0]
        return quaternion_from_matrix(turned), self.places + moved

    def to_bind(self, rotations: Floats, translations: Floats | None) -> Floats:
        """Invert `to_local`; without translations the proxies stay at their places."""
        turned = self.above @ matrix_from_quaternion(rotations) @ np.swapaxes(self.own, -1, -2)
        away = np.zeros((*rotations.shape[:2], 3)) if translations is None else translations - self.places
        return np.concatenate([turned, self.above @ away[..., None]], axis=-1)


def deform(deformer: Deformer, motion: Motion, pose: GarmentPose) -> Floats:
    """Decode a pose to garment vertices in world space [m], shape (F, V, 3) (Eqs. 5 and 8).

    `motion` is the character's motion over the whole shot; `pose.start` is the index of the pose's first frame.
    """
    scene = deformer.scene
    matrices = skinning_matrices(combined_transforms(deformer, motion, pose), scene.bind_transforms)
    canonical = scene.garment.mesh.points + np.einsum("fk,kvc->fvc", pose.weights.astype(np.float64), deformer.shapes)
    return skin_points(canonical, deformer.skin, matrices)


def lbs_deformer(scene: Scene) -> Deformer:
    """Return a garment under linear blend skinning: no proxies, no blendshapes."""
    none = ProxyRig(scene.rig.path, (), np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4)), scene.lbs_skin)
    return Deformer(replace(scene, rig=none), scene.lbs_skin, np.zeros((0, scene.garment.mesh.vertex_count, 3)))


def lbs_poses(frame_count: int) -> Iterator[GarmentPose]:
    """Yield the poses of an `lbs_deformer`, which have no proxies and weights, in chunks of frames."""
    for start in range(0, frame_count, POSES_AT_ONCE):
        frames = min(POSES_AT_ONCE, frame_count - start)
        yield GarmentPose(start, np.zeros((frames, 0, 4)), np.zeros((frames, 0)))


def centred_matrices(motion: Motion, skeleton: Skeleton) -> tuple[Floats, Floats]:
    """Return skinning matrices (F, J, 4, 4) with the first frame's hub at the origin, and its position (3,) [m]."""
    world = motion_transforms(motion, skeleton.parents)
    origin = world[0, skeleton.hub, :3, 3].copy()
    world[..., :3, 3] -= origin
    return skinning_matrices(world, skeleton.bind_transforms), origin
