# SPDX-License-Identifier: Apache-2.0
"""Write a baked garment as one self-contained UsdSkel shot of any length, in little memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from ssilk_core.errors import fail
from ssilk_core.files import replacing
from ssilk_core.scene.assets import Deformer, GarmentPose, Motion

from ..names import shape_name
from ..opening.garment_api import GarmentRecord
from ..units import StageUnits
from ..writing.asset_info import AssetInfo
from ..writing.author import define_asset, define_body_shapes
from ..writing.body_faces import HiddenPolygons
from ..writing.export import need_layer_suffix, save
from .samples import Samples

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints

# A save lets go of the samples (less than 1 kB a frame remains, for the tables of their times), but leaves each
# attribute's older table behind in the file. At this many frames both stay small: about 10 MB in memory, and a
# fifth of the file at 100,000 frames.
FRAMES_PER_SAVE = 4096


@dataclass(frozen=True)
class ShotSummary:
    """Summary of a written shot; `start` and `end` are time codes, `left_out` says which looks are lost."""

    path: str
    frame_count: int
    fps: float
    start: float
    end: float
    joint_count: int
    proxy_count: int
    shape_count: int
    left_out: str = ""


def write_shot(
    path: str | Path,
    deformer: Deformer,
    motion: Motion,
    poses: Iterable[GarmentPose],
    *,
    units: StageUnits,
    start: float = 0.0,
    samples_per_frame: int = 1,
    include_body: bool = True,
    riders: RiderJoints | None = None,
    hidden: Sequence[tuple[int, bool]] = (),
    hidden_polygons: HiddenPolygons | None = None,
    provenance: Mapping[str, object] | None = None,
    record: GarmentRecord | None = None,
    info: AssetInfo | None = None,
) -> ShotSummary:
    """Write rest points, blendshapes, weights and joint animation as UsdSkel (Eqs. 5 and 8).

    Args:
        path: the file to write: .usdc, .usd, or .usda for people.
        motion: the character's motion at the shot's samples; its rate becomes the shot's.
        poses: consecutive chunks of frames that together cover the motion.
        units: units and up axis of the written stage.
        start: time code of the first frame; each next frame is one time code later.
        samples_per_frame: how many of the motion's frames make one of the shot's, for motion blur.
        include_body: write the character's body meshes as well, with the blendshapes of the motion.
        riders: what rides on the garment; deformer and poses have its joints.
        hidden: from which frames of the motion on the garment is hidden (True) or seen (False).
        hidden_polygons: polygons of the bodies to hide.
        provenance: where the shot came from, kept as the layer's `customLayerData["ssilk"]`; looked at once the
            poses are written, so that it may say what came of them.

    Raises:
        SsilkError: chunks that do not cover the motion in order, blendshape weights outside [0, 1], joint paths
            that do not spell the hierarchy, a file that cannot be written.
    """
    need_layer_suffix(path)
    character = deformer.scene.character
    bodies = (*character.bodies, *character.stand_ins) if include_body else ()
    with replacing(path) as temporary:
        layer = Sdf.Layer.CreateNew(str(temporary))
        stage = Usd.Stage.Open(layer, None)
        span = TimeSpan.of(motion, start, samples_per_frame)
        set_metadata(stage, span, units)  # first, for what is copied has the times of the rate
        hiding = hidden_polygons if include_body else None
        asset = define_asset(
            stage, deformer, bodies, units, riders=riders, record=record, info=info, hidden_polygons=hiding,
            output=path,
        )  # fmt: skip
        asset = define_body_shapes(stage, asset, motion, units, before=list(map(shape_name, asset.shapes)))
        set_visibility(stage, asset.root, span, hidden)
        del stage  # nobody has to hear of each sample
        samples = Samples(layer, asset, deformer, motion, units, start=start, step=span.step)
        write_samples(samples, poses, path, provenance)
        del samples, layer  # the file is closed before it is renamed
    return replace(summary(path, deformer, motion, span, len(asset.shapes)), left_out=asset.left_out)


def write_samples(
    samples: Samples,
    poses: Iterable[GarmentPose],
    path: str | Path,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """Check and write the frames of a shot, saving at intervals, then its provenance, which may have grown meanwhile.

    Messages call the file `path`.
    """
    for pose in checked_poses(poses, samples.deformer, samples.motion):
        samples.append(pose)
        if samples.unsaved_count >= FRAMES_PER_SAVE:
            samples.save(path)
    samples.layer.customLayerData = {"ssilk": metadata_of(provenance or {})}
    samples.save(path)


def add_provenance(path: str | Path, facts: Mapping[str, object]) -> None:
    """Add to what a written shot says of its origin.

    Raises:
        SsilkError: the file cannot be written.
    """
    layer = Sdf.Layer.FindOrOpen(str(path))
    said = dict(layer.customLayerData)
    said["ssilk"] = {**said.get("ssilk", {}), **{name: metadata_of(value) for name, value in facts.items()}}
    layer.customLayerData = said
    save(layer, path)


@dataclass(frozen=True)
class TimeSpan:
    """When a shot plays: `start` and `end` are time codes, `step` those between samples; `fps` as its frames go."""

    start: float
    end: float
    step: float
    fps: float

    @classmethod
    def of(cls, motion: Motion, start: float, samples_per_frame: int = 1) -> TimeSpan:
        """Return the span of a motion with this number of samples per frame."""
        step = 1 / samples_per_frame
        return cls(start, start + step * (motion.frame_count - 1), step, motion.fps * step)


def summary(path: str | Path, deformer: Deformer, motion: Motion, span: TimeSpan, shapes: int) -> ShotSummary:
    """Return the summary of a written shot."""
    return ShotSummary(
        path=str(path),
        frame_count=motion.frame_count,
        fps=span.fps,
        start=span.start,
        end=span.end,
        joint_count=len(deformer.scene.joint_names),
        proxy_count=deformer.scene.rig.proxy_count,
        shape_count=shapes,
    )


def set_metadata(stage: Usd.Stage, span: TimeSpan, units: StageUnits) -> None:
    """Author the units, up axis, frame rate and frame range of a stage."""
    UsdGeom.SetStageMetersPerUnit(stage, units.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, units.up_axis)
    stage.SetTimeCodesPerSecond(span.fps)
    stage.SetFramesPerSecond(span.fps)
    stage.SetStartTimeCode(span.start)
    stage.SetEndTimeCode(span.end)


def set_visibility(stage: Usd.Stage, root: Sdf.Path, span: TimeSpan, hidden: Sequence[tuple[int, bool]]) -> None:
    """Author the frames at which a prim becomes hidden or visible; nothing if it is always visible."""
    if not hidden:
        return
    visibility = UsdGeom.Imageable(stage.GetPrimAtPath(root)).CreateVisibilityAttr()
    for frame, gone in hidden:
        token = UsdGeom.Tokens.invisible if gone else UsdGeom.Tokens.inherited
        visibility.Set(token, span.start + span.step * frame)


def metadata_of(value: object) -> object:
    """Return nested mappings and lists as USD's metadata can hold them: lists become strings, empty ones nothing."""
    if isinstance(value, Mapping):
        return {
            str(key): metadata_of(item)
            for key, item in value.items()
            if item is not None and item != [] and item != {}
        }
    if isinstance(value, list | tuple):
        return Vt.StringArray([str(item) for item in value])
    return value


def checked_poses(poses: Iterable[GarmentPose], deformer: Deformer, motion: Motion) -> Iterator[GarmentPose]:
    """Yield the chunks; raise `SsilkError` unless they belong to this garment and cover the motion in order."""
    where, count, moves = deformer.scene.garment.mesh.path, 0, False
    for pose in poses:
        if pose.start != count:
            fail(where, f"a chunk that starts at frame {pose.start}", f"frame {count} comes next")
        if count and moves != (pose.translations is not None):
            fail(where, f"proxies that move in some chunks, up to frame {count} or from there on", "all do, or none")
        moves = pose.translations is not None
        _check_pose(pose, deformer)
        count += pose.frame_count
        _need_frames(count <= motion.frame_count, count, deformer, motion)
        yield pose
    _need_frames(count == motion.frame_count, count, deformer, motion)


def _need_frames(enough: bool, count: int, deformer: Deformer, motion: Motion) -> None:
    if not enough:
        fail(
            deformer.scene.garment.mesh.path,
            f"{count} garment frames for the {motion.frame_count} of {motion.path}",
            "each frame of the motion needs one",
        )


def _check_pose(pose: GarmentPose, deformer: Deformer) -> None:
    where = deformer.scene.garment.mesh.path
    frames, proxies, shapes = pose.frame_count, deformer.scene.rig.proxy_count, deformer.shape_count
    if pose.rotations.shape != (frames, proxies, 4) or pose.weights.shape != (frames, shapes):
        fail(
            where,
            f"proxy rotations of shape {pose.rotations.shape} and blendshape weights of shape {pose.weights.shape}",
            f"({frames}, {proxies}, 4) and ({frames}, {shapes}) are needed",
        )
    if not np.isfinite(pose.rotations).all():
        fail(
            where,
            f"NaN or infinity among the proxy rotations from frame {pose.start}",
            "rotations are unit quaternions",
            "train the model again, or for longer",
        )
    moved = pose.translations
    if moved is not None and not (moved.shape == (frames, proxies, 3) and np.isfinite(moved).all()):
        fail(
            where,
            f"proxy translations of shape {moved.shape}, or NaN or infinity among them, from frame {pose.start}",
            f"finite ones of shape ({frames}, {proxies}, 3) are needed",
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
