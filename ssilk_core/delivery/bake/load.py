# SPDX-License-Identifier: Apache-2.0
"""Loading what a request names: the garment on its character, then the motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ...devices import select_device
from ...errors import fail
from ...events import Event, Message
from ...files import split_body, split_location
from ...network.checkpoint import ModelFile, load_model
from ...quality.levels import SizeReduction
from ...quality.reduction import Reducer
from ...scene.assets import Character, Deformer, Floats, Mesh, Motion, Scene, Skeleton
from ...scene.cycles import rounds
from ...scene.family import has_bones, motion_on
from ...scene.held_parts import HeldParts
from ...scene.kinematics import MAX_FPS, MIN_FPS, lbs_deformer, local_transforms, sample_motion
from ...scene.posed_alike import shaped_as_in_stage
from ...scene.riders import Rider
from ..targets import JointNames, Target, fit, joint_names
from .bodies import WornModel, other_bones, worn
from .direction import Direction, held_parts, held_proxies, need_moving, stated_at
from .fabrics import in_fabric
from .inputs import InputContents, InputHashes, model_contents, read_unchanged, shapes_of, stage_contents
from .looped import MOST_ROUNDS, Loop, find_loop, need_alone, need_constant, need_same_colliders
from .request import ALLOWED_FPS, BakeRequest
from .riders import riders_of
from .rollout import BakeRollout
from .start import need_startable, read_start
from .world import ShotSurroundings, Sight, asked_world

if TYPE_CHECKING:
    from pxr import Usd
    from ssilk_usd.opening.garment_api import GarmentRecord
    from ssilk_usd.reading.direction import SaidDirection
    from ssilk_usd.reading.frame_range import FrameRange
    from ssilk_usd.units import StageUnits
    from ssilk_usd.writing.asset_info import AssetInfo

    from ...network.model.network import GarmentModel

VERSION_DIGITS = 12  # of a model's hash, which are its garment's version where none is given
HAND_TOLERANCE = 1e-3  # [m], and of axes, by which a pose by hand may end elsewhere than it begins in a loop
FREE_TOLERANCE = 0.01  # of ssilk:free, by which its first and last frame may differ in a loop
LEAD = 1.0  # [s] of a motion before its shot that are rolled out, so that the garment is on its way when it begins


@dataclass(frozen=True, eq=False)
class _ReadMotion:
    """A motion as it was read, the shot's samples of it, the same with those before them, how many these are, which
    frames the shot's are, and at which the character becomes hidden (True) or visible (False); how it repeats, where
    it is to be a loop."""

    source: Motion
    sampled: Motion
    whole: Motion
    lead: int
    frames: FrameRange | None
    hidden: list[tuple[int, bool]]
    loop: Loop | None = None
    told: tuple[Event, ...] = ()


@dataclass(frozen=True, eq=False)
class LoadedGarment:
    """A garment on its character, ready for any motion.

    Attributes:
        model: the network; None under linear blend skinning.
        deformer: the garment as its target takes it.
        names: its joints as its target finds them.
        units: units and up axis of what is written.
        model_held, stage_held: what model and stage held while they were read.
        provenance: where the model comes from, as a shot stores it.
        record: how the model was made, as its mesh stores it.
        played: likewise with the fabric that it plays; None for that of its training.
        info: of the garment as an asset.
        riders: what rides on it.
        told: what was found about the body and riders, to be reported.
        body: which body it lies on (`bodies.WornModel.body`).
        first: the skeleton of the first body of the model's family; None where it lies on no other one of that.
        hub_ratio: height of the hub over the ground, relative to that body's, of another body that weights of the
            stage's shapes make; None where motions are played as they are.
        moves: of such a body how far each of its proxies is from where the first has it, along its parent's axes [m],
            (3,).
    """

    request: BakeRequest
    file: ModelFile
    model: GarmentModel | None
    deformer: Deformer
    names: JointNames
    units: StageUnits
    model_held: InputContents
    stage_held: InputContents
    provenance: dict[str, object]
    record: GarmentRecord
    info: AssetInfo
    riders: tuple[Rider, ...] = ()
    told: tuple[Event, ...] = ()
    body: tuple[float, ...] | None = None
    first: Skeleton | None = None
    hub_ratio: float | None = None
    moves: Mapping[str, Floats] = field(default_factory=dict)
    played: GarmentRecord | None = None

    @property
    def over_models(self) -> dict[str, str]:
        """SHA-256 of the models that the garment was trained over, by name."""
        return dict(self.file.provenance.get("over", {}))

    def over(self, motion: str, *, range: str | None = None, handles: int = 0) -> BakeRollout:
        """Return the garment over a motion, "file[:/Prim/Path]"; range and handles are those of a request.

        Raises:
            SsilkError: the file is missing, does not fit, or lacks the range.
        """
        request = replace(self.request, motion=motion, range=range, handles=handles)
        read, held = read_unchanged(partial(stage_contents, motion), partial(self._read, request))
        asked = asked_world(request.colliders, request.wind, request.gusts, request.gravity)
        around = ShotSurroundings(motion, request.stage, self.deformer.scene, read.source, asked)
        start = None
        if request.start_cloth:
            need_startable(request, loops=read.loop is not None)
            read = replace(read, whole=read.sampled, lead=0)  # nothing is rolled out before it
            begins = read.sampled.start / request.samples_per_frame
            start = read_start(request.start_cloth, self.deformer.scene.garment, self.file.config.fps, begins)
        sight = Sight.of(self.file, solved=request.latent_iterations > 0)
        source = read.source if request.lbs else self._felt(around, sight)
        loop = read.loop and self._felt_in_loop(request, read.loop, around, sight, source)
        said = self._said(request, read) if self.model else None
        kept, reduction = self._cut(source, said) if request.keep else (self, None)
        character = self.deformer.scene.character
        provenance = {
            **self.provenance,
            **({"reduced": reduction.to_metadata()} if reduction else {}),
            "request": request.to_metadata(),
            "motion_sha256": held.first,
            **({} if start is None else {"start_cloth_sha256": start.digest}),
        }
        return BakeRollout(
            request=request,
            model=kept.model,
            deformer=kept.deformer,
            motion=read.sampled,
            source=source,
            whole=read.whole,
            lead=read.lead,
            frames=read.frames,
            hidden=read.hidden,
            units=self.units,
            inputs=InputHashes(model=self.model_held.digest, stage=self.stage_held.digest, motion=held.digest),
            provenance=provenance,
            record=self.record,
            played=self.played,
            start_cloth=start,
            info=self.info,
            names=self.names,
            fabric=self.file.fabric,
            sight=sight,
            around=around,
            reduction=reduction,
            riders=self.riders,
            told=(
                *self.told,
                *read.told,
                *other_bones(motion, read.sampled, character, self.first),
                *(Message(text, "warning") for text in (said.unheard if said else ())),
            ),
            direction=kept._directed(request, read, said) if said else None,
            loop=loop,
        ).begun()

    def _read(self, request: BakeRequest) -> _ReadMotion:
        from ssilk_usd.reading.body_shapes import with_body_shapes
        from ssilk_usd.reading.frame_range import read_frame_range
        from ssilk_usd.reading.motion import read_motion
        from ssilk_usd.reading.visibility import read_hidden

        character, root, samples = self.deformer.scene.character, request.root, request.samples_per_frame
        garment = self.deformer.scene.garment.mesh.path.rpartition("/")[2]

        def shaped(motion: Motion) -> Motion:
            def read(own: Character) -> Motion:
                return with_body_shapes(request.stage, request.motion, motion, own, root=root, garment=garment)

            return shaped_as_in_stage(character, read)

        frames = read_frame_range(request.motion, request.time_range, request.handles, root=root, rate=request.fps)
        if frames is None:
            source, told = self._between_own_bones(read_motion(request.motion, character.skeleton, root=root))
            sampled, begun, handles = _sampled(source, (request.fps or source.fps) * samples, np.zeros(1)), 0, 0
            whole = sampled = shaped(sampled)
        else:
            fps = (request.fps or frames.fps) * samples
            rate, handles = fps / frames.fps, frames.before * samples
            # Samples before the range, on the shot's grid.
            wanted = handles + round(max(LEAD, request.pre_roll) * fps)
            begun = max(min(_floor(frames.earlier * rate), wanted), handles)
            earlier = min(_ceil(begun / rate), frames.earlier)
            last = min(_floor(frames.count * rate) + frames.after * samples, _floor(frames.later * rate))
            later = max(min(_ceil(last / rate), frames.later), frames.count)
            within = (frames.first - earlier * frames.step, frames.first + later * frames.step)
            read = read_motion(request.motion, character.skeleton, root=root, within=within)
            source, told = self._between_own_bones(read)
            whole = _sampled(source, fps, earlier + np.arange(-begun, last + 1) / rate)
            whole = shaped(replace(whole, start=frames.first / frames.step * fps / frames.fps - begun))
            sampled = whole.clip(begun - handles, whole.frame_count)
        hidden = read_hidden(request.motion, sampled, root=root)
        source = shaped(source) if request.latent_iterations else source  # networks do not see it
        found = _ReadMotion(source, sampled, whole, begun - handles, frames, hidden, told=told)
        return self._repeating(request, found) if self._loops(request, source) else found

    def _between_own_bones(self, motion: Motion) -> tuple[Motion, tuple[Event, ...]]:
        """Return a motion of the first body as a body moves that shapes of its stage make: no shot has its bones."""
        skeleton, first = self.deformer.scene.character.skeleton, self.first
        if self.hub_ratio is None or first is None or has_bones(motion, skeleton) or not has_bones(motion, first):
            return motion, ()
        text = "its joints are as far apart as those of the stage's own body, and are played between this one's bones"
        return motion_on(motion, first, skeleton, self.hub_ratio), (Message(f"{motion.path}: {text}"),)

    @cached_property
    def _places(self) -> tuple[str, ...]:
        return stated_at(self.deformer.scene.garment.mesh, self.request.stage, self.request.root)

    def _loops(self, request: BakeRequest, motion: Motion) -> bool:
        """Return whether a shot is to be a loop; skinning alone repeats by itself."""
        from ssilk_usd.reading.direction import read_loop

        asked = request.loop or read_loop(request.motion, request.stage, self._places, motion)
        if request.lbs or not asked:
            return False
        need_alone(request)
        return True

    def _repeating(self, request: BakeRequest, read: _ReadMotion) -> _ReadMotion:
        """Return a motion of a shot that repeats, without what comes before it."""
        scene, shot = self.deformer.scene, read.sampled
        loop = find_loop(request, read.source, shot, scene.character.skeleton, scene.garment.mesh.diagonal)
        first = round(shot.start * read.source.fps / shot.fps - read.source.start)
        source = read.source.clip(first, first + loop.cycle.frames + loop.cycle.closed)
        return replace(read, source=source, whole=shot, lead=0, loop=loop)

    def _felt_in_loop(
        self, request: BakeRequest, loop: Loop, around: ShotSurroundings, sight: Sight, source: Motion
    ) -> Loop:
        """Return a loop with what the network sees of the world in each of its rounds."""
        need_constant(request, around.pull, loop.cycle)
        motion, skeleton = source, self.deformer.scene.character.skeleton
        if source.proximity is not None:
            from ...network.proximity import proximity_vectors

            need_same_colliders(request, proximity_vectors(source.proximity), loop.cycle)
            motion = rounds(replace(source, gravity=None), skeleton, loop.cycle, MOST_ROUNDS + 1)
        else:
            motion = loop.motion
        if sight.pull:
            from ...physics.world.felt import felt_gravity

            gravity = felt_gravity(around.pull, motion, self.deformer.scene, self.file.fabric)
            motion = replace(motion, gravity=gravity)
        return replace(loop, motion=motion)

    def _felt(self, around: ShotSurroundings, sight: Sight) -> Motion:
        """Return a motion with the gravity, the wind and the colliders of its shot that the network sees."""
        motion, scene = around.motion, self.deformer.scene
        if not (sight.pull or sight.colliders):
            return motion
        from ...network.runtime.garment import NumpyGarment
        from ...network.runtime.sight import seen_proximity
        from ...physics.world.felt import felt_gravity

        gravity = felt_gravity(around.pull, motion, scene, self.file.fabric) if sight.pull else None
        motion = motion if gravity is None else replace(motion, gravity=gravity)
        seen = around.seen if sight.colliders else None
        if seen is None or not seen.colliders:  # then no network is built to look
            return motion
        return replace(motion, proximity=seen_proximity(seen, motion, NumpyGarment(self.file)))

    def _said(self, request: BakeRequest, read: _ReadMotion) -> SaidDirection:
        """Return what stages say of how the garment is directed."""
        from ssilk_usd.reading.direction import read_direction

        assert self.model is not None
        return read_direction(
            request.motion, request.stage, self._places, read.whole, self.model.scene.rig.joint_names
        )

    def _hand_moves(self, read: _ReadMotion) -> Mapping[str, Floats]:
        """Return how far proxies are from where a shot poses them, which has those of the first body, as joints."""
        of_first = read.told or (self.first and has_bones(read.sampled, self.first))
        return self.moves if of_first else {}

    def _directed(self, request: BakeRequest, read: _ReadMotion, said: SaidDirection) -> Direction | None:
        """Return how the shot directs the garment; None where it moves freely throughout."""
        assert self.model is not None
        moves, parts = self._hand_moves(read), None
        if said.parts:
            parts = held_parts(said.parts, self.deformer, self.model.scene, request, read.whole, moves)
        hold = request.hold or said.hold
        need_moving(request, hold)
        if read.loop is not None:
            looped = self._directed_in_loop(request, read, read.loop, said, parts)
            return looped and replace(looped, hand_moves=moves)
        if said.free is None and hold == 1 and parts is None:
            return None
        samples, count = request.samples_per_frame, read.whole.frame_count
        first = read.lead + (read.frames.before * samples if read.frames else 0)
        free = np.ones(count) if said.free is None else said.free
        hold, first = (hold * samples, first) if hold > 1 else (1, 0)
        return Direction(free, hold, read.whole, first, parts, said=said.parts, hand_moves=moves)

    def _directed_in_loop(
        self, request: BakeRequest, read: _ReadMotion, loop: Loop, said: SaidDirection, parts: HeldParts | None
    ) -> Direction | None:
        hold = (request.hold or said.hold) * request.samples_per_frame
        hold = 1 if hold == request.samples_per_frame else hold
        if loop.period % hold:
            found = f"poses that are held for {hold} samples, in a round of {loop.period}"
            fail(request.motion, found, "they have to begin anew with each round", "give --hold 1, or another range")
        if said.free is None and hold == 1 and parts is None:
            return None
        free = np.ones(read.whole.frame_count) if said.free is None else said.free
        keyed = [("ssilk:free", free[:, None])]
        if parts is not None:
            keyed += [("ssilk:free of a part", 1 - parts.skinned), ("ssilk:posed of a part", parts.posed)]
            by_hand = parts.hand[:, parts.posed[0] > 0]
            if loop.cycle.closed and np.abs(by_hand[-1] - by_hand[0]).max(initial=0) > HAND_TOLERANCE:
                found = "a proxy that is posed by hand ends elsewhere than it begins"
                fail(request.motion, found, "a loop ends as it begins", "pose it so, or key ssilk:posed as 0 there")
        for name, values in keyed if loop.cycle.closed else ():
            if (off := np.abs(values[-1] - values[0])).max(initial=0) > FREE_TOLERANCE:
                first, last = (values[row, int(off.argmax())] for row in (0, -1))
                found = f"{name} is {first:g} in the first frame and {last:g} in the last"
                fail(request.motion, found, "a loop ends as it begins", "key it so")
        rate = loop.motion.fps / read.sampled.fps
        motion = _sampled(loop.motion, read.sampled.fps, np.arange(loop.samples) * rate)
        return Direction(loop.tiled(free), hold, motion, 0, parts and parts.of(loop.tiled), said=said.parts)

    def _cut(self, motion: Motion, said: SaidDirection | None) -> tuple[LoadedGarment, SizeReduction]:
        """Return the garment cut to the size that the request keeps, so as to be best for this motion."""
        assert self.model is not None and self.request.keep is not None and said is not None
        held = held_proxies(said.parts, self.deformer, self.model.scene.rig.joint_names)
        reducer = Reducer(self.file, [motion], held=held)
        found = reducer.reduce(self.request.keep)
        model, deformer = _network_like(self.model, found.file, self.request)
        return replace(self, model=model, deformer=deformer), SizeReduction.of(reducer.whole, found)


def load_garment(request: BakeRequest) -> LoadedGarment:
    """Load what a request names, except its motion.

    Raises:
        SsilkError: a file is missing or does not fit the others.
    """
    from ...network.checkpoint import network

    device = select_device(request.device)
    file, model_held = read_unchanged(partial(model_contents, request.model), partial(load_model, request.model))
    (on, units, riders, told), stage_held = read_unchanged(
        partial(stage_contents, request.stage), partial(_on_stage, file, request)
    )
    first, own, file, scene = file, on.file, on.file, on.scene
    file, in_words = in_fabric(own, request.model, request.fabric, request.material, request.feedback)
    model = None if request.lbs else network(file, scene).to(device)
    deformer = lbs_deformer(scene) if model is None else model.deformer()
    by_shapes = bool(shapes_of(request.stage) and on.member)
    return LoadedGarment(
        request=request,
        file=file,
        model=model,
        deformer=fit(deformer, request.receiver),
        names=joint_names(scene, request.receiver),
        units=units,
        model_held=model_held,
        stage_held=stage_held,
        provenance={
            "model_sha256": model_held.digest,
            "training": file.provenance.get("ssilk", ""),
            **({"trained_over": dict(over)} if (over := file.provenance.get("over")) else {}),
        },
        record=_record(own, model_held.digest),
        played=_record(file, model_held.digest) if in_words else None,
        info=_info(request, model_held.digest),
        riders=riders,
        told=(*told, *in_words),
        body=on.body,
        first=first.scene.character.skeleton if on.member else None,
        hub_ratio=_hub_ratio(first, on.member) if on.member and by_shapes else None,
        moves=_moves(first.scene, scene) if by_shapes else {},
    )


def _hub_ratio(file: ModelFile, member: tuple[float, ...]) -> float:
    """Return how much higher than the first body's the hub of another member is, in parts of it."""
    assert file.bodies is not None
    bodies = file.bodies.family.bodies
    return bodies.height_ratio(np.array(member[: bodies.size]))


def _moves(base: Scene, other: Scene) -> dict[str, Floats]:
    """Return how far proxies are from their parents otherwise than on a base, along the parents' axes [m], (3,)."""
    after, before = (local_transforms(each.bind_transforms, each.parents)[:, :3, 3] for each in (other, base))
    moved = (after - before)[base.character.skeleton.joint_count :]
    return dict(zip(base.rig.joint_names, moved))


def _on_stage(
    file: ModelFile, request: BakeRequest
) -> tuple[WornModel, StageUnits, tuple[Rider, ...], tuple[Event, ...]]:
    """Return a model on the character of a stage, the units of what is written, what rides on it, and what there is
    to report."""
    from ssilk_usd.opening.stage import open_stage

    stage = open_stage(request.stage)
    on = worn(file, stage, request.root)
    told: list[Event] = [*on.told, *_stiffened(on.scene.garment.mesh, stage)]
    own = split_body(split_location(request.stage)[0])[0]

    def laid() -> Mesh:
        return worn(file, open_stage(own), request.root).scene.garment.mesh

    shaped = laid if shapes_of(request.stage) else None
    riders = riders_of(stage, on.scene.garment.mesh, request.root, lambda event: told.append(event), shaped)
    return on, _units(stage, request.receiver), riders, tuple(told)


def _stiffened(mesh: Mesh, stage: Usd.Stage) -> list[Event]:
    """Return a warning where a garment is painted otherwise on a stage than it was when it was trained."""
    from ssilk_usd.writing.look import stiff_otherwise

    where = stiff_otherwise(mesh, stage)
    found = "its stiffness is painted otherwise than when the garment was trained, which is what a bake keeps"
    return [Message(f"{where}: {found}; train it again", "warning")] if where else []


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
    direction = rollout.direction
    if direction is not None and direction.parts is not None:
        leaves = {name.rpartition("/")[2] for name in model.scene.rig.joint_names}
        said = [part for part in direction.said if leaves and (part.vertices is not None or part.name in leaves)]
        given = model.scene, rollout.request, rollout.whole, direction.hand_moves
        parts = held_parts(said, deformer, *given) if said else None
        parts = parts.of(rollout.loop.tiled) if parts and rollout.loop else parts
        direction = replace(direction, parts=parts, shapes=None)
    return replace(rollout, model=model, deformer=deformer, direction=direction, is_fading=False).begun()


def _network_like(like: GarmentModel, file: ModelFile, request: BakeRequest) -> tuple[GarmentModel, Deformer]:
    """Return a model's network on the character of another network, and the garment as its target takes it."""
    from ...network.checkpoint import network

    model = network(file, replace(file.scene, character=like.scene.character))
    model.to(select_device(request.device))
    return model, fit(model.deformer(), request.receiver)


def _sampled(motion: Motion, fps: float, position: Floats) -> Motion:
    """Return a motion at fractional frames `position`, shape (N,), which are those of a rate [1/s]."""
    if not MIN_FPS <= fps <= MAX_FPS:
        fail("--fps", f"{fps:g} frames per second", ALLOWED_FPS)
    near = np.round(position)
    whole = np.abs(position - near) < 1e-6
    position = np.where(whole, near, position).clip(0, motion.frame_count - 1)
    return Motion(motion.path, fps, *sample_motion(motion, position))


def _floor(samples: float) -> int:
    return int(np.floor(samples + 1e-6))


def _ceil(frames: float) -> int:
    return int(np.ceil(frames - 1e-6))


def _units(stage: Usd.Stage, target: Target) -> StageUnits:
    """Return a target's units and axis, or those of the character's stage where it takes any."""
    from ssilk_usd.units import StageUnits

    own = StageUnits.of(stage)
    return StageUnits(target.meters_per_unit or own.meters_per_unit, target.up_axis or own.up_axis)


def _info(request: BakeRequest, model_hash: str) -> AssetInfo:
    from ssilk_usd.writing.asset_info import AssetInfo

    version = request.asset_version or model_hash[:VERSION_DIGITS]
    return AssetInfo(version=version, identifier=request.asset_identifier or "")


def _record(file: ModelFile, model_hash: str) -> GarmentRecord:
    from ssilk_usd.opening.garment_api import GarmentRecord

    unused = {"collision"} if file.fabric.contact_model == "surface" else {"contact", "loose_contact"}
    unused |= set() if file.fabric.stitch else {"stitch"}
    values = asdict(file.fabric).items()
    numbers = {name: float(value) for name, value in values if isinstance(value, int | float) and name not in unused}
    return GarmentRecord(
        model_hash=model_hash,
        version=str(file.provenance.get("ssilk", "")),
        seed=int(file.provenance.get("seed", 0)),
        fabric=file.fabric.name,
        parameters=numbers,
    )
