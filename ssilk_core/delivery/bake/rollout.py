# SPDX-License-Identifier: Apache-2.0
"""A garment over a motion: its poses as a shot stores them, and its points as the decoder has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...errors import fail
from ...events import Countdown, Event, Message, Reporter, silent
from ...quality.levels import SizeReduction
from ...scene.assets import Deformer, Floats, GarmentPose, Motion
from ...scene.fabric_range import properties
from ...scene.fabrics import Fabric
from ...scene.kinematics import deform, lbs_poses
from ...scene.riders import Rider, RiderJoints
from ..targets import JointNames
from .computed_frames import Certificate, Refinement, SolvedLatents
from .direction import Direction
from .first_frame import SEEN, faded, fitted_to, need_fitted, need_near, tell_first, with_missing
from .inputs import InputHashes
from .looped import MOST_ROUNDS, Loop, LoopedPoses, looped, seam_words, summary
from .motion_warnings import warn_of_jumps, warn_of_shapes
from .network_roll import NetworkRoll
from .request import BakeRequest
from .result import FrameSpan, LoopSummary
from .shot_samples import ShotSamples
from .start import StartCloth
from .world import ShotSurroundings, Sight

if TYPE_CHECKING:
    from ssilk_usd.opening.garment_api import GarmentRecord
    from ssilk_usd.reading.frame_range import FrameRange
    from ssilk_usd.units import StageUnits
    from ssilk_usd.writing.asset_info import AssetInfo

    from ...network.latent_solver import LatentRoller
    from ...network.model.network import GarmentModel
    from ...network.start import GivenStart


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
        given: the network's state there, once `begun` has found it.
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
    given: GivenStart | None = None
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

    @cached_property
    def samples(self) -> ShotSamples:
        """The shot's samples as frames of `source`."""
        skeleton = self.deformer.scene.character.skeleton
        return ShotSamples(self.motion, self.source, skeleton, self.lead, self.loop)

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
        for pose in self._network.poses(self.lead, self.lead + self.motion.frame_count, roller, self.recovered):
            yield faded(pose, self.motion.fps, self.direction) if self.is_fading else pose

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
        course = self._network.poses(0, loop.samples, roller, lost)
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

    @cached_property
    def _network(self) -> NetworkRoll:
        assert self.model is not None
        count = self.model.decoder.shape_count + int(self.model.decoder.has_constant)
        deformer = replace(self._unrefined, shapes=self._unrefined.shapes[:count])
        return NetworkRoll(
            self.model, deformer, self.samples, self.request.pre_roll, self.given, self.direction, self.held_off
        )

    @property
    def _unrefined(self) -> Deformer:
        """The garment that the network's poses are of, where refined frames have blendshapes of their own."""
        return self.deformer if self.refinement is None else self.refinement.before

    def latent_roller(self, advanced: Callable[[], object] = lambda: None) -> LatentRoller:
        """Return what solves for the network's states in latents; `advanced` is called after each frame."""
        from ...network.latent_solver import LatentOptions, LatentRoller

        assert self.model is not None
        request = self.request
        options = LatentOptions(iterations=request.latent_iterations, sampled=request.samples_elements)
        return LatentRoller(self.model, self.fabric, options, pre_roll=self.request.pre_roll, advanced=advanced)

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
        cloth, scene = self.start_cloth, self.deformer.scene
        if cloth is None or self.model is None:
            return self
        need_near(cloth, scene, self.motion, self.direction)
        given = fitted_to(cloth, self.model, self.samples)
        need_fitted(cloth, given, scene)
        begun = replace(self, given=given)
        if given.left[1] <= SEEN:
            return begun
        pose = next(begun._network.poses(0, self.motion.frame_count, None, [])).part(slice(0, 1))
        return replace(begun, deformer=with_missing(self.deformer, self.motion, pose, cloth), is_fading=True)

    def with_lead(self) -> BakeRollout:
        """Return the rollout of the shot together with the samples before it."""
        return replace(self, motion=self.whole, lead=0, latents=None, recovered=[])

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
            own, moved = self.certificate.deformer, self.certificate.moved
            before = replace(self, deformer=own, certificate=None)
            found = before.decode(replace(pose, weights=pose.weights[:, : own.shape_count]))
            return self._deformed(found, pose, [at for at in range(pose.frame_count) if pose.start + at in moved])
        if self.refinement is not None and not self.request.writes_points:
            return deform(self.deformer, self.motion, pose)
        found = self._network_decoded(pose)
        return self._deformed(found, pose, np.flatnonzero(pose.weights[:, -1])) if self.is_fading else found

    def _deformed(self, found: Floats, pose: GarmentPose, frames: Iterable[int]) -> Floats:
        """Return vertices of poses with those of some of them as the shot deforms them, and the others as `found`."""
        for frame in frames:
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
        name = self.request.motion
        if self.start_cloth is not None and self.given is not None:
            tell_first(self.start_cloth, self.given, self.is_fading, name, report)
        if self.frames is None:
            return
        if self.frames.left_out:
            report(Message(f"{name}: {self.frames.left_out}", "warning"))
        if self.frames.chosen or self.request.handles:
            report(Message(f"{name}: {self.frames}"))

    def warn(self, report: Reporter) -> None:
        """Report where the motion jumps, and at which frames the rollout was lost."""
        from ssilk_usd.reading.shown import tell_shown_otherwise

        character, request, samples = self.deformer.scene.character, self.request, self.samples
        first, last = samples.source_frame(0), samples.source_frame(self.motion.frame_count - 1)
        shown = self.source.clip(int(first), int(np.ceil(last)) + 1)
        warn_of_jumps(shown, character.skeleton, request, self.motion.fps, report)
        garment = self.deformer.scene.garment.mesh.path.rpartition("/")[2]
        tell_shown_otherwise(request.stage, [self.source.path], report, root=request.root, garment=garment)
        warn_of_shapes(character, self.motion, request, report)
        if self.held_off:
            off = 1000 * float(np.sqrt(np.mean(np.square(self.held_off))))
            text = f"{len(self.held_off)} poses are held or let go; proxies hold the garment within"
            report(Message(f"{request.motion}: {text} {off:.2g} mm (RMS) of linear blend skinning"))
        if self.loop_summary and (words := seam_words(self.loop_summary)):
            report(Message(f"{request.motion}: {words}", "warning"))
        for span in self.recovered:
            report(Message(f"frames {span}: the rollout was lost, and the garment is put to rest", "warning"))
