# SPDX-License-Identifier: Apache-2.0
"""A garment held where linear blend skinning has it, by its proxies, and what lies between that and another pose.

A trained garment has weights of its own, so that proxies at rest do not give its linear blend skinning. They are
fitted to it, one after the other, each by the rigid motion that takes what the others leave (Le and Deng, "Smooth
Skinning Decomposition with Rigid Bones", 2012). Blendshapes stay in the middle of their range.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .assets import Deformer, Floats, GarmentPose, Motion
from .kinematics import (
    ProxyAxes,
    local_transforms,
    motion_transforms,
    quaternion_from_matrix,
    skin_points,
    skinning_matrices,
    slerp,
)

SAMPLE = 512  # vertices that proxies are fitted to
SWEEPS = 10  # over all proxies; three leave half a millimetre more, and thirty a tenth less
LEAST = 1e-6  # weight below which a vertex does not follow a proxy


class HeldGarment:
    """Poses in which proxies hold a garment where linear blend skinning has it.

    Attributes:
        weights: of the blendshapes then, shape (K,).
    """

    def __init__(self, deformer: Deformer) -> None:
        scene = deformer.scene
        self.deformer, self.places = deformer, ProxyAxes.of(scene).places
        self.joints, self.proxies = scene.character.skeleton.joint_count, scene.rig.proxy_count
        self.weights = _nearest_to_rest(deformer.shapes)
        self._rest = local_transforms(scene.bind_transforms, scene.parents)[self.joints :]
        rows = np.random.default_rng(0).permutation(scene.garment.mesh.vertex_count)[:SAMPLE]
        self._rows = np.sort(rows)
        points = scene.garment.mesh.points + np.tensordot(self.weights, deformer.shapes, axes=1)
        self._points, skin = points[self._rows], deformer.skin.dense(self.joints + self.proxies)[self._rows]
        self._body, followers = skin[:, : self.joints], skin[:, self.joints :]
        self._followers = [(own := np.flatnonzero(each > LEAST), each[own]) for each in followers.T]

    def pose(self, motion: Motion) -> tuple[GarmentPose, Floats]:
        """Return the poses of all frames of a motion, and the RMS distance from linear blend skinning [m], (F,)."""
        scene, frames = self.deformer.scene, motion.frame_count
        skeleton, binds = scene.character.skeleton, scene.bind_transforms[self.joints :]
        world = motion_transforms(motion, skeleton.parents)
        matrices = skinning_matrices(world, skeleton.bind_transforms)
        skin = scene.lbs_skin
        own = replace(skin, indices=skin.indices[self._rows], weights=skin.weights[self._rows])
        wanted = skin_points(scene.garment.mesh.points[self._rows], own, matrices)
        at = np.column_stack([self._points, np.ones(len(self._points))])
        left = wanted - np.einsum("vj,fjab,vb->fva", self._body, matrices[:, :, :3], at, optimize=True)
        fitted = np.tile(np.eye(4), (frames, self.proxies, 1, 1))
        moved = [self._first(number, wanted) for number in range(self.proxies)]
        for number, (rows, weights) in enumerate(self._followers):
            left[:, rows] -= weights[:, None] * _moved(moved[number], self._points[rows])
        for _ in range(SWEEPS):
            for number, (rows, weights) in enumerate(self._followers):
                if len(rows):
                    target = left[:, rows] + weights[:, None] * _moved(moved[number], self._points[rows])
                    moved[number] = _rigid(self._points[rows], target / weights[:, None], weights**2)
                    left[:, rows] = target - weights[:, None] * _moved(moved[number], self._points[rows])
        for number, (rotations, translations) in enumerate(moved):
            fitted[:, number, :3, :3], fitted[:, number, :3, 3] = rotations, translations
        local = local_transforms(np.concatenate([world, fitted @ binds], axis=1), scene.parents)[:, self.joints :]
        idle = [number for number, (rows, _) in enumerate(self._followers) if not len(rows)]
        local[:, idle] = self._rest[idle]
        found = GarmentPose(
            0, quaternion_from_matrix(local[..., :3, :3]), np.tile(self.weights, (frames, 1)), local[..., :3, 3]
        )
        return found, np.sqrt((left**2).sum(axis=-1).mean(axis=-1))

    def _first(self, number: int, wanted: Floats) -> tuple[Floats, Floats]:
        """Return where a proxy takes its vertices as if no other moved them."""
        rows, weights = self._followers[number]
        if not len(rows):
            return np.tile(np.eye(3), (len(wanted), 1, 1)), np.zeros((len(wanted), 3))
        return _rigid(self._points[rows], wanted[:, rows], weights)

    def blended(self, held: GarmentPose, free: GarmentPose, share: Floats) -> GarmentPose:
        """Return poses between held and free ones of the same frames.

        Args:
            share: of the free ones, 0 to 1, shape (F,).
        """
        part = share[:, None]
        start, end = (self.places if each.translations is None else each.translations for each in (held, free))
        weights = held.weights + part * (free.weights - held.weights)
        moved = start + part[..., None] * (end - start)
        return GarmentPose(free.start, slerp(held.rotations, free.rotations, part), weights, moved)


def _nearest_to_rest(shapes: Floats) -> Floats:
    """Return weights in [0, 1] of shapes (K, V, 3) that leave about the rest shape; the last one is constant.

    It recentres all others, and only in models that were cut down to another shape than that at rest.
    """
    count = len(shapes)
    if not count:
        return np.zeros(0)
    flat = shapes.reshape(count, -1)
    middle = 0.5 * flat[:-1].sum(axis=0) + flat[-1]
    change = np.linalg.lstsq(flat[:-1].T, -middle, rcond=1e-6)[0]
    return np.append((0.5 + change).clip(0, 1), 1.0)


def _moved(motion: tuple[Floats, Floats], points: Floats) -> Floats:
    rotations, translations = motion
    return points @ np.swapaxes(rotations, -1, -2) + translations[:, None]


def _rigid(points: Floats, targets: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the rotations (F, 3, 3) and translations (F, 3) that take points (V, 3) nearest to targets (F, V, 3).

    Least squares with weights (V,) [Kabsch 1976].
    """
    share = weights / weights.sum()
    middle, goal = share @ points, np.einsum("v,fva->fa", share, targets)
    spread = np.einsum("v,fva,vb->fab", share, targets - goal[:, None], points - middle, optimize=True)
    left, _, right = np.linalg.svd(spread)
    left[..., -1] *= np.linalg.det(left @ right)[:, None]
    rotations = left @ right
    return rotations, goal - rotations @ middle
