# SPDX-License-Identifier: Apache-2.0
"""A garment over a motion: its poses as a shot stores them, and its points as the decoder has them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import fail
from ...events import Countdown, Event, Message, Reporter, silent
from ...quality.levels import SizeReduction
from ...scene.assets import PINNED, Deformer, Floats, GarmentPose, Motion, Skeleton
from ...scene.assets.reshaped import reshaped
from ...scene.fabric_range import properties
from ...scene.fabrics import Fabric
from ...scene.kinematics import (
    deform,
    held_at_cuts,
    lbs_poses,
    motion_transforms,
    resample,
    sample_felt,
    sample_motion,
    slerp,
    split_at_cuts,
)
from ...scene.riders import Rider, RiderJoints
from ..targets import JointNames
from .direction import CHUNK, DirectedPoses, Direction
from .inputs import InputHashes
from .looped import MOST_ROUNDS, Loop, LoopedPoses, looped, seam_words, summary
from .request import BakeRequest
from .result import CertificateSummary, FrameSpan, LatentSummary, LoopSummary, RefinementSummary
from .start import BLEND, ELSEWHERE, FAR, SEEN, StartCloth, fading
from .world import ShotSurroundings, Sight

if TYPE_CHECKING:
    from ssilk_usd.opening.garment_api import GarmentRecord
    from ssilk_usd.reading.frame_range import FrameRange
    from ssilk_usd.units import StageUnits
    from ssilk_usd.writing.asset_info import AssetInfo

    from ...network.latent_solver import LatentRoller
    from ...network.model.network import GarmentModel
    from ...network.start import GivenStart
    from .beneath import GarmentsBeneath


@dataclass(frozen=True, eq=False)
class Refinement:
    """The refined frames of a rollout, all in memory: 65 MB for 1,000 frames of 2,700 vertices.

    Attributes:
        points: garment vertices of each frame in the world [m], shape (V, 3).
        poses: poses fitted to them with the rollout's deformer, where joints are written.
        summary: what the solver changed.
        before: the garment that the network's poses are of.
        beneath: the garments that it was refined over; None without.
    """

    points: tuple[Floats, ...]
    poses: tuple[GarmentPose, ...]
    summary: RefinementSummary
    before: Deformer
    beneath: GarmentsBeneath | None = None


@dataclass(frozen=True, eq=False)
class SolvedLatents:
    """The poses of states that were solved for in latents, all in memory: 4 MB for 1,000 frames; and how it went.

    Attributes:
        loop: the round that they are, where the shot is a loop.
    """

    poses: tuple[GarmentPose, ...]
    summary: LatentSummary
    loop: LoopedPoses | None = None


@dataclass(eq=False)
class Certificate:
    """Frames that were moved until nothing in them intersects or shows, as blendshapes of the shot's own.

    Attributes:
        poses: of all frames, with weights of these blendshapes.
        poses_before: the same without them.
        moved: frames in which they weigh something.
        deformer: the garment without them.
        work: what it was made with (`delivery.bake.certificate`).
        summary: what was found in the written file; None before.
    """

    poses: tuple[GarmentPose, ...]
    poses_before: tuple[GarmentPose, ...]
    moved: frozenset[int]
    deformer: Deformer
    work: Any
    summary: CertificateSummary | None = None


@dataclass(frozen=True, eq=False)
class BakeRollout:
    """A garment over a motion at the rate of the shot's samples.

    Attributes:
        model: the network; None under linear blend skinning.
        deformer: the garment as its target takes it.
        motion: the character's motion at the shot's samples; `source` is the motion as it was read.
        whole: the same from the first sample on that is rolled out.
        lead: samples before the shot that are rolled out, at its rate.
        frames: which frames of the motion the shot plays; None for a pose without samples.
        hidden: at which frames of the motion the garment becomes hidden (True) or visible (False).
        units: units and up axis of the shot.
        inputs: what the request's inputs held while they were read.
        provenance: where all of this comes from, as a shot stores it.
        record: how the garment's model was made.
        played: likewise with the fabric that it plays; None for that of its training.
        info: of the garment as an asset.
        names: the joints as the shot's target finds them.
        sight: what the network knows of the world around the character.
        around: this world, at the frames of `source`.
        reduction: what was kept of the model, where less than all.
        refinement: the refined frames, once `refined` has computed them.
        latents: the network's poses, once `solved` has found them in latents.
        certificate: the frames that `certified` has moved, once it has.
        riders: what rides on the garment; `told` is what was found about them, to be reported.
        direction: where the garment is held; None where it moves freely throughout.
        loop: how the shot repeats; None where it need not.
        start_cloth: that the first frame begins with; None to begin at rest.
        is_fading: whether the last blendshape is what the first frame lacks of that, and fades.
        recovered: frames at which the rollout was lost and the garment was put to rest; filled while `network_poses`
            yields.
        held_off: RMS distance from linear blend skinning of frames that are held [m], likewise.
    """

    request: BakeRequest
    model: GarmentModel | None
    deformer: Deformer
    motion: Motion
    whole: Motion
    source: Motion
    hidden: list[tuple[int, bool]]
    units: StageUnits
    inputs: InputHashes
    provenance: dict[str, object]
    record: GarmentRecord
    info: AssetInfo
    names: JointNames
    fabric: Fabric
    sight: Sight
    around: ShotSurroundings
    lead: int = 0
    frames: FrameRange | None = None
    reduction: SizeReduction | None = None
    refinement: Refinement | None = None
    latents: SolvedLatents | None = None
    certificate: Certificate | None = None
    riders: tuple[Rider, ...] = ()
    told: tuple[Event, ...] = ()
    direction: Direction | None = None
    loop: Loop | None = None
    played: GarmentRecord | None = None
    start_cloth: StartCloth | None = None
    is_fading: bool = False
    recovered: list[FrameSpan] = field(default_factory=list)
    held_off: list[float] = field(default_factory=list)

    @property
    def start(self) -> float:
        """Time code of the first frame."""
        return self.motion.start / self.request.samples_per_frame

    @property
    def fabric_words(self) -> str:
        """The fabric that it plays, in words."""
        values = {name: f"{getattr(self.fabric, name):.4g}" for name in properties(self.fabric)}
        return f"{self.fabric.name} ({', '.join(f'{name} {value}' for name, value in values.items())})"

    @property
    def influences(self) -> int:
        """How many joints move a vertex of the trained garment, at most; 0 under linear blend skinning."""
        return 0 if self.model is None else self.model.scene.rig.skin.indices.shape[1]

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the shot's poses, some frames at a time: the network's, or those fitted to refined vertices."""
        if self.certificate is not None:
            yield from self.certificate.poses
        elif self.refinement is None or self.request.writes_points:
            yield from self.network_poses()
        else:
            yield from self.refinement.poses

    def rider_joints(self) -> RiderJoints:
        """Return the garment with the joints of what rides on it."""
        return RiderJoints(self.deformer, self.riders, self.request.receiver.influences)

    def network_poses(self, roller: LatentRoller | None = None) -> Iterator[GarmentPose]:
        """Yield the network's poses, some frames at a time.

        Args:
            roller: solves for them, where the request says so; one of its own by default.
        """
        if self.latents is not None:
            yield from self.latents.poses
            return
        if self.model is None:
            yield from lbs_poses(self.motion.frame_count)
            return
        if roller is None and self.request.latent_iterations:
            roller = self.latent_roller()
        if self.loop is not None:
            yield self._looped.pose
            return
        self.recovered.clear()
        for pose in self._course(self.lead, self.lead + self.motion.frame_count, roller, self.recovered):
            yield self._faded(pose) if self.is_fading else pose

    def _course(
        self, start: int, stop: int, roller: LatentRoller | None, lost: list[FrameSpan]
    ) -> Iterator[GarmentPose]:
        """Yield the poses of samples of `whole`, counted from `start`, and list where the rollout was lost."""
        rolled = partial(self._rolled, roller=roller, lost=lost, start=start)
        if self.direction is not None:
            directed = DirectedPoses(self.direction, self._network_deformer, rolled)
            for pose in directed.poses(start, stop):
                self.held_off[:] = directed.off  # now: a loop may ask for no more
                yield pose
            return
        for pose in rolled(0, stop, 1):
            part = pose.part(slice(max(start - pose.start, 0), None))
            if part.frame_count:
                yield replace(part, start=part.start - start)

    @cached_property
    def _looped(self) -> LoopedPoses:
        if self.certificate is not None:  # its rounds were rolled before frames were moved
            return self.certificate.work.base._looped
        if self.latents is not None and self.latents.loop is not None:
            return self.latents.loop
        assert self.loop is not None
        return self.in_loop(self.loop, self.latent_roller() if self.request.latent_iterations else None)

    def in_loop(self, loop: Loop, roller: LatentRoller | None) -> LoopedPoses:
        """Return the round of a loop that repeats best; `roller` as for `network_poses`."""
        lost, count = list[FrameSpan](), self.motion.frame_count
        course = self._course(0, loop.samples, roller, lost)
        # The network's decoder: that of the shot may have shapes of a certificate, which these poses lack.
        found = looped(course, loop, count, self.motion.fps, self._network_decoded)
        del self.held_off[len(self.held_off) // MOST_ROUNDS :]  # those of one round
        within = [(span.first - found.begins, span.last - found.begins) for span in lost]
        spans = [(max(first, 0), min(last, count - 1)) for first, last in within]
        self.recovered[:] = [FrameSpan(first, last) for first, last in spans if first <= last]
        return found

    @cached_property
    def loop_summary(self) -> LoopSummary | None:
        """How the end of the shot meets its beginning; None where it is no loop."""
        if self.loop is None or self.model is None:
            return None
        found, count = self._looped, self.motion.frame_count
        rest = np.concatenate([self._network_decoded(found.first.part(slice(0, 3))),
                               self._network_decoded(found.first.part(slice(count - 2, count)))])  # fmt: skip
        return summary(found, self.loop, self.points(), list(rest), self.motion.fps)

    def _rolled(
        self, first: int, stop: int, step: int, roller: LatentRoller | None, lost: list[FrameSpan], start: int
    ) -> Iterator[GarmentPose]:
        """Yield the network's poses at samples of `whole`, first, first + step, ..., below stop; it starts at first.

        In between the motion is seen as straight. Where the rollout is lost is listed, counted from `start`.
        """
        from ...network.rollout import garment_poses

        assert self.model is not None
        count, pre_roll = len(range(first, stop, step)), self.request.pre_roll

        def note(frames: range) -> None:
            begin, end = first + frames[0] * step, min(first + (frames[-1] + 1) * step, stop) - 1
            if end >= start:
                lost.append(FrameSpan(max(begin - start, 0), end - start))

        driver, rate = self._driver(first, stop, step), self.motion.fps / step
        given = self._given if first == 0 and self.start_cloth else None
        for pose in garment_poses(
            self.model, driver, rate, CHUNK, note, pre_roll=pre_roll, roller=roller, given=given
        ):
            part = pose.part(slice(0, max(count - pose.start, 0)))
            if part.frame_count:
                yield part

    @cached_property
    def _given(self) -> GivenStart:
        """The state that the first frame begins with."""
        from ...network.start import fitted_start

        assert self.model is not None and self.start_cloth is not None
        fps, points = self.model.config.fps, self.start_cloth.points
        whole = resample(self._driver(0, self._end, 1), fps, cover=True)
        first, earlier = whole.clip(0, 1), self._source_frame(-self.lead) - self.source.fps / fps
        if not self.start_cloth.moves:  # then it stands still: cloth and character go on together
            return fitted_start(self.model, first, first, points)
        if earlier < 0:  # as it goes on
            return fitted_start(self.model, _step_before(whole), first, points)
        position = np.array([earlier])
        poses, felt = sample_motion(self.source, position), sample_felt(self.source, position)
        return fitted_start(self.model, Motion(self.source.path, fps, *poses, **felt), first, points)

    def begun(self) -> BakeRollout:
        """Return the rollout with blendshapes of its own: those of proxies that are held each by itself, or one
        for what latents miss of its first cloth, where that is seen."""
        if self.direction is not None and self.direction.parts is not None:
            if self.start_cloth is not None:
                fail("--start-cloth", "a start and proxies that are held by themselves", "one of both",
                     "leave --start-cloth out, and ssilk:free:NAME and ssilk:posed:NAME of the garment")  # fmt: skip
            direction = self.direction.of(self.deformer)
            assert direction.shapes is not None
            shapes = np.concatenate([self.deformer.shapes, direction.shapes.offsets])
            return replace(self, deformer=replace(self.deformer, shapes=shapes), direction=direction)
        if self.start_cloth is None or self.model is None:
            return self
        from ...scene.decomposition.rest import rest_residuals

        self._need_startable()
        if self._given.left[1] <= SEEN:
            return self
        pose = next(self._course(0, self.motion.frame_count, None, [])).part(slice(0, 1))
        points, first = [self.start_cloth.points[1]], self.motion.clip(0, 1)
        ((_, offsets),) = rest_residuals(self.deformer, first, replace(pose, start=0), points)
        own = np.where((self.deformer.scene.classes == PINNED)[:, None], 0, offsets[0])
        shapes = np.concatenate([self.deformer.shapes, own[None]])
        begun = replace(self, deformer=replace(self.deformer, shapes=shapes), is_fading=True)
        begun.__dict__["_given"] = self._given
        return begun

    @property
    def _network_deformer(self) -> Deformer:
        """The garment with the blendshapes of the network alone."""
        assert self.model is not None
        count = self.model.decoder.shape_count + int(self.model.decoder.has_constant)
        return replace(self._unrefined, shapes=self._unrefined.shapes[:count])

    @property
    def _unrefined(self) -> Deformer:
        """The garment that the network's poses are of, where refined frames have blendshapes of their own."""
        return self.deformer if self.refinement is None else self.refinement.before

    def _faded(self, pose: GarmentPose) -> GarmentPose:
        """Return poses with the weight of what the first frame lacks: none where skinning holds the garment."""
        frames = range(pose.start, pose.start + pose.frame_count)
        weights = fading(frames, self.motion.fps)
        if self.direction is not None:
            weights = weights * self.direction.free[frames.start : frames.stop]
        return replace(pose, weights=np.concatenate([pose.weights, weights[:, None]], axis=1))

    def _fading(self, pose: GarmentPose) -> Floats:
        """Return the vertices of poses; those in which nothing is left of the first frame's are the network's own."""
        found = self._network_decoded(pose)
        for frame in np.flatnonzero(pose.weights[:, -1]):
            part = pose.part(slice(frame, frame + 1))
            found[frame] = deform(self.deformer, self.motion, part)[0]
        return found

    def _need_startable(self) -> None:
        """Raise `SsilkError` where the first frame cannot begin with the cloth that is given."""
        assert self.start_cloth is not None
        direction, scene = self.direction, self.deformer.scene
        if direction is not None and (direction.hold > 1 or direction.free[0] < 1):
            found = "poses that are held" if direction.hold > 1 else "ssilk:free below 1 in the first frame"
            fail("--start-cloth", f"a start and {found}", "one of both", "leave --start-cloth out, or let it go")
        root = motion_transforms(self.motion.clip(0, 1), scene.character.skeleton.parents)[0, :, :3, 3]
        away = np.linalg.norm(self.start_cloth.points[1][:, None] - root[None], axis=2).min()
        reach = scene.garment.mesh.diagonal
        todo = "name the frame after '@' that is this shot's first, of a shot of this character"
        if away > reach:
            found = f"its cloth is {away:.3g} m away from the character's first pose"
            fail(self.start_cloth.where, found, f"{reach:.3g} m are allowed", todo)
        if self._given.left[0] > ELSEWHERE * reach:
            found = f"the network's cloth comes no nearer to it than {self._given.left[0]:.3g} m (RMS)"
            fail(self.start_cloth.where, found, f"{ELSEWHERE * reach:.3g} m are allowed", todo)

    def _tell_start(self, report: Reporter) -> None:
        """Report how near the first frame is to the cloth that it begins with."""
        if self.start_cloth is None:
            return
        rms, most = (1000 * value for value in self._given.left)
        slow = "" if self.start_cloth.moves else "; nothing is known of how it moves there"
        near = f"{rms:.2f} mm (RMS), {most:.2f} mm at most"
        rest = f"; a blendshape that fades in {BLEND:g} s makes up for the rest" if self.is_fading else ""
        text = f"the cloth begins as in {self.start_cloth.where}; latents come within {near}{rest}{slow}"
        far = self._given.left[0] > FAR
        report(Message(f"{self.request.motion}: {text}", "warning" if far else "info"))

    def latent_roller(self, advanced: Callable[[], object] = lambda: None) -> LatentRoller:
        """Return what solves for the network's states in latents; `advanced` is called after each frame."""
        from ...network.latent_solver import LatentOptions, LatentRoller

        assert self.model is not None
        request = self.request
        options = LatentOptions(iterations=request.latent_iterations, sampled=request.samples_elements)
        return LatentRoller(self.model, self.fabric, options, pre_roll=self.request.pre_roll, advanced=advanced)

    def latent_frames(self) -> int:
        """Return how many frames a solver in latents has to solve, at the model's rate."""
        from ...network.latent_solver import frames_to_solve

        assert self.model is not None
        skeleton = self.deformer.scene.character.skeleton
        driver = self._driver(0, self._end, 1)
        return frames_to_solve(driver, skeleton, self.model.config.fps, self.request.pre_roll)

    def _driver(self, first: int, stop: int, step: int) -> Motion:
        """Return the motion that is rolled over, from a sample of `whole` on: at its own rate, or in steps."""
        skeleton, source = self.deformer.scene.character.skeleton, self.loop.motion if self.loop else self.source
        at = [self._source_frame(sample - self.lead) for sample in range(first, stop, step)]
        if step == 1:
            driver = _from_fraction(source, skeleton, at[0])
            return driver if stop == self._end else driver.clip(0, int(at[-1] - at[0]) + 2)
        position = held_at_cuts(source, skeleton, np.array(at).clip(0, source.frame_count - 1))
        felt, poses = sample_felt(source, position), sample_motion(source, position)
        return Motion(source.path, self.motion.fps / step, *poses, **felt)

    @property
    def _end(self) -> int:
        """Samples of `whole` to roll: those before the shot and its own, or all rounds of a loop."""
        return self.loop.samples if self.loop else self.lead + self.motion.frame_count

    def with_lead(self) -> BakeRollout:
        """Return the rollout of the shot together with the samples before it."""
        return replace(self, motion=self.whole, lead=0, latents=None, recovered=[])

    def seconds(self, sample: int) -> float:
        """Return the time of a sample of the shot, from the first frame of `source` on [s]."""
        return self._source_frame(sample) / self.source.fps

    def _source_frame(self, sample: int) -> float:
        """Return the frame of `source` at a sample of the shot, a fraction where the grids differ."""
        frame = (self.motion.start + sample) * self.source.fps / self.motion.fps - self.source.start
        return float(round(frame)) if abs(frame - round(frame)) < 1e-6 else frame

    def vertices(self, report: Reporter = silent) -> Iterator[Floats]:
        """Yield the decoder's garment vertices in the world [m], shape (V, 3), of each of the shot's poses."""
        told = Countdown(self.motion.frame_count, report)
        for pose in self.poses():
            yield from self.decode(pose)
            told(pose.frame_count)

    def network_vertices(self) -> Iterator[Floats]:
        """Yield the decoder's garment vertices in the world [m], shape (V, 3), of each of the network's poses."""
        for pose in self.network_poses():
            yield from self._network_decoded(pose)

    def points(self, report: Reporter = silent) -> Iterator[Floats]:
        """Yield the points [m], shape (V, 3), that a point cache holds at each sample: refined, or the decoder's."""
        if self.refinement is not None and self.request.writes_points:
            yield from self.refinement.points
        else:
            yield from self.vertices(report)

    def decode(self, pose: GarmentPose) -> Floats:
        """Return the vertices in the world [m], shape (F, V, 3), of consecutive poses of `poses`."""
        if self.certificate is not None:
            return self._certified(self.certificate, pose)
        if self.refinement is not None and not self.request.writes_points:
            return deform(self.deformer, self.motion, pose)
        return self._fading(pose) if self.is_fading else self._network_decoded(pose)

    def _certified(self, certificate: Certificate, pose: GarmentPose) -> Floats:
        """Return the vertices of poses with a certificate; those of frames that were not moved are as without one."""
        before = replace(self, deformer=certificate.deformer, certificate=None)
        found = before.decode(replace(pose, weights=pose.weights[:, : certificate.deformer.shape_count]))
        for frame in range(pose.frame_count):
            if pose.start + frame in certificate.moved:
                found[frame] = deform(self.deformer, self.motion, pose.part(slice(frame, frame + 1)))[0]
        return found

    def _network_decoded(self, pose: GarmentPose) -> Floats:
        if self.model is None:
            return deform(self.deformer, self.motion, pose)
        if self.direction is not None and self.direction.shapes is not None:  # which the network does not know
            shapes = self._unrefined.shapes[: pose.weights.shape[1]]  # a certificate may add some
            return deform(replace(self._unrefined, shapes=shapes), self.motion, pose)
        from ...network.rollout import decode

        return decode(self.model, self.motion, pose)

    def tell(self, report: Reporter) -> None:
        """Report joints that are renamed, and which frames of the motion are played, unless it is all of them."""
        if self.names.renamed:
            report(Message(f"--target {self.request.target}: {self.names}", "warning"))
        for event in self.told:
            report(event)
        self._tell_start(report)
        if self.frames is None:
            return
        name = self.request.motion
        if self.frames.left_out:
            report(Message(f"{name}: {self.frames.left_out}", "warning"))
        if self.frames.chosen or self.request.handles:
            report(Message(f"{name}: {self.frames}"))

    @property
    def _meets_shapes(self) -> bool:
        """Whether cloth meets bodies as the shot shapes them, where it meets any."""
        return bool(self.request.lbs or self.request.refine or self.request.latent_iterations)

    @property
    def _shape_sight(self) -> str:
        if self.request.lbs:
            return "it is written so"
        if self._meets_shapes:
            return "the solver meets it so, and it is written so"
        return (
            "it is written so, but the network was trained on one shape and does not see it change: "
            "--refine N or --quality hero solve for it"
        )

    def warn(self, report: Reporter) -> None:
        """Report where the motion jumps, and at which frames the rollout was lost."""
        from ssilk_usd.reading.shown import tell_shown_otherwise

        from ...authoring.preflight.motion import joint_jumps, root_jumps

        skeleton = self.deformer.scene.character.skeleton
        first, last = self._source_frame(0), self._source_frame(self.motion.frame_count - 1)
        shown = self.source.clip(int(first), int(np.ceil(last)) + 1)
        for found in (*root_jumps(shown, skeleton), *joint_jumps(shown, skeleton)):
            code = (shown.start + found.indices[0]) * self.motion.fps / shown.fps / self.request.samples_per_frame
            text = f"{found.found.partition(' (first to frame')[0]} (first to time code {code:.9g})"
            report(Message(f"{found.prim}: {text}; {found.why}; {found.fix}", "warning"))
        garment = self.deformer.scene.garment.mesh.path.rpartition("/")[2]
        stage, root = self.request.stage, self.request.root
        tell_shown_otherwise(stage, [self.source.path], report, root=root, garment=garment)
        if moved := reshaped(self.deformer.scene.character, self.motion):
            code = self.start + moved[0].frame / self.request.samples_per_frame
            text = f"{self.request.motion}: {'; '.join(map(str, moved))}, most at time code {code:.9g}"
            report(Message(f"{text}; {self._shape_sight}", "info" if self._meets_shapes else "warning"))
        if self.held_off:
            off = 1000 * float(np.sqrt(np.mean(np.square(self.held_off))))
            text = f"{len(self.held_off)} poses are held or let go; proxies hold the garment within"
            report(Message(f"{self.request.motion}: {text} {off:.2g} mm (RMS) of linear blend skinning"))
        if self.loop_summary and (words := seam_words(self.loop_summary)):
            report(Message(f"{self.request.motion}: {words}", "warning"))
        for span in self.recovered:
            report(Message(f"frames {span}: the rollout was lost, and the garment is put to rest", "warning"))


def _step_before(motion: Motion) -> Motion:
    """Return the frame before a motion, from which it came as evenly as it goes on."""
    first, second = (motion.clip(frame, frame + 1) for frame in (0, min(1, motion.frame_count - 1)))
    turned = slerp(first.rotations, second.rotations, np.full((1, 1), -1.0))
    return replace(first, rotations=turned, translations=2 * first.translations - second.translations)


def _from_fraction(motion: Motion, skeleton: Skeleton, first: float) -> Motion:
    """Return a motion with as many frames from a fractional one on, at its own rate.

    Nothing is interpolated across a cut: the frame before it becomes one of those after it, and their first step is
    continued back to it, as the last step of all is continued on.
    """
    whole = int(first)
    motion = motion.clip(whole, motion.frame_count)
    if first == whole:
        return motion
    frames = np.arange(motion.frame_count)
    ends = np.cumsum([span.frame_count for span in split_at_cuts(motion, skeleton)])
    own = np.searchsorted(ends, np.minimum(frames + 1, frames[-1]), side="right")
    begin, end = np.array([0, *ends[:-1]])[own], ends[own] - 1
    low = np.clip(frames, begin, np.maximum(end - 1, begin))
    high = np.minimum(low + 1, end)
    part = (frames + first - whole - low)[:, None]
    rotations = slerp(motion.rotations[low], motion.rotations[high], part)
    step = motion.translations[high] - motion.translations[low]
    translations = motion.translations[low] + part[..., None] * step
    felt = sample_felt(motion, np.clip(frames + first - whole, begin, end))
    return Motion(motion.path, motion.fps, rotations, translations, motion.start + first - whole, **felt)
