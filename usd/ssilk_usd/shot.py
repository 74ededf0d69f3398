# SPDX-License-Identifier: Apache-2.0
"""Write a baked garment as one self-contained UsdSkel shot, whatever its length in little memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.assets import Deformer, Floats, GarmentPose, Motion, SkinWeights
from ssilk_core.errors import fail, need
from ssilk_core.files import replacing
from ssilk_core.kinematics import combined_transforms, local_transforms, quaternion_from_matrix, skinning_matrices

from .author import Asset, define_asset, extent_array, matrix_array, sorted_influences
from .export import need_layer_suffix
from .read_stage import usd_reason
from .units import StageUnits

# A save lets go of the samples (less than 1 kB a frame remains, for the tables of their times), but leaves each
# attribute's older table behind in the file. At this many frames both stay small: about 10 MB in memory, and a
# fifth of the file at 100,000 frames.
FRAMES_PER_SAVE = 4096


@dataclass(frozen=True)
class ShotSummary:
    """What a written shot holds; `start` and `end` are time codes."""

    path: str
    frame_count: int
    fps: float
    start: float
    end: float
    joint_count: int
    proxy_count: int
    shape_count: int


def write_shot(
    path: str | Path,
    deformer: Deformer,
    motion: Motion,
    poses: Iterable[GarmentPose],
    *,
    units: StageUnits,
    start: float = 0.0,
    include_body: bool = True,
    provenance: Mapping[str, object] | None = None,
) -> ShotSummary:
    """Write rest points, blendshapes, weights and joint animation as UsdSkel (Eqs. 5 and 8).

    Args:
        path: the file to write: .usdc, .usd, or .usda for people.
        motion: the character's motion at the shot's frames; its rate becomes the shot's.
        poses: consecutive chunks of frames that together cover the motion.
        units: units and up axis of the written stage.
        start: time code of the first frame; each next frame is one time code later.
        include_body: write the character's body meshes as well.
        provenance: where the shot came from, kept as the layer's `customLayerData["ssilk"]`.

    Raises:
        SsilkError: chunks that do not cover the motion in order, blendshape weights outside [0, 1], joint paths
            that do not spell the hierarchy, a file that cannot be written.
    """
    need_layer_suffix(path)
    bodies = deformer.scene.character.bodies if include_body else ()
    with replacing(path) as temporary:
        layer = Sdf.Layer.CreateNew(str(temporary))
        stage = Usd.Stage.Open(layer)
        asset = define_asset(stage, deformer, bodies, units)
        _set_metadata(stage, motion, units, start, provenance or {})
        del stage  # nobody has to hear of each sample
        samples = _Samples(layer, asset, deformer, motion, units, start)
        for pose in _checked(poses, deformer, motion):
            samples.append(pose)
            if samples.unsaved_count >= FRAMES_PER_SAVE:
                samples.save(path)
        samples.save(path)
        del samples, layer  # the file is closed before it is renamed
    return ShotSummary(
        path=str(path),
        frame_count=motion.frame_count,
        fps=motion.fps,
        start=start,
        end=start + motion.frame_count - 1,
        joint_count=len(deformer.scene.joint_names),
        proxy_count=deformer.scene.rig.proxy_count,
        shape_count=len(asset.shapes),
    )


def _set_metadata(
    stage: Usd.Stage, motion: Motion, units: StageUnits, start: float, provenance: Mapping[str, object]
) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, units.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, units.up_axis)
    stage.SetTimeCodesPerSecond(motion.fps)
    stage.SetFramesPerSecond(motion.fps)
    stage.SetStartTimeCode(start)
    stage.SetEndTimeCode(start + motion.frame_count - 1)
    stage.GetRootLayer().customLayerData = {"ssilk": _metadata(provenance)}


def _metadata(value: object) -> object:
    """Return nested mappings and lists as USD's metadata can hold them: lists become strings."""
    if isinstance(value, Mapping):
        return {str(key): _metadata(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return Vt.StringArray([str(item) for item in value])
    return value


def _checked(poses: Iterable[GarmentPose], deformer: Deformer, motion: Motion) -> Iterator[GarmentPose]:
    """Yield the chunks; raise unless they are of this garment and cover the motion in order."""
    scene, where, count = deformer.scene, deformer.scene.garment.mesh.path, 0
    need(
        motion.rotations.shape[1] == scene.character.skeleton.joint_count,
        motion.path,
        f"{motion.rotations.shape[1]} animated joints, where {scene.character.skeleton.path} has "
        f"{scene.character.skeleton.joint_count}",
        "the motion must be one of this skeleton",
    )
    for pose in poses:
        need(pose.start == count, where, f"a chunk that starts at frame {pose.start}", f"frame {count} comes next")
        _check_pose(pose, deformer)
        count += pose.frame_count
        _need_frames(count <= motion.frame_count, count, deformer, motion)
        yield pose
    _need_frames(count == motion.frame_count, count, deformer, motion)


def _need_frames(enough: bool, count: int, deformer: Deformer, motion: Motion) -> None:
    need(
        enough,
        deformer.scene.garment.mesh.path,
        f"{count} garment frames for the {motion.frame_count} of {motion.path}",
        "each frame of the motion needs one",
    )


def _check_pose(pose: GarmentPose, deformer: Deformer) -> None:
    where = deformer.scene.garment.mesh.path
    frames, proxies, shapes = pose.frame_count, deformer.scene.rig.proxy_count, deformer.shape_count
    need(
        pose.rotations.shape == (frames, proxies, 4) and pose.weights.shape == (frames, shapes),
        where,
        f"proxy rotations of shape {pose.rotations.shape} and blendshape weights of shape {pose.weights.shape}",
        f"({frames}, {proxies}, 4) and ({frames}, {shapes}) are needed",
    )
    need(
        np.isfinite(pose.rotations).all(),
        where,
        f"NaN or infinity among the proxy rotations from frame {pose.start}",
        "rotations are unit quaternions",
        "train the model again, or for longer",
    )
    wrong = np.argwhere(~((pose.weights >= 0) & (pose.weights <= 1)))
    if wrong.size:
        frame, shape = wrong[0]
        fail(
            where,
            f"blendshape {shape} weighs {pose.weights[frame, shape]:g} at frame {pose.start + frame}",
            "weights lie in [0, 1], because importers clamp them",
            "bound the model's activations",
        )


class _Samples:
    """The time samples of a shot: joints, blendshape weights and the extent of the SkelRoot."""

    def __init__(
        self, layer: Sdf.Layer, asset: Asset, deformer: Deformer, motion: Motion, units: StageUnits, start: float
    ) -> None:
        self.layer, self.asset, self.deformer, self.motion = layer, asset, deformer, motion
        self.units, self.start, self.unsaved_count = units, start, 0
        self.surfaces = [_Surface(deformer.skin), *(_Surface(body.skin) for body in asset.bodies)]
        self.moves = bool(np.ptp(motion.translations, axis=0).any())
        self.last_rotations: Floats | None = None

    def append(self, pose: GarmentPose) -> None:
        """Write the frames of `pose`."""
        times = self.start + pose.start + np.arange(pose.frame_count)
        world = combined_transforms(self.deformer, self.motion, pose)
        self._write_joints(times, world)
        if len(self.asset.shapes):
            weights = np.ascontiguousarray(pose.weights[:, self.asset.shapes])
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
        rotations = self._continuous(quaternion_from_matrix(local[..., :3, :3]))[..., [1, 2, 3, 0]]
        self._write(animation, "rotations", times, map(Vt.QuatfArray.FromNumpy, rotations.astype(np.float32)))
        translations = local[..., :3, 3].astype(np.float32)
        if self.moves:
            self._write(animation, "translations", times, map(Vt.Vec3fArray.FromNumpy, translations))
        else:
            attribute = self.layer.GetAttributeAtPath(animation.AppendProperty("translations"))
            attribute.default = Vt.Vec3fArray.FromNumpy(translations[0])

    def _continuous(self, rotations: Floats) -> Floats:
        """Choose the signs of quaternions (F, J, 4) so that none flips between frames: some importers mix them
        componentwise."""
        before = rotations[:1] if self.last_rotations is None else self.last_rotations
        steps = np.sum(np.concatenate([before, rotations[:-1]]) * rotations, axis=-1)
        result = rotations * np.cumprod(np.where(steps < 0, -1.0, 1.0), axis=0)[..., None]
        self.last_rotations = result[-1:]
        return result

    def _extents(self, pose: GarmentPose, world: Floats) -> Iterator[Vt.Vec3fArray]:
        """Yield, for each frame, the bounds of everything skinned."""
        scene = self.deformer.scene
        matrices = skinning_matrices(world, scene.bind_transforms)
        bodies = [body.mesh.points for body in self.asset.bodies]
        for weights, joints in zip(pose.weights, matrices):
            garment = scene.garment.mesh.points + np.tensordot(weights, self.deformer.shapes, 1)
            rest = [garment, *bodies]
            posed = np.concatenate([surface.skin(points, joints) for surface, points in zip(self.surfaces, rest)])
            posed = self.units.points_from_core(posed)
            yield extent_array(posed.min(axis=0), posed.max(axis=0))

    def save(self, name: str | Path) -> None:
        """Write what is pending to the file; `name` is what messages call it."""
        try:
            self.layer.Save()
        except Tf.ErrorException as error:
            fail(str(name), f"writing failed ({usd_reason(error)})", "free some space or choose another output")
        self.unsaved_count = 0


class _Surface:
    """Skinning weights as UsdSkel's compiled skinning takes them."""

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
