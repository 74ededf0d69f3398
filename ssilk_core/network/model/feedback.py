# SPDX-License-Identifier: Apache-2.0
"""`network.feedback` in PyTorch: points of the decoded cloth as inputs of the stepper S."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ...physics.skinning import transform_points
from ...scene.assets import Floats, Scene, Skeleton
from ...scene.kinematics import skinning_matrices
from ..feedback import LIMIT, UNIT, bends, feedback_size, feedback_vertices
from ..settings import ModelConfig
from .decoder import Decoder, transform_of


@dataclass(frozen=True, eq=False)
class BodyFrames:
    """What the feedback needs of a character in F frames of N motions.

    Attributes:
        matrices: skinning matrices, whose positions are relative to an origin of each frame, (F, J, 3, 4, N).
        bend: second difference o_t - 2 o_{t-1} + o_{t-2} of these origins [m], (F, 3, N); unused in the first two.
    """

    matrices: Tensor
    bend: Tensor

    @classmethod
    def of(cls, world: Floats, skeleton: Skeleton, like: Tensor) -> BodyFrames:
        """Return one motion's frames from joint-to-world transforms (F, J, 4, 4), each about its own root.

        Differences of roots are taken in double precision, so that single precision serves anywhere in the world.
        """
        origins, world = world[:, skeleton.hub, :3, 3].copy(), world.copy()
        world[..., :3, 3] -= origins[:, None]
        matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
        return cls(torch.as_tensor(matrices).to(like)[..., None], torch.as_tensor(bends(origins)).to(like)[..., None])

    def __getitem__(self, frames: slice) -> BodyFrames:
        return BodyFrames(self.matrices[frames], self.bend[frames])


@dataclass(frozen=True, eq=False)
class DecodedState:
    """A state as the feedback looks back on it: outputs of D (N, outputs), and points (M, 3, N) [m]."""

    output: Tensor
    points: Tensor


class Feedback(nn.Module):
    """Decodes the points and the proxies that S sees.

    Args:
        scene: the garment; config: of the network.

    Attributes:
        size: number of features of both.
    """

    rows: Tensor
    places: Tensor

    def __init__(self, scene: Scene, config: ModelConfig, decoder: Decoder) -> None:
        super().__init__()
        self.hub = scene.character.skeleton.hub
        self.size, rows = feedback_size(scene, config), torch.as_tensor(feedback_vertices(scene, config))
        self.register_buffer("rows", rows, persistent=False)
        # Of each chosen vertex among those that are not pinned, which alone have blendshapes.
        self.register_buffer("places", torch.searchsorted(decoder.free, rows), persistent=False)

    @property
    def count(self) -> int:
        """Points that S sees."""
        return len(self.rows)

    def decoded(self, decoder: Decoder, output: Tensor, matrices: Tensor | None) -> DecodedState:
        """Return a state by its outputs (N, outputs), under a character (J, 3, 4, N), which only points need."""
        if matrices is None or not self.count:
            return DecodedState(output, output.new_zeros(0, 3, output.shape[0]))
        activation, values = decoder.split(output)
        rest, shapes = decoder.free_rest()[self.places], decoder.shapes[self.places]
        points = rest[:, :, None] + torch.einsum("mak,kn->man", shapes, activation)
        joints = decoder.matrices(values, matrices)[decoder.used]
        weights = torch.softmax(decoder.logits[self.rows] + decoder.skin_offset[self.places], dim=1)
        affine = decoder.skin.dense(weights, self.rows) @ joints.flatten(1)
        return DecodedState(output, transform_points(affine.reshape(self.count, *joints.shape[1:]), points))

    def seen(self, decoder: Decoder, past: tuple[DecodedState, DecodedState], body: BodyFrames | None) -> Tensor:
        """Return what S sees (N, size) from the two states before a frame, the older one first.

        Args:
            body: the character in that frame alone, F = 1, which only points need.
        """
        carried = None
        if body is not None and self.count:
            before, now = past
            carried = self.decoded(decoder, 2 * now.output - before.output, body.matrices[0]).points
        return self.features(decoder, past, carried, body)

    def features(
        self,
        decoder: Decoder,
        past: tuple[DecodedState, DecodedState],
        carried: Tensor | None,
        body: BodyFrames | None,
    ) -> Tensor:
        """Return the result of `seen`.

        Args:
            carried: points (M, 3, N) of the outputs on the course of both states, in the frame of `body`.
        """
        points = [] if carried is None or body is None else [self._points_seen(past, carried, body)]
        proxies = [_proxies(decoder, state.output) for state in past] if self.size > 3 * self.count else []
        return torch.cat([*points, *proxies], dim=1)

    def _points_seen(self, past: tuple[DecodedState, DecodedState], carried: Tensor, body: BodyFrames) -> Tensor:
        before, now = past
        away = 2 * now.points - before.points - carried - body.bend[0]
        turn = body.matrices[0, self.hub, :, :3]  # of the root, but for a constant
        own = torch.einsum("ban,mbn->man", turn, away)
        return LIMIT * torch.tanh(own.flatten(0, 1).T / (UNIT * LIMIT))


def _proxies(decoder: Decoder, output: Tensor) -> Tensor:
    """Return the proxies (N, C P) of outputs of D (N, outputs), as S sees them."""
    transforms = transform_of(decoder.split(output)[1])
    columns = transforms.transpose(1, 2)  # x, y, z axis and displacement
    seen = [columns[:, :2], *([columns[:, 3:]] if decoder.proxy_outputs > 6 else [])]
    return ((torch.cat(seen, dim=1).flatten(1, 2) - decoder.identity) / decoder.scale).flatten(0, 1).T
