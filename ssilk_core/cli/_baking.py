# SPDX-License-Identifier: Apache-2.0
"""What 'bake' and 'verify' share: a model, a character and a motion, ready to roll."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssilk_core.assets import Deformer, Floats, GarmentPose, Motion, ProxyRig, Scene, Skeleton
from ssilk_core.errors import VerificationError, need
from ssilk_core.events import Message, Progress, Reporter

if TYPE_CHECKING:
    from ssilk_usd.units import StageUnits

    from ssilk_core.model.network import GarmentModel

CHUNK = 256  # frames in memory at once
BIND_TOLERANCE = 1e-3  # [m] between positions, and between the entries of rotation matrices


@dataclass(frozen=True, kw_only=True)
class BakeRequest:
    """What is to be baked, as paths and plain values, so that a shot can carry it and be verified against it."""

    model: str
    stage: str
    motion: str
    fps: float | None = None
    root: str | None = None
    plain: bool = False
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class Bake:
    """A garment over a motion at the shot's rate; `model` is None under plain skinning.

    `recovered` says, once `poses` are through, at which frames the rollout was lost and the garment was put to rest.
    """

    request: BakeRequest
    model: GarmentModel | None
    deformer: Deformer
    motion: Motion
    source: Motion
    units: StageUnits
    provenance: dict[str, Any]
    recovered: list[str] = field(default_factory=list)

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the shot's poses, some frames at a time."""
        count = self.motion.frame_count
        if self.model is None:
            for start in range(0, count, CHUNK):
                frames = min(CHUNK, count - start)
                yield GarmentPose(start, np.zeros((frames, 0, 4)), np.zeros((frames, 0)))
            return
        from ssilk_core.rollout import garment_poses

        self.recovered.clear()
        yield from garment_poses(self.model, self.source, self.motion.fps, CHUNK, self._note)

    def _note(self, frames: range) -> None:
        self.recovered.append(f"{frames[0]} to {frames[-1]}")

    def vertices(self, report: Reporter) -> Iterator[Floats]:
        """Yield the decoder's own garment points (V, 3) [m] of each frame."""
        for pose in self.poses():
            yield from self._decoded(pose)
            report(Progress(pose.start + pose.frame_count, self.motion.frame_count))

    def _decoded(self, pose: GarmentPose) -> Floats:
        if self.model is None:
            from ssilk_core.kinematics import deform

            return deform(self.deformer, self.motion, pose)
        from ssilk_core.rollout import decode

        return decode(self.model, self.motion, pose)

    def verify(self, path: Path, report: Reporter) -> dict[str, object]:
        """Check a written shot and compare it, re-skinned by UsdSkel, with the decoder; return figures.

        Raises:
            VerificationError: a check fails, or a vertex is further off than allowed.
        """
        from ssilk_usd.check import check_shot, compare_points
        from ssilk_usd.play import Shot

        findings = check_shot(path)
        for finding in findings:
            report(Message(str(finding), "warning"))
        errors = [finding for finding in findings if finding.severity == "error"]
        if errors:
            raise VerificationError(
                f"{path}: {len(errors)} checks failed, first at {errors[0].prim}: {errors[0].text}."
            )
        found = compare_points(Shot(path), self.vertices(report))
        if not found.passed:
            raise VerificationError(
                f"{path}: vertex {found.vertex} at time code {found.time:g} is {found.worst:.3g} m from where the "
                f"decoder has it; at most {found.bound:.3g} m is allowed."
            )
        return {"largest error [m]": f"{found.worst:.3g}", "allowed [m]": f"{found.bound:.3g}"}


def open_bake(request: BakeRequest) -> Bake:
    """Load everything that a request names.

    Raises:
        SsilkError: a file is missing or does not fit the others.
    """
    from ssilk_usd.read_character import read_character
    from ssilk_usd.read_motion import read_motion
    from ssilk_usd.read_stage import open_stage, split_location
    from ssilk_usd.units import StageUnits

    from ssilk_core.checkpoint import load_model, network
    from ssilk_core.devices import chosen_device
    from ssilk_core.files import sha256

    device = chosen_device(request.device)
    file = load_model(request.model)
    stage = open_stage(request.stage)
    character = read_character(stage, root=request.root, garment=None)
    skeleton = file.scene.character.skeleton
    need_same_skeleton(character.skeleton, skeleton)
    scene = replace(file.scene, character=replace(character, skeleton=skeleton))
    source = read_motion(request.motion, skeleton)
    motion = source if request.fps is None else _at_rate(source, request.fps)
    model = None if request.plain else network(file, scene).to(device)
    deformer = _plain(scene) if model is None else model.deformer()
    provenance = {
        "request": {key: value for key, value in vars(request).items() if value is not None},
        "model_sha256": sha256(request.model),
        "motion_sha256": sha256(split_location(request.motion)[0]),
        "training": file.provenance.get("ssilk", ""),
    }
    return Bake(request, model, deformer, motion, source, StageUnits.of(stage), provenance)


def need_same_skeleton(found: Skeleton, trained: Skeleton) -> None:
    """Raise `SsilkError` unless a skeleton has the joints of the model, with its bind transforms."""
    allowed, todo = "a model bakes on the character it was trained with", "train on this character"
    missing = sorted(set(trained.joint_names) - set(found.joint_names))
    need(not missing, found.path, f"{len(missing)} of the model's joints are missing ({', '.join(missing[:3])})",
         allowed, todo)  # fmt: skip
    same = found.joint_names == trained.joint_names
    need(same, found.path, "its joints are more than the model's, or in another order", allowed, todo)
    away = np.linalg.norm((found.bind_transforms - trained.bind_transforms)[:, :3, 3], axis=1)
    joint = int(away.argmax())
    need(away[joint] < BIND_TOLERANCE, found.path,
         f"joint '{found.joint_names[joint]}' is bound {away[joint]:.3g} m from where the model has it",
         allowed, todo)  # fmt: skip
    turned = np.abs((found.bind_transforms - trained.bind_transforms)[:, :3, :3]).max(axis=(1, 2))
    joint = int(turned.argmax())
    need(turned[joint] < BIND_TOLERANCE, found.path,
         f"joint '{found.joint_names[joint]}' is bound at another rotation than the model has it",
         allowed, todo)  # fmt: skip


def _at_rate(motion: Motion, fps: float) -> Motion:
    from ssilk_core.kinematics import resample

    need(0 < fps <= 10_000, "--fps", f"{fps:g} frames per second", "a positive rate is needed")
    return replace(resample(motion, fps), start=motion.start * fps / motion.fps)


def _plain(scene: Scene) -> Deformer:
    """Return the garment under plain skinning: no proxies, no shapes."""
    none = ProxyRig(scene.rig.path, (), np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4)), scene.plain_skin)
    bare = replace(scene, rig=none)
    return Deformer(bare, scene.plain_skin, np.zeros((0, scene.garment.mesh.vertex_count, 3)))
