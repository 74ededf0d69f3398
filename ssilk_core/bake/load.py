# SPDX-License-Identifier: Apache-2.0
"""Loading what a request names: the garment on its character, then the motion."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from ..assets import Deformer, Motion
from ..checkpoint import ModelFile, load_model
from ..devices import select_device
from ..errors import fail
from ..files import sha256
from ..kinematics import lbs_deformer, resample
from ..quality import SizeReduction
from ..reduction import Reducer
from ..targets import Target, cap_influences
from .character import on_character
from .request import BakeRequest
from .rollout import BakeRollout

if TYPE_CHECKING:
    from pxr import Usd
    from ssilk_usd.frame_range import FrameRange
    from ssilk_usd.garment_api import GarmentRecord
    from ssilk_usd.units import StageUnits

    from ..model.network import GarmentModel

MAX_FPS = 10_000
LEAD = 1.0  # [s] of a motion before its shot that are rolled out, so that the garment is on its way when it begins


@dataclass(frozen=True, eq=False)
class LoadedGarment:
    """A garment on its character, ready for any motion.

    Attributes:
        model: the network; None under linear blend skinning.
        deformer: the garment as its target takes it.
        units: units and up axis of what is written.
        provenance: where the model comes from, as a shot stores it.
        record: how the model was made, as its mesh stores it.
    """

    request: BakeRequest
    file: ModelFile
    model: GarmentModel | None
    deformer: Deformer
    units: StageUnits
    provenance: dict[str, object]
    record: GarmentRecord

    def over(self, motion: str, *, range: str | None = None, handles: int = 0) -> BakeRollout:
        """Return the garment over a motion, "file[:/Prim/Path]"; range and handles are those of a request.

        Raises:
            SsilkError: the file is missing, does not fit, or lacks the range.
        """
        from ssilk_usd.frame_range import read_frame_range
        from ssilk_usd.read_motion import read_motion
        from ssilk_usd.read_stage import split_location
        from ssilk_usd.read_visibility import read_hidden

        request = replace(self.request, motion=motion, range=range, handles=handles)
        frames = read_frame_range(motion, request.time_range, handles, root=request.root)
        lead = _lead(frames, request) if frames else 0
        within = (frames.played[0] - lead * frames.step, frames.played[1]) if frames else None
        source = read_motion(motion, self.file.scene.character.skeleton, root=request.root, within=within)
        at_fps = source if request.fps is None else _at_fps(source, request.fps)
        samples = request.samples_per_frame
        every = at_fps if samples == 1 else _at_fps(source, at_fps.fps * samples)
        skipped = round(lead * every.fps / source.fps)
        sampled = every.clip(skipped, every.frame_count) if skipped else every
        kept, reduction = self._cut(source) if request.keep else (self, None)
        provenance = {
            **self.provenance,
            **({"reduced": reduction.to_metadata()} if reduction else {}),
            "request": request.to_metadata(),
            "motion_sha256": sha256(split_location(motion)[0]),
        }
        return BakeRollout(
            request=request,
            model=kept.model,
            deformer=kept.deformer,
            motion=sampled,
            source=source,
            lead=skipped,
            frames=frames,
            hidden=read_hidden(motion, sampled, root=request.root),
            units=self.units,
            provenance=provenance,
            record=self.record,
            fabric=self.file.fabric,
            reduction=reduction,
        )

    def _cut(self, motion: Motion) -> tuple[LoadedGarment, SizeReduction]:
        """Return the garment cut to the size that the request keeps, so as to be best for this motion."""
        assert self.model is not None and self.request.keep is not None
        reducer = Reducer(self.file, [motion])
        found = reducer.reduce(self.request.keep)
        model, deformer = _network_like(self.model, found.file, self.request)
        return replace(self, model=model, deformer=deformer), SizeReduction.of(reducer.whole, found)


def load_garment(request: BakeRequest) -> LoadedGarment:
    """Load what a request names, except its motion.

    Raises:
        SsilkError: a file is missing or does not fit the others.
    """
    from ssilk_usd.read_stage import open_stage

    from ..checkpoint import network

    device = select_device(request.device)
    file = load_model(request.model)
    stage = open_stage(request.stage)
    scene = on_character(file, stage, request.root)
    model = None if request.lbs else network(file, scene).to(device)
    deformer = lbs_deformer(scene) if model is None else model.deformer()
    model_hash = sha256(request.model)
    return LoadedGarment(
        request=request,
        file=file,
        model=model,
        deformer=cap_influences(deformer, request.receiver),
        units=_units(stage, request.receiver),
        provenance={"model_sha256": model_hash, "training": file.provenance.get("ssilk", "")},
        record=_record(file, model_hash),
    )


def load_rollout(request: BakeRequest) -> BakeRollout:
    """Load everything that a request names.

    Raises:
        SsilkError: a file is missing or does not fit the others.
    """
    return load_garment(request).over(request.motion, range=request.range, handles=request.handles)


def with_model(rollout: BakeRollout, file: ModelFile) -> BakeRollout:
    """Return a rollout of another model of the same garment."""
    assert rollout.model is not None
    model, deformer = _network_like(rollout.model, file, rollout.request)
    return replace(rollout, model=model, deformer=deformer)


def _network_like(like: GarmentModel, file: ModelFile, request: BakeRequest) -> tuple[GarmentModel, Deformer]:
    """Return a model's network on the character of another network, and the garment as its target takes it."""
    from ..checkpoint import network

    model = network(file, replace(file.scene, character=like.scene.character))
    model.to(select_device(request.device))
    return model, cap_influences(model.deformer(), request.receiver)


def _lead(frames: FrameRange, request: BakeRequest) -> int:
    """Return how many frames of the motion before the shot are rolled out: they make whole samples of the shot."""
    rate = (request.fps or frames.fps) * request.samples_per_frame / frames.fps
    most = min(frames.earlier, round(max(LEAD, request.pre_roll) * frames.fps))
    return next((count for count in range(most, 0, -1) if abs(count * rate - round(count * rate)) < 1e-6), 0)


def _at_fps(motion: Motion, fps: float) -> Motion:
    if not 0 < fps <= MAX_FPS:
        fail("--fps", f"{fps:g} frames per second", f"a positive rate of at most {MAX_FPS} is needed")
    return replace(resample(motion, fps), start=motion.start * fps / motion.fps)


def _units(stage: Usd.Stage, target: Target) -> StageUnits:
    """Return a target's units and axis, or those of the character's stage where it takes any."""
    from ssilk_usd.units import StageUnits

    own = StageUnits.of(stage)
    return StageUnits(target.meters_per_unit or own.meters_per_unit, target.up_axis or own.up_axis)


def _record(file: ModelFile, model_hash: str) -> GarmentRecord:
    from ssilk_usd.garment_api import GarmentRecord

    unused = "collision" if file.fabric.contact_model == "surface" else "contact"
    values = asdict(file.fabric).items()
    numbers = {name: float(value) for name, value in values if isinstance(value, int | float) and name != unused}
    return GarmentRecord(
        model_hash=model_hash,
        version=str(file.provenance.get("ssilk", "")),
        seed=int(file.provenance.get("seed", 0)),
        fabric=file.fabric.name,
        parameters=numbers,
    )
