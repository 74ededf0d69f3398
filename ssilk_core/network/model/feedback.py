# SPDX-License-Identifier: Apache-2.0
"""`network.feedback` in PyTorch: points of the decoded cloth as inputs of the stepper S."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ...physics.skinning import transform_points
from ...scene.assets import Floats, Ints, Scene, Skeleton
from ...scene.kinematics import skinning_matrices
from ..feedback import LIMIT, UNIT, bends, feedback_size, feedback_vertices, stopped_points
from ..settings import ModelConfig
from .decoder import Decoder, transform_of


@dataclass(frozen=True, eq=False)
class BodyFrames:
    """What the feedback needs of a character in F frames of N motions.

    Attributes:
        matrices: skinning matrices, whose positions are relative to an origin of each frame, (F, J, 3, 4, N).
        bend: second difference o_t - 2 o_{t-1} + o_{t-2} of these origins [m], (F, 3, N); unused in the first two.
        planes: of the colliders at the first C points: directions away n, then c [m], so that a point x about the
            origin is c - n . x below, (F, C, 4, N); None where there are none.
    """

    matrices: Tensor
    bend: Tensor
    planes: Tensor | None = None

    def triples(self) -> BodyFrames:
        """Return the two frames before each frame from the third on, and itself, F = 3, of (F - 2) N motions.

        Their positions must be about one origin, so that bends are zero.
        """
        count = len(self.matrices) - 2

        def shifted(values: Tensor) -> Tensor:
            return torch.stack([values[at : at + count].movedim(0, -2).flatten(-2) for at in range(3)])

        planes = None if self.planes is None else shifted(self.planes)
        return BodyFrames(shifted(self.matrices), shifted(self.bend), planes)

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
        planes = None if self.planes is None else self.planes[frames]
        return BodyFrames(self.matrices[frames], self.bend[frames], planes)


@dataclass(frozen=True, eq=False)
class DecodedState:
    """A state as the feedback looks back on it.

    Attributes:
        output: of D, shape (N, outputs).
        points: that S sees [m], shape (M, 3, N).
        depth: of the first of these inside colliders, not negative [m], shape (C, N); None without any.
    """

    output: Tensor
    points: Tensor
    depth: Tensor | None = None


class PointDecoder(nn.Module):
    """Decodes a few vertices of a garment.

    Args:
        rows: the vertices (M,), none of which is pinned; decoder: of the garment.
    """

    rows: Tensor
    places: Tensor

    def __init__(self, rows: Ints, decoder: Decoder) -> None:
        super().__init__()
        self.register_buffer("rows", torch.as_tensor(rows), persistent=False)
        # Of each vertex among those that are not pinned, which alone have blendshapes.
        self.register_buffer("places", torch.searchsorted(decoder.free, self.rows), persistent=False)

    def forward(self, decoder: Decoder, output: Tensor, matrices: Tensor) -> Tensor:
        """Return positions (M, 3, N) [m] of outputs of D (N, outputs), under a character (J, 3, 4, N)."""
        activation, values = decoder.split(output)
        rest, shapes = decoder.free_rest()[self.places], decoder.shapes[self.places]
        points = rest[:, :, None] + torch.einsum("mak,kn->man", shapes, activation)
        joints = decoder.matrices(values, matrices)[decoder.used]
        weights = torch.softmax(decoder.logits[self.rows] + decoder.skin_offset[self.places], dim=1)
        affine = decoder.skin.dense(weights, self.rows) @ joints.flatten(1)
        return transform_points(affine.reshape(len(self.rows), *joints.shape[1:]), points)


class Feedback(nn.Module):
    """Decodes the points and the proxies that S sees.

    Args:
        scene: the garment; config: of the network.

    Attributes:
        size: number of features of both.
        points: those that S sees.
        stopped: how many of these colliders stop.
    """

    def __init__(self, scene: Scene, config: ModelConfig, decoder: Decoder) -> None:
        super().__init__()
        self.hub, self.size = scene.character.skeleton.hub, feedback_size(scene, config)
        self.points = PointDecoder(feedback_vertices(scene, config), decoder)
        self.stopped = stopped_points(scene, config)

    @property
    def count(self) -> int:
        """Points that S sees."""
        return len(self.points.rows)

    def decoded(self, decoder: Decoder, output: Tensor, body: BodyFrames | None) -> DecodedState:
        """Return a state by its outputs (N, outputs), under a character in one frame, which only points need."""
        if body is None or not self.count:
            return DecodedState(output, output.new_zeros(0, 3, output.shape[0]))
        points = self.points(decoder, output, body.matrices[0])
        depth = None if body.planes is None else _depth(points, body.planes[0]).clamp_min(0)
        return DecodedState(output, points, depth)

    def seen(self, decoder: Decoder, past: tuple[DecodedState, DecodedState], body: BodyFrames | None) -> Tensor:
        """Return what S sees (N, size) from the two states before a frame, the older one first.

        Args:
            body: the character in that frame alone, F = 1, which only points need.
        """
        carried = None
        if body is not None and self.count:
            before, now = past
            carried = self.points(decoder, 2 * now.output - before.output, body.matrices[0])
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
        if body.planes is not None and now.depth is not None:
            flight, planes = away + carried, body.planes[0]
            deeper = (_depth(flight, planes) - now.depth).clamp_min(0)
            away = torch.cat([away[: len(planes)] + planes[:, :3] * deeper[:, None], away[len(planes) :]])
        turn = body.matrices[0, self.hub, :, :3]  # of the root, but for a constant
        own = torch.einsum("ban,mbn->man", turn, away)
        return LIMIT * torch.tanh(own.flatten(0, 1).T / (UNIT * LIMIT))


def _depth(points: Tensor, planes: Tensor) -> Tensor:
    """Return how deep the first of points (M, 3, N) lie below planes (C, 4, N) [m], shape (C, N)."""
    return planes[:, 3] - (planes[:, :3] * points[: len(planes)]).sum(1)


def _proxies(decoder: Decoder, output: Tensor) -> Tensor:
    """Return the proxies (N, C P) of outputs of D (N, outputs), as S sees them."""
    transforms = transform_of(decoder.split(output)[1])
    columns = transforms.transpose(1, 2)  # x, y, z axis and displacement
    seen = [columns[:, :2], *([columns[:, 3:]] if decoder.proxy_outputs > 6 else [])]
    return ((torch.cat(seen, dim=1).flatten(1, 2) - decoder.identity) / decoder.scale).flatten(0, 1).T
