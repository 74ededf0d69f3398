# SPDX-License-Identifier: Apache-2.0
"""Shots solved in latents, frame by frame, several at once; frame by frame they follow from the two before.

The first frame of a shot is quasi-static, as the simulator's is: the garment hangs still in the first pose. The
second one has the velocity of linear blend skinning. A state that is lost, with an energy that is not finite, is
replaced by the network's quasi-static one for `RECOVERY_FRAMES` frames; the shot then goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...physics.simulate import SimulationOptions, Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.simulator import StepHistory
from ...scene.assets import Motion
from ...scene.fabrics import Fabric
from ..descriptors import pose_features
from ..model.descriptors import upright_descriptors
from ..model.feedback import BodyFrames
from ..model.network import GarmentModel
from ..settings import DIVERGENCE_BOUND, RECOVERY_FRAMES
from .options import LatentOptions
from .solver import LatentSolution, LatentSolver
from .warm_start import FrameDescriptors, warm_starts

LOOK_BACK = 2  # earlier frames that descriptors need
DESCRIBED = 256  # frames described at once


@dataclass(frozen=True, eq=False)
class LatentFrame:
    """One frame of N shots.

    Attributes:
        number: of the frame.
        solution: of each shot; where it was lost, the state that replaces it.
        lost: whose state was lost, shape (N,).
    """

    number: int
    solution: LatentSolution
    lost: Tensor


@dataclass(frozen=True, eq=False)
class _Past:
    """The previous states of N shots.

    Attributes:
        before, now: latents two frames and one frame ago, shape (N, m).
        cloth: positions.
        matrices: skinning matrices of the character in both frames, about its root, shape (2, J, 3, 4, N).
        roots: its positions there [m], float64, shape (2, 3, N).
        recovering: frames for which a lost shot still rests, shape (N,).
    """

    before: Tensor
    now: Tensor
    cloth: StepHistory
    matrices: Tensor
    roots: Tensor
    recovering: Tensor

    def first(self, count: int) -> _Past:
        """Return those of the first shots."""
        own = self.before[:count], self.now[:count], self.cloth.first(count)
        return _Past(*own, self.matrices[..., :count], self.roots[..., :count], self.recovering[:count])

    def followed_by(self, poses: PosedCharacters) -> BodyFrames:
        """Return the character in both frames and in the next one."""
        bend = poses.root - 2 * self.roots[1] + self.roots[0]
        return BodyFrames(torch.cat([self.matrices, poses.matrices[None]]), bend.expand(3, -1, -1))


class LatentShots:
    """Solves shots of one garment in its model's latents.

    Args:
        model: on the device to use.
        fabric: of the garment.
        precision: "float32" or "float64", of everything but the network.
    """

    def __init__(
        self, model: GarmentModel, fabric: Fabric, options: LatentOptions, *, precision: str = "float32"
    ) -> None:
        self.model, self.options, self.fps = model, options, model.config.fps
        device = next(model.parameters()).device
        self.simulator = Simulator(
            model.scene, fabric, SimulationOptions(fps=self.fps, precision=precision), device=device
        )
        self.solver = LatentSolver(model, self.simulator.potential, options)

    @torch.no_grad()
    def frames(self, motions: Sequence[Motion]) -> Iterator[LatentFrame]:
        """Yield the frames of motions without cuts, at the model's rate, all motions at once.

        Args:
            motions: of decreasing length; a frame holds those that have not ended.

        Raises:
            SsilkError: a motion is not at the model's rate.
        """
        for motion in motions:
            if not abs(motion.fps - self.fps) < 1e-6:
                fail(motion.path, f"{motion.fps:g} frames per second", f"the model steps at {self.fps:g}")
        lengths = [motion.frame_count for motion in motions]
        if lengths != sorted(lengths, reverse=True):
            fail("latent solver", "motions of increasing length", "the longest must come first")
        past: _Past | None = None
        for number, seen in enumerate(self._descriptors(motions)):
            running = motions[: len(seen.rest)]
            at = slice(number, number + 1)
            poses = self.simulator.poser.pose(*(
                np.concatenate([getattr(motion, name)[at] for motion in running])
                for name in ("rotations", "translations")
            ))  # fmt: skip
            past = past and past.first(len(running))
            frame, past = self._advance(number, past, poses, seen)
            yield frame

    def _descriptors(self, motions: Sequence[Motion]) -> Iterator[FrameDescriptors]:
        """Yield what the network sees in each frame of the motions that have not ended."""
        for start in range(0, motions[0].frame_count, DESCRIBED):
            stop = start + DESCRIBED
            parts = [self._described(motion, start, stop) for motion in motions if motion.frame_count > start]
            for frame in range(len(parts[0].rest)):
                running = [part for part in parts if len(part.rest) > frame]
                yield FrameDescriptors(
                    torch.stack([part.rest[frame] for part in running]),
                    torch.stack([part.pose[frame] for part in running]),
                )

    def _described(self, motion: Motion, start: int, stop: int) -> FrameDescriptors:
        """Return what the network sees in consecutive frames of a motion."""
        model, parameter = self.model, next(self.model.parameters())
        seen = motion.clip(max(0, start - LOOK_BACK), stop)
        count = min(stop, motion.frame_count) - start
        skeleton, kind = model.scene.character.skeleton, model.config.descriptors
        features = pose_features(seen, skeleton, model.joints, kind=kind)
        static, dynamic = (values[-count:] for values in upright_descriptors(features, parameter))
        rest = model.initial(static)
        sound = rest.abs().amax(dim=1, keepdim=True) < DIVERGENCE_BOUND  # NaN is not less than anything
        rest = torch.where(sound, rest, torch.zeros_like(rest))
        return FrameDescriptors(rest, dynamic)

    def _advance(
        self, number: int, past: _Past | None, poses: PosedCharacters, seen: FrameDescriptors
    ) -> tuple[LatentFrame, _Past]:
        """Return a frame, and the states for the next one."""
        rest = seen.rest.to(self.solver.potential.dtype)
        inputs = self.simulator.inputs(poses, past.cloth if past else None)
        if past is None:
            starts, iterations = [rest], self.options.first_iterations
        else:
            body = past.followed_by(poses)
            starts, iterations = warm_starts(self.model, past.before, past.now, seen, body), None
        found = self.solver.solve(starts, poses.matrices, inputs, iterations)
        lost = ~(found.energy.isfinite() & found.z.isfinite().all(1))
        recovering = torch.zeros_like(found.iterations) if past is None else past.recovering
        recovering = torch.where(lost, RECOVERY_FRAMES, recovering)
        lost = recovering > 0
        if bool(lost.any()):
            found = found.where(lost, self.solver.given(rest, poses.matrices, inputs))
        cloth = StepHistory(found.x.double() + poses.root, past.cloth.last if past else None, poses.root, poses.lbs)
        before, earlier, root = found.z, poses.matrices, poses.root
        if past:
            before, earlier, root = past.now, past.matrices[1], past.roots[1]
        course = torch.stack([earlier, poses.matrices]), torch.stack([root, poses.root])
        return LatentFrame(number, found, lost), _Past(before, found.z, cloth, *course, (recovering - 1).clamp_min(0))
