# SPDX-License-Identifier: Apache-2.0
"""The network as an ONNX graph for game engines: one frame in, joint rotations and weights out."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn

from ...files import replacing
from ..parameters import descriptor_sizes
from ..proximity import PLANE
from .descriptors import proximity_features, proximity_length
from .feedback import BodyFrames, DecodedState
from .network import GarmentModel

OPSET = 18
INPUTS = ("before", "now", "static", "rates", "begins")
BODY_INPUTS = ("matrices", "bend")  # where S sees points of the cloth, or the network colliders
OUTPUTS = ("state", "weights", "rotations", "translations")  # the last only where proxies move
SEEN_INPUT, SEEN_OUTPUT = "proximity", "resting"  # where the network sees colliders


class FrameNetwork(nn.Module):
    """The network for one frame of N characters, without skinning, which engines do themselves."""

    to_parent: Tensor
    bind_rotations: Tensor
    places: Tensor
    hub_bind: Tensor

    def __init__(self, model: GarmentModel) -> None:
        super().__init__()
        self.model, skeleton = model, model.scene.character.skeleton
        for name, values in (
            ("to_parent", model.axes.above.swapaxes(-1, -2)),
            ("bind_rotations", model.axes.own),
            ("places", model.axes.places),
            ("hub_bind", skeleton.bind_transforms[skeleton.hub, :3, :3]),
        ):
            self.register_buffer(name, torch.tensor(values).float())

    @property
    def state_size(self) -> int:
        """Numbers in a state: latents, and where S sees the cloth the outputs of D, the points that it sees, and how
        deep they are in colliders."""
        model, feedback = self.model, self.model.feedback
        seen = model.decoder.output_count + 3 * feedback.count + feedback.stopped
        return model.config.latent + seen * (feedback.size > 0)

    def _decoded(self, state: Tensor) -> DecodedState:
        """Return what S looks back on, from a state of this graph (N, state)."""
        latent, outputs = self.model.config.latent, self.model.decoder.output_count
        count = self.model.feedback.count
        ends = [latent, latent + outputs, latent + outputs + 3 * count]
        _, output, points, depth = state.tensor_split(ends, dim=1)
        return DecodedState(output, points.T.reshape(count, 3, state.shape[0]), depth.T)

    def _near(self, proximity: Tensor, matrices: Tensor) -> Tensor:
        """Return features (N, 3 M) of proximity (N, M, 5), under a character (J, 3, 4, N)."""
        vectors = proximity[..., :3] * proximity_length(proximity[..., 3:4])
        to_root = (matrices[self.model.feedback.hub, :, :3].permute(2, 0, 1) @ self.hub_bind).mT
        return proximity_features(vectors, to_root)

    def _step(self, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor, body: BodyFrames | None) -> Tensor:
        model, latent = self.model, self.model.config.latent
        past = (self._decoded(before), self._decoded(now)) if model.feedback.size else None
        seen = rest[:, :0] if past is None else model.feedback.seen(model.decoder, past, body)
        return model.step(before[:, :latent], now[:, :latent], rest, pose, seen)

    def forward(
        self,
        before: Tensor,
        now: Tensor,
        static: Tensor,
        rates: Tensor,
        begins: Tensor,
        matrices: Tensor | None = None,
        bend: Tensor | None = None,
        proximity: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the new state (N, state), shape weights (N, K + 1) and local proxy rotations (N, P, 3, 3).

        Where proxies move, return their local translations [m], too (N, P, 3). Where the network sees colliders,
        return the points from which they are seen [m], about the root (N, M, 3).

        Args:
            before, now: the two states before this frame, (N, state).
            static: static descriptors, gravity in each joint's frame included and proximity not (N, S).
            rates: dynamic ones (N, R).
            begins: whether the garment is at rest in this frame, as in the first two frames of a shot (N, 1), bool.
            matrices: skinning matrices of the character's joints about the root (N, J, 3, 4), where S sees points,
                or the network colliders.
            bend: likewise the second difference of the root's position, r_t - 2 r_{t-1} + r_{t-2} (N, 3) [m].
            proximity: to colliders, as `Motion` has it, where the network sees them (N, M, 5).
        """
        model, body, places = self.model, None, []
        if matrices is not None and bend is not None:
            own, planes = matrices.permute(1, 2, 3, 0), None
            if proximity is not None:
                places = [model.resting(static, own).permute(2, 0, 1)]
                static = torch.cat([self._near(proximity, own), static], dim=1)
                if model.feedback.stopped:
                    planes = proximity[:, : model.feedback.stopped, PLANE].permute(1, 2, 0)[None]
            body = BodyFrames(own[None], bend.T[None], planes)
        rest = model.initial(static)
        z = torch.where(begins, rest, self._step(before, now, rest, torch.cat([static, rates], dim=1), body))
        output = model.output(z)
        activation, transforms = model.decoder.activations(output)
        state = z
        if model.feedback.size:
            seen = model.feedback.decoded(model.decoder, output, body)
            depth = [] if seen.depth is None else [seen.depth.T]
            state = torch.cat([z, output, seen.points.flatten(0, 1).T, *depth], dim=1)
        weights = (activation.T / model.config.activation_range + 1) / 2
        if model.decoder.has_constant:
            weights = torch.cat([weights, torch.ones_like(z[:, :1])], dim=1)
        # Without proxies, engines refuse to load the reshaping of empty tensors.
        by_frame = transforms.permute(3, 0, 1, 2) if len(self.bind_rotations) else z.new_zeros(z.shape[0], 0, 3, 4)
        local = self.to_parent @ by_frame[..., :3] @ self.bind_rotations
        if not model.config.translations:
            return state, weights.clamp(0, 1), local, *places
        moved = self.places + (self.to_parent @ by_frame[..., 3:])[..., 0]
        return state, weights.clamp(0, 1), local, moved, *places


def export_onnx(model: GarmentModel, path: str | Path) -> None:
    """Write the network as ONNX, atomically; the first dimension is a batch of any size."""
    network, config = FrameNetwork(model).eval(), model.config
    static, rates = descriptor_sizes(model.scene, model.joints, config)
    sizes = (network.state_size, network.state_size, static - model.proximity, rates)
    frame = (*(torch.zeros(5, size) for size in sizes), torch.zeros(5, 1, dtype=torch.bool))
    inputs: tuple[str, ...] = INPUTS
    seen = len(model.sight.rows)
    if model.feedback.count or seen:
        joints = model.scene.character.skeleton.joint_count
        frame, inputs = (*frame, torch.zeros(5, joints, 3, 4), torch.zeros(5, 3)), INPUTS + BODY_INPUTS
    if seen:
        frame, inputs = (*frame, torch.zeros(5, seen, 5)), (*inputs, SEEN_INPUT)
    characters = torch.export.Dim("characters", min=1)
    shapes = {name: {0: characters} for name in inputs}
    outputs = (OUTPUTS if config.translations else OUTPUTS[:-1]) + (SEEN_OUTPUT,) * (seen > 0)
    with replacing(path) as temporary, _quietly():
        program = torch.onnx.export(
            network, frame, dynamo=True, input_names=inputs, output_names=outputs, dynamic_shapes=shapes,
            opset_version=OPSET, verbose=False,
        )  # fmt: skip
        assert program is not None  # only the older exporter returns None
        program.save(temporary, external_data=False)


@contextmanager
def _quietly() -> Iterator[None]:
    """Suppress the exporter's messages about its internals."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
