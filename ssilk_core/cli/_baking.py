# SPDX-License-Identifier: Apache-2.0
"""What 'bake' and 'verify' share: a model, a character and a motion, ready to roll."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..assets import Deformer, Floats, GarmentPose, Motion, Scene, Skeleton
from ..devices import chosen_device
from ..errors import VerificationError, fail
from ..events import Message, Progress, Reporter, silent
from ..fabrics import Fabric
from ..kinematics import deform, lbs_deformer, lbs_poses, resample
from ..targets import TARGETS, Target, capped
from ._quality import lost
from ._refining import Refinement
from .options import INPUTS

if TYPE_CHECKING:
    from pxr import Usd
    from ssilk_usd.garment_api import GarmentRecord
    from ssilk_usd.units import StageUnits

    from ..checkpoint import ModelFile
    from ..farm.tasks import BakeTask
    from ..model.network import GarmentModel

CHUNK = 256  # frames in memory at once
MOST_SAMPLES = 64  # in each frame
MOST_PRE_ROLL = 600.0  # [s]
BIND_TOLERANCE = 1e-3  # [m] between positions, and between the entries of rotation matrices


@dataclass(frozen=True, kw_only=True)
class BakeRequest:
    """What is to be baked, as paths and plain values, so that a shot can carry it and be verified against it."""

    model: str
    stage: str
    motion: str
    fps: float | None = None
    root: str | None = None
    lbs: bool = False
    device: str = "cpu"
    target: str = "usd"
    samples: int = 1  # in each frame
    pre_roll: float = 0.0  # [s]
    refine: int = 0  # iterations of the solver in each frame
    feedback: bool = False  # refined frames look back on refined ones
    refined: str = "points"  # or "joints"
    keep: str = ""  # blendshapes, proxies and influences of the model, "24,12,4"; all where empty

    @classmethod
    def of(cls, task: BakeTask) -> BakeRequest:
        """Return what a task asks for, which is the whole model."""
        return cls(**{item.name: getattr(task, item.name) for item in fields(cls) if item.name != "keep"})


@dataclass(frozen=True, eq=False)
class Bake:
    """A garment over a motion at the rate of the shot's samples; `model` is None under linear blend skinning.

    `deformer` is as the target takes it; `hidden` as `ssilk_usd.read_visibility` says it. `recovered` says, once
    `poses` are through, at which frames the rollout was lost and the garment was put to rest.
    """

    request: BakeRequest
    model: GarmentModel | None
    deformer: Deformer
    motion: Motion
    source: Motion
    hidden: list[tuple[int, bool]]
    units: StageUnits
    provenance: dict[str, Any]
    record: GarmentRecord
    fabric: Fabric
    recovered: list[str] = field(default_factory=list)

    def wearing(self, file: ModelFile) -> Bake:
        """Return the same with another model of the garment."""
        assert self.model is not None
        model, deformer = worn(file, self.model, self.request)
        return replace(self, model=model, deformer=deformer)

    @property
    def start(self) -> float:
        """Return the time code of the first frame."""
        return self.motion.start / self.request.samples

    @property
    def target(self) -> Target:
        return TARGETS[self.request.target]

    @property
    def influences(self) -> int:
        """Return how many joints move a vertex of the trained garment, at most; 0 under linear blend skinning."""
        return 0 if self.model is None else self.model.scene.rig.skin.indices.shape[1]

    def carried(self, output: Path) -> dict[str, Any]:
        """Return what a file says of its origin; `recovered` fills as the poses go through."""
        refined = {"refined": self.refinement.figures} if self.refinement else {}
        return {**self.provenance, "beside": _beside(self.request, output), "recovered": self.recovered, **refined}

    @cached_property
    def refinement(self) -> Refinement | None:
        """Return the refined frames, where they are asked for."""
        return Refinement(self) if self.request.refine else None

    @property
    def as_points(self) -> bool:
        """Return whether the garment is written as points instead of joints."""
        return bool(self.request.refine) and self.request.refined == "points"

    def refine(self, report: Reporter) -> dict[str, object]:
        """Refine, where that is asked for; return figures."""
        if self.refinement is None:
            return {}
        self.refinement.compute(report)
        return {f"refined: {name}": value for name, value in self.refinement.figures.items()}

    def warn(self, report: Reporter) -> dict[str, object]:
        """Say at which frames the rollout was lost; return that as figures."""
        for frames in self.recovered:
            report(Message(f"frames {frames}: the rollout was lost, and the garment is put to rest", "warning"))
        return {"put to rest": self.recovered} if self.recovered else {}

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the shot's poses, some frames at a time."""
        if self.refinement is None or self.as_points:
            yield from self.rollout()
            return
        self.refinement.compute(silent)
        yield from self.refinement.poses

    def rollout(self) -> Iterator[GarmentPose]:
        """Yield the network's poses, some frames at a time."""
        if self.model is None:
            yield from lbs_poses(self.motion.frame_count)
            return
        from ..rollout import garment_poses

        self.recovered.clear()
        rate, pre_roll = self.motion.fps, self.request.pre_roll
        yield from garment_poses(self.model, self.source, rate, CHUNK, self._note, pre_roll=pre_roll)

    def _note(self, frames: range) -> None:
        self.recovered.append(f"{frames[0]} to {frames[-1]}")

    def rolled(self, report: Reporter) -> Iterator[Floats]:
        """Yield the decoder's own garment points (V, 3) [m] of the network's poses."""
        for pose in self.rollout():
            yield from self._decoded(pose)
            report(Progress(pose.start + pose.frame_count, self.motion.frame_count))

    def points(self, report: Reporter) -> Iterator[Floats]:
        """Yield the points (V, 3) [m] that a point cache holds at each sample: refined where that is asked for."""
        if self.refinement is None or not self.as_points:
            yield from self.vertices(report)
            return
        self.refinement.compute(report)
        yield from self.refinement.points

    def vertices(self, report: Reporter) -> Iterator[Floats]:
        """Yield the garment's points (V, 3) [m] at each sample, as the decoder has them."""
        for pose in self.poses():
            yield from self._decoded(pose)
            report(Progress(pose.start + pose.frame_count, self.motion.frame_count))

    def _decoded(self, pose: GarmentPose) -> Floats:
        if self.model is None:
            return deform(self.deformer, self.motion, pose)
        from ..rollout import decode

        return decode(self.model, self.motion, pose)

    def verify(self, path: Path, report: Reporter) -> dict[str, object]:
        """Check a written shot and compare it, re-skinned by UsdSkel, with the decoder; return figures.

        Points that were refined are compared with those just computed; where none were, as of a shot that is there
        already, by their energy (`Refinement.judge`).

        Raises:
            VerificationError: a check fails, or a vertex is further off than allowed.
        """
        from ssilk_usd.check import check_shot, compare_points
        from ssilk_usd.play import Shot, frame_times

        findings = check_shot(path)
        for finding in findings:
            report(Message(str(finding), "warning"))
        errors = [finding for finding in findings if finding.severity == "error"]
        if errors:
            raise VerificationError(
                f"{path}: {len(errors)} checks failed, first at {errors[0].prim}: {errors[0].text}."
            )
        shot, samples = Shot(path), self.request.samples
        if not shot.is_skinned and self.refinement and not self.refinement.figures:
            times = frame_times(shot.stage, samples)
            return self.refinement.judge(map(shot.garment_points, times), report)
        expected = self.vertices(report) if shot.is_skinned else self.points(report)
        found = compare_points(shot, expected, samples_per_frame=samples)
        if not found.passed:
            raise VerificationError(
                f"{path}: vertex {found.vertex} at time code {found.time:g} is {found.worst:.3g} m from where the "
                f"decoder has it; at most {found.bound:.3g} m is allowed."
            )
        return {"largest error [m]": f"{found.worst:.3g}", "allowed [m]": f"{found.bound:.3g}"}


@dataclass(frozen=True, eq=False)
class Dressed:
    """A garment on its character, ready for any motion; `model` is None under linear blend skinning."""

    request: BakeRequest
    file: ModelFile
    model: GarmentModel | None
    deformer: Deformer
    units: StageUnits
    provenance: dict[str, Any]

    def over(self, motion: str) -> Bake:
        """Return the garment over a motion, "file[:/Prim/Path]".

        Raises:
            SsilkError: the file is missing or does not fit.
        """
        from ssilk_usd.read_motion import read_motion
        from ssilk_usd.read_stage import split_location
        from ssilk_usd.read_visibility import read_hidden

        from ..files import sha256

        request = replace(self.request, motion=motion)
        source = read_motion(motion, self.file.scene.character.skeleton, root=request.root)
        at_rate = source if request.fps is None else _at_rate(source, request.fps)
        sampled = at_rate if request.samples == 1 else _at_rate(source, at_rate.fps * request.samples)
        kept = self._cut(source) if request.keep else self
        carried = {key: value for key, value in vars(request).items() if value != getattr(BakeRequest, key, None)}
        provenance = {
            **kept.provenance,
            "request": carried,
            "motion_sha256": sha256(split_location(motion)[0]),
        }
        return Bake(
            request=request,
            model=kept.model,
            deformer=kept.deformer,
            motion=sampled,
            source=source,
            hidden=read_hidden(motion, sampled, root=request.root),
            units=self.units,
            provenance=provenance,
            record=self.record,
            fabric=self.file.fabric,
        )

    def _cut(self, motion: Motion) -> Dressed:
        """Return the garment with as much kept as the request says: what is best for this motion."""
        from ..reduction import ModelSize, Reducer

        reducer = Reducer(self.file, [motion])
        found = reducer.reduced(ModelSize.of(self.request.keep))
        assert self.model is not None
        model, deformer = worn(found.file, self.model, self.request)
        provenance = {**self.provenance, "reduced": lost(reducer.whole, found)}
        return replace(self, file=found.file, model=model, deformer=deformer, provenance=provenance)

    @property
    def record(self) -> GarmentRecord:
        """Return how the garment's model was made."""
        return _record(self.file, self.provenance["model_sha256"])


def worn(file: ModelFile, like: GarmentModel, request: BakeRequest) -> tuple[GarmentModel, Deformer]:
    """Return a model's network on the character of another of the same garment, and what its target takes."""
    from ..checkpoint import network

    model = network(file, replace(file.scene, character=like.scene.character))
    model.to(chosen_device(request.device))
    return model, capped(model.deformer(), TARGETS[request.target])


def open_bake(request: BakeRequest) -> Bake:
    """Load everything that a request names.

    Raises:
        SsilkError: a file is missing or does not fit the others.
    """
    return dressed(request).over(request.motion)


def dressed(request: BakeRequest) -> Dressed:
    """Load what a request names, its motion apart.

    Raises:
        SsilkError: a file is missing or does not fit the others, or an option has a value that is not allowed.
    """
    from ssilk_usd.read_stage import open_stage

    from ..checkpoint import load_model, network
    from ..files import sha256

    if request.target not in TARGETS:
        fail("--target", f"'{request.target}'", f"it is one of {', '.join(TARGETS)}")
    if not 1 <= request.samples <= MOST_SAMPLES:
        fail("--samples-per-frame", f"{request.samples} samples in each frame", f"1 to {MOST_SAMPLES} are allowed")
    if not 0 <= request.pre_roll <= MOST_PRE_ROLL:
        fail("--pre-roll", f"{request.pre_roll:g} seconds", f"0 to {MOST_PRE_ROLL:g} are allowed")
    device, target = chosen_device(request.device), TARGETS[request.target]
    file = load_model(request.model)
    stage = open_stage(request.stage)
    scene = on_character(file, stage, request.root)
    model = None if request.lbs else network(file, scene).to(device)
    deformer = lbs_deformer(scene) if model is None else model.deformer()
    provenance = {"model_sha256": sha256(request.model), "training": file.provenance.get("ssilk", "")}
    return Dressed(request, file, model, capped(deformer, target), _units(stage, target), provenance)


def _units(stage: Usd.Stage, target: Target) -> StageUnits:
    """Return a target's units and axis, or those of the character's stage where it takes any."""
    from ssilk_usd.units import StageUnits

    own = StageUnits.of(stage)
    return StageUnits(target.meters_per_unit or own.meters_per_unit, target.up_axis or own.up_axis)


def _record(file: ModelFile, model_hash: str) -> GarmentRecord:
    from ssilk_usd.garment_api import GarmentRecord

    numbers = {name: float(value) for name, value in asdict(file.fabric).items() if isinstance(value, int | float)}
    return GarmentRecord(
        model_hash=model_hash,
        version=str(file.provenance.get("ssilk", "")),
        seed=int(file.provenance.get("seed", 0)),
        fabric=file.fabric.name,
        parameters=numbers,
    )


def _beside(request: BakeRequest, output: Path) -> dict[str, str]:
    """Return the inputs' paths as seen from the output's folder: they hold when everything moves together."""
    folder = output.absolute().parent
    try:
        return {name: os.path.relpath(getattr(request, name), folder) for name in INPUTS}
    except ValueError:  # on another drive
        return {}


def on_character(file: ModelFile, stage: Usd.Stage, root: str | None) -> Scene:
    """Return a model's scene with the character of a stage; models keep of its body what the garment can touch.

    Raises:
        SsilkError: the stage's character is not the one that the model was trained with.
    """
    from ssilk_usd.read_character import read_character

    character = read_character(stage, root=root, garment=None)
    skeleton = file.scene.character.skeleton
    need_same_skeleton(character.skeleton, skeleton)
    return replace(file.scene, character=replace(character, skeleton=skeleton))


def need_same_skeleton(found: Skeleton, trained: Skeleton) -> None:
    """Raise `SsilkError` unless a skeleton has the joints of the model, with its bind transforms."""
    allowed, todo = "a model bakes on the character it was trained with", "train on this character"
    missing = sorted(set(trained.joint_names) - set(found.joint_names))
    if missing:
        fail(
            found.path, f"{len(missing)} of the model's joints are missing ({', '.join(missing[:3])})", allowed, todo
        )
    same = found.joint_names == trained.joint_names
    if not same:
        fail(found.path, "its joints are more than the model's, or in another order", allowed, todo)
    away = np.linalg.norm((found.bind_transforms - trained.bind_transforms)[:, :3, 3], axis=1)
    joint = int(away.argmax())
    if not away[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{found.joint_names[joint]}' is bound {away[joint]:.3g} m from where the model has it",
            allowed,
            todo,
        )
    turned = np.abs((found.bind_transforms - trained.bind_transforms)[:, :3, :3]).max(axis=(1, 2))
    joint = int(turned.argmax())
    if not turned[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{found.joint_names[joint]}' is bound at another rotation than the model has it",
            allowed,
            todo,
        )


def _at_rate(motion: Motion, fps: float) -> Motion:
    if not 0 < fps <= 10_000:
        fail("--fps", f"{fps:g} frames per second", "a positive rate is needed")
    return replace(resample(motion, fps), start=motion.start * fps / motion.fps)
