# SPDX-License-Identifier: Apache-2.0
"""The time samples of a shot: joints, blendshape weights, the extent of the SkelRoot."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, UsdSkel, Vt

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, Motion, SkinWeights
from ssilk_core.scene.assets.body_shape import shaped
from ssilk_core.scene.kinematics import (
    combined_transforms,
    continuous,
    local_transforms,
    quaternion_from_matrix,
    skinning_matrices,
    sorted_influences,
)

from ..units import StageUnits
from ..writing.author import Asset, extent_array, matrix_array
from ..writing.export import save

PATH_OP = "xformOp:translate:path"  # of the SkelRoot: where the character's root joint is
AT_REST = 1e-7  # by which entries of a joint's transform may differ and still count as the same; [m] for positions


class Samples:
    """The time samples of a shot that is being written.

    Args:
        layer: where they go; it holds specs of the SkelRoot and the SkelAnimation.
        start: time code of the first frame.
        step: time codes from one frame to the next.
        lean: the SkelRoot moves as far as its first root joint leaves its rest.

    All that is constant of an asset's shots is alike in them, joints above all: UsdClipsAPI plays samples alone, so
    several shots are clips of one asset.

    Raises:
        SsilkError: the motion is of another skeleton.
    """

    def __init__(
        self,
        layer: Sdf.Layer,
        asset: Asset,
        deformer: Deformer,
        motion: Motion,
        units: StageUnits,
        *,
        start: float,
        step: float = 1.0,
        lean: bool = False,
    ) -> None:
        self.layer, self.asset, self.deformer, self.motion = layer, asset, deformer, motion
        self.units, self.start, self.step, self.lean, self.unsaved_count = units, start, step, lean, 0
        self.others = (*asset.bodies, *asset.riders)
        self.soft = [(len(asset.bodies) + at, each) for at, each in enumerate(asset.rider_shapes) if each is not None]
        self.surfaces = [_Surface(deformer.skin), *(_Surface(body.skin) for body in self.others)]
        _need_same_skeleton(deformer, motion)
        self.path = root_path(deformer, motion)
        self.moves = bool((np.ptp(_stored_translations(deformer, motion, lean), axis=0) > AT_REST).any())
        self.last_rotations: Floats | None = None
        self.begins = 1  # frames of a chunk that are the shot's first

    def append(self, pose: GarmentPose) -> None:
        """Write the frames of `pose`."""
        times = self.start + self.step * (pose.start + np.arange(pose.frame_count))
        world = combined_transforms(self.deformer, self.motion, pose)
        if self.lean:
            origins = self.path[pose.start : pose.start + pose.frame_count]
            world[..., :3, 3] -= origins[:, None]
            self._write(self.asset.root, PATH_OP, times, _vectors(self.units.points_from_core(origins)))
        self.moves |= pose.translations is not None
        self._write_joints(times, world)
        if len(self.asset.shapes) or self.asset.body_shapes:
            weights = pose.weights[:, self.asset.shapes]
            if self.asset.body_shapes and self.motion.shape_weights is not None:
                frames = slice(pose.start, pose.start + pose.frame_count)
                own = self.motion.shape_weights[frames][:, list(self.asset.body_shapes)]
                weights = np.concatenate([weights, own], axis=1).astype(np.float32)
            weights = np.ascontiguousarray(weights)
            self._write(self.asset.animation, "blendShapeWeights", times, map(Vt.FloatArray.FromNumpy, weights))
        self._write(self.asset.root, "extent", times, self._extents(pose, world))
        self.unsaved_count += pose.frame_count

    def _write(self, prim: Sdf.Path, name: str, times: Floats, values: Iterable[object]) -> None:
        path = prim.AppendProperty(name)
        for time, value in zip(times, values):
            self.layer.SetTimeSample(path, float(time), value)

    def _write_joints(self, times: Floats, world: Floats) -> None:
        animation, parents = self.asset.animation, self.deformer.scene.parents
        local = local_transforms(self.units.transforms_from_core(world), parents)
        rotations = continuous(quaternion_from_matrix(local[..., :3, :3]), self.last_rotations)
        self.last_rotations, rotations = rotations[-1:], rotations[..., [1, 2, 3, 0]]
        self._write(animation, "rotations", times, map(Vt.QuatfArray.FromNumpy, rotations.astype(np.float32)))
        translations = local[..., :3, 3].astype(np.float32)
        if not self.moves:  # one sample for all, since clips have no defaults
            times, translations = times[: self.begins], translations[: self.begins]
        self._write(animation, "translations", times, map(Vt.Vec3fArray.FromNumpy, translations))
        self.begins = 0

    def _extents(self, pose: GarmentPose, world: Floats) -> Iterator[Vt.Vec3fArray]:
        """Yield the bounds of everything skinned at each frame."""
        scene = self.deformer.scene
        matrices = skinning_matrices(world, scene.bind_transforms)
        bodies = [body.mesh.points for body in self.others]
        moved = self._moved_bodies()
        for frame, (weights, joints) in enumerate(zip(pose.weights, matrices), pose.start):
            garment = scene.garment.mesh.points + np.tensordot(weights, self.deformer.shapes, 1)
            rest = [garment, *bodies]
            for at, shapes in self.soft:
                rest[1 + at] = bodies[at] + np.tensordot(weights, shapes, 1)
            for at in moved:
                rest[1 + at] = shaped(bodies[at], self.motion.shapes, self._shape_weights(frame), at)[0]
            posed = np.concatenate([surface.skin(points, joints) for surface, points in zip(self.surfaces, rest)])
            posed = self.units.points_from_core(posed)
            yield extent_array(posed.min(axis=0), posed.max(axis=0))

    def _moved_bodies(self) -> list[int]:
        """Return the bodies that the motion shapes."""
        return sorted({shape.body for shape in self.motion.shapes if shape.body < len(self.asset.bodies)})

    def _shape_weights(self, frame: int) -> Floats:
        assert self.motion.shape_weights is not None
        return self.motion.shape_weights[frame : frame + 1]

    def save(self, name: str | Path) -> None:
        """Write pending changes to the file; messages call it `name`."""
        save(self.layer, name)
        self.unsaved_count = 0


def _vectors(points: Floats) -> Iterator[Gf.Vec3d]:
    return (Gf.Vec3d(*point) for point in points.tolist())


def _stored_translations(deformer: Deformer, motion: Motion, lean: bool) -> Floats:
    """Return the character's local translations [m], without the path of its root if `lean`, shape (F, J, 3)."""
    translations = np.array(motion.translations)
    if lean:
        roots = np.flatnonzero(deformer.scene.character.skeleton.parents < 0)
        translations[:, roots] -= root_path(deformer, motion)[:, None]
    return translations


def root_path(deformer: Deformer, motion: Motion) -> Floats:
    """Return the offset of the first root joint from its rest position at each frame [m], shape (F, 3)."""
    return motion.translations[:, 0] - deformer.scene.character.skeleton.rest_transforms[0, :3, 3]


def _need_same_skeleton(deformer: Deformer, motion: Motion) -> None:
    skeleton = deformer.scene.character.skeleton
    if motion.rotations.shape[1] != skeleton.joint_count:
        fail(
            motion.path,
            f"{motion.rotations.shape[1]} animated joints, where {skeleton.path} has {skeleton.joint_count}",
            "the motion must be one of this skeleton",
        )


class _Surface:
    """Skinning weights in the form that UsdSkel's compiled skinning needs."""

    def __init__(self, skin: SkinWeights) -> None:
        indices, weights = sorted_influences(skin)
        self.width = indices.shape[1]
        self.indices = Vt.IntArray.FromNumpy(indices.reshape(-1))
        self.weights = Vt.FloatArray.FromNumpy(weights.reshape(-1))

    def skin(self, points: Floats, matrices: Floats) -> Floats:
        """Return rest points (V, 3) posed by bind-to-posed transforms (J, 4, 4)."""
        posed = Vt.Vec3fArray.FromNumpy(np.asarray(points, dtype=np.float32))
        UsdSkel.SkinPointsLBS(Gf.Matrix4d(1), matrix_array(matrices), self.indices, self.weights, self.width, posed)
        return np.array(posed)
