# SPDX-License-Identifier: Apache-2.0
"""Many shots of one garment, one frame of all of them per call; on a GPU the call replays a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...errors import fail
from ...scene.assets import Motion
from ...scene.kinematics import motion_transforms, split_at_cuts
from ..descriptors import pose_features
from .descriptors import motion_descriptors
from .feedback import BodyFrames, DecodedState
from .network import GarmentModel

REST_FRAMES = 2  # frames at rest at the start of a shot and after a cut
GRAPH_WARMUP_CALLS = 3  # before a graph is captured


@dataclass(frozen=True, eq=False)
class MotionInputs:
    """Inputs of the model from N motions of F frames.

    Attributes:
        rest: quasi-static latents, shape (F, N, latent); pose: dynamic descriptors, shape (F, N, D).
        character: skinning matrices relative to each root, shape (F, J, 3, 4, N).
        bend: second differences of the roots' positions [m], shape (F, 3, N), as `feedback.BodyFrames` has them.
        planes: likewise of colliders, shape (F, C, 4, N); none (C = 0) where no shot has any.
        origins: positions of the roots [m], shape (F, 3, N), float64.
        begins: first frames of a shot and after a cut, in which the garment is at rest, shape (F, N, 1).
    """

    rest: Tensor
    pose: Tensor
    character: Tensor
    bend: Tensor
    planes: Tensor
    origins: Tensor
    begins: Tensor


@torch.no_grad()
def motion_inputs(model: GarmentModel, motions: Sequence[Motion]) -> MotionInputs:
    """Return the inputs from motions, on the model's device; shorter motions hold their last pose.

    Raises:
        SsilkError: a motion is not at the model's rate.
    """
    fps, frames = model.config.fps, max(motion.frame_count for motion in motions)
    for motion in motions:
        if not abs(motion.fps - fps) < 1e-6:
            fail(motion.path, f"{motion.fps:g} frames per second", f"the model steps at {fps:g}")
    skeleton = model.scene.character.skeleton
    met = any(motion.proximity is not None for motion in motions)
    shots = [[_span_inputs(model, span, met) for span in split_at_cuts(motion, skeleton)] for motion in motions]
    parts = [map(torch.cat, zip(*spans)) for spans in shots]
    return MotionInputs(*(
        torch.stack([part[[*range(len(part)), *[-1] * (frames - len(part))]] for part in group], dim=axis)
        for group, axis in zip(zip(*parts), (1, 1, -1, -1, -1, -1, 1))
    ))  # fmt: skip


def _span_inputs(model: GarmentModel, motion: Motion, met: bool) -> tuple[Tensor, ...]:
    """Return the tensors of `MotionInputs` for one motion without cuts, frames first.

    Args:
        met: whether any shot has colliders.
    """
    skeleton, parameter = model.scene.character.skeleton, next(model.parameters())
    world = motion_transforms(motion, skeleton.parents)
    features = pose_features(motion, skeleton, model.joints, world, model.config.descriptors)
    body = model.body_frames(motion, world)
    static, pose = motion_descriptors(features, parameter)
    begins = torch.arange(motion.frame_count, device=parameter.device)[:, None] < REST_FRAMES
    origins = torch.as_tensor(world[:, skeleton.hub, :3, 3].copy()).to(parameter.device)
    planes = body.planes
    if planes is None:
        planes = parameter.new_zeros(motion.frame_count, met * model.feedback.stopped, 4, 1)
    return (
        model.initial(static),
        model.completed(pose, model.described),
        body.matrices[..., 0],
        body.bend[..., 0],
        planes[..., 0],
        origins,
        begins,
    )


class BatchPlayer:
    """Advances one garment in N shots by one frame per call.

    Args:
        model: on the device to use.
        like: inputs of N shots, for their shapes.
        vertices: whether to decode to vertices; otherwise a step returns the output of the decoder's network.
    """

    def __init__(self, model: GarmentModel, like: MotionInputs, *, vertices: bool = True) -> None:
        self.model, self.vertices = model, vertices
        self.rest, self.pose, self.character = like.rest[0].clone(), like.pose[0].clone(), like.character[0].clone()
        self.bend, self.planes = like.bend[0].clone(), like.planes[0].clone()
        self.before, self.now = self.rest.clone(), self.rest.clone()
        with torch.no_grad():  # of the last two frames
            self.past = [model.decoded(self.rest, self._body()) for _ in range(2)] if model.feedback.size else []
        self.begins = torch.ones_like(like.begins[0])
        self.network = torch.compile(self._network, dynamic=False) if self.rest.is_cuda else self._network
        self.advance = self._capture_graph() if self.rest.is_cuda else self._advance

    def play(self, shots: MotionInputs) -> Iterator[Tensor]:
        """Yield vertices relative to each root (V, 3, N) [m], or network output (N, K + 6 P), frame by frame.

        On a GPU each result is overwritten by the next one.
        """
        for frame in range(len(shots.rest)):
            yield self.step(shots, frame)

    @torch.no_grad()
    def step(self, shots: MotionInputs, frame: int) -> Tensor:
        """Return the result of `play` for a frame; frames must be requested in order."""
        for name in ("rest", "pose", "character", "bend", "planes", "begins"):
            getattr(self, name).copy_(getattr(shots, name)[frame])
        return self.advance()

    def _body(self) -> BodyFrames:
        planes = self.planes[None] if len(self.planes) else None
        return BodyFrames(self.character[None], self.bend[None], planes)

    def _network(self) -> tuple[Tensor, Tensor, DecodedState | None]:
        model, past, body = self.model, self.past, self._body()
        seen = model.seen((past[0], past[1]) if past else None, body)
        z = model.step(self.before, self.now, self.rest, self.pose, seen)
        z = torch.where(self.begins, self.rest, z)
        output = model.output(z)
        return z, output, model.feedback.decoded(model.decoder, output, body) if past else None

    def _advance(self) -> Tensor:
        z, output, decoded = self.network()
        self.before.copy_(self.now)
        self.now.copy_(z)
        if decoded is not None:
            for into, state in zip(self.past, (self.past[1], decoded)):
                into.output.copy_(state.output)
                into.points.copy_(state.points)
                if into.depth is not None and state.depth is not None:
                    into.depth.copy_(state.depth)
        return self.model.decoder.vertices(output, self.character) if self.vertices else output

    @torch.no_grad()
    def _capture_graph(self) -> Callable[[], Tensor]:
        """Capture a step as a CUDA graph; return a function that replays it."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(GRAPH_WARMUP_CALLS):
                self._advance()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = self._advance()

        def replay() -> Tensor:
            graph.replay()
            return result

        return replay
