# SPDX-License-Identifier: Apache-2.0
"""`network.feedback` in PyTorch: points of the decoded cloth as inputs of the stepper S."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ...physics.skinning import Skinning, transform_points
from ...scene.assets import Floats, Motion, Scene, Skeleton, SkinWeights
from ...scene.kinematics import skinning_matrices
from ..feedback import LIMIT, UNIT, bends, feedback_size, feedback_vertices, stopped_points
from ..proximity import proximity_reach
from ..settings import ModelConfig
from .decoder import Decoder, transform_of
from .descriptors import nearest_planes


@dataclass(frozen=True, eq=False)
class BodyFrames:
    """What the feedback needs of a character in F frames of N motions.

    Attributes:
        matrices: skinning matrices, whose positions are relative to an origin of each frame, (F, J, 3, 4, N).
        bend: second difference o_t - 2 o_{t-1} + o_{t-2} of these origins [m], (F, 3, N); unused in the first two.
        planes: colliders that stop points, as `Feedback.planes` returns them; None where there are none.
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


class Feedback(nn.Module):
    """Decodes the points and the proxies that S sees.

    Args:
        scene: the garment; config: of the network.

    Attributes:
        size: number of features of both.
    """

    rows: Tensor
    places: Tensor
    carried: Tensor

    def __init__(self, scene: Scene, config: ModelConfig, decoder: Decoder) -> None:
        super().__init__()
        self.hub = scene.character.skeleton.hub
        self.size, rows = feedback_size(scene, config), torch.as_tensor(feedback_vertices(scene, config))
        self.register_buffer("rows", rows, persistent=False)
        # Of each chosen vertex among those that are not pinned, which alone have blendshapes.
        self.register_buffer("places", torch.searchsorted(decoder.free, rows), persistent=False)
        skin, own = scene.lbs_skin, rows[: stopped_points(scene, config)].numpy()
        self.lbs = Skinning(SkinWeights(skin.path, skin.indices[own], skin.weights[own]))
        self.reach = proximity_reach(scene)
        carried = torch.tensor(scene.garment.mesh.points[own], dtype=torch.float32)
        self.register_buffer("carried", carried, persistent=False)

    @property
    def count(self) -> int:
        """Points that S sees."""
        return len(self.rows)

    def planes(self, distance: Tensor, away: Tensor, matrices: Tensor) -> Tensor:
        """Return the planes (C, 4, N) of the nearest colliders in N frames: normals n, then offsets c [m].

        A point x about the frame's origin lies c - n . x below its plane.

        Args:
            distance: of the points that colliders stop, as the body carries them [m], shape (C, N).
            away: directions away from the colliders, zero where there are none, shape (C, 3, N).
            matrices: of the character, shape (J, 3, 4, N).
        """
        points = self.lbs(self.carried, None, self.lbs.weights, matrices)
        return torch.cat([away, ((away * points).sum(1) - distance.clamp_min(-self.reach / 2))[:, None]], dim=1)

    def among(self, body: BodyFrames, distance: Tensor, away: Tensor) -> BodyFrames:
        """Return F frames of N motions among colliders.

        Args:
            distance: of the first points, as the body carries them, frame after frame [m], shape (P, F N), P >= C.
            away: likewise directions away from the colliders, shape (P, 3, F N).
        """
        frames, count = len(body.matrices), len(self.carried)
        matrices = body.matrices.movedim(0, -2).flatten(-2)
        planes = self.planes(distance[:count], away[:count], matrices).unflatten(-1, (frames, -1))
        return replace(body, planes=planes.movedim(-2, 0))

    def beside(self, body: BodyFrames, motion: Motion) -> BodyFrames:
        """Return the frames of one motion among the colliders that it is near to."""
        count = len(self.carried)
        if motion.proximity is None or not count:
            return body
        vectors = torch.tensor(motion.proximity[:, :count])
        away, distance = (values.to(body.matrices) for values in nearest_planes(vectors, self.reach))
        return self.among(body, distance.T, away.permute(1, 2, 0))

    def decoded(self, decoder: Decoder, output: Tensor, body: BodyFrames | None) -> DecodedState:
        """Return a state by its outputs (N, outputs), under a character in one frame, which only points need."""
        if body is None or not self.count:
            return DecodedState(output, output.new_zeros(0, 3, output.shape[0]))
        points = self.placed(decoder, output, body.matrices[0])
        depth = None if body.planes is None else _depth(points, body.planes[0]).clamp_min(0)
        return DecodedState(output, points, depth)

    def placed(self, decoder: Decoder, output: Tensor, matrices: Tensor) -> Tensor:
        """Return the points (M, 3, N) [m] of outputs (N, outputs), under a character (J, 3, 4, N)."""
        activation, values = decoder.split(output)
        rest, shapes = decoder.free_rest()[self.places], decoder.shapes[self.places]
        points = rest[:, :, None] + torch.einsum("mak,kn->man", shapes, activation)
        joints = decoder.matrices(values, matrices)[decoder.used]
        weights = torch.softmax(decoder.logits[self.rows] + decoder.skin_offset[self.places], dim=1)
        affine = decoder.skin.dense(weights, self.rows) @ joints.flatten(1)
        return transform_points(affine.reshape(self.count, *joints.shape[1:]), points)

    def seen(self, decoder: Decoder, past: tuple[DecodedState, DecodedState], body: BodyFrames | None) -> Tensor:
        """Return what S sees (N, size) from the two states before a frame, the older one first.

        Args:
            body: the character in that frame alone, F = 1, which only points need.
        """
        carried = None
        if body is not None and self.count:
            before, now = past
            carried = self.placed(decoder, 2 * now.output - before.output, body.matrices[0])
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
