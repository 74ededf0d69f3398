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
from .network import GarmentModel

OPSET = 18
INPUTS = ("before", "now", "static", "rates", "begins")
OUTPUTS = ("state", "weights", "rotations", "translations")  # the last only where proxies move


class FrameNetwork(nn.Module):
    """The network for one frame of N characters, without skinning, which engines do themselves."""

    to_parent: Tensor
    bind_rotations: Tensor
    places: Tensor

    def __init__(self, model: GarmentModel) -> None:
        super().__init__()
        self.model = model
        for name, values in (
            ("to_parent", model.axes.above.swapaxes(-1, -2)),
            ("bind_rotations", model.axes.own),
            ("places", model.axes.places),
        ):
            self.register_buffer(name, torch.tensor(values).float())

    def forward(
        self, before: Tensor, now: Tensor, static: Tensor, rates: Tensor, begins: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the new latents (N, latent), shape weights (N, K + 1) and local proxy rotations (N, P, 3, 3).

        Where proxies move, return their local translations [m], too (N, P, 3).

        Args:
            before, now: the two latents before this frame, (N, latent).
            static: static descriptors, gravity in each joint's frame included (N, S); rates: dynamic ones (N, R).
            begins: whether the garment is at rest in this frame, as in the first two frames of a shot (N, 1), bool.
        """
        model = self.model
        rest = model.initial(static)
        z = torch.where(begins, rest, model.step(before, now, rest, torch.cat([static, rates], dim=1)))
        activation, transforms = model.pose(z)
        weights = (activation.T + 1) / 2
        if model.decoder.has_constant:
            weights = torch.cat([weights, torch.ones_like(z[:, :1])], dim=1)
        # Without proxies, engines refuse to load the reshaping of empty tensors.
        by_frame = transforms.permute(3, 0, 1, 2) if len(self.bind_rotations) else z.new_zeros(z.shape[0], 0, 3, 4)
        local = self.to_parent @ by_frame[..., :3] @ self.bind_rotations
        if not model.config.translations:
            return z, weights.clamp(0, 1), local
        return z, weights.clamp(0, 1), local, self.places + (self.to_parent @ by_frame[..., 3:])[..., 0]


def export_onnx(model: GarmentModel, path: str | Path) -> None:
    """Write the network as ONNX, atomically; the first dimension is a batch of any size."""
    network, config = FrameNetwork(model).eval(), model.config
    static, rates = descriptor_sizes(model.scene, model.joints)
    sizes = (config.latent, config.latent, static, rates)
    frame = (*(torch.zeros(3, size) for size in sizes), torch.zeros(3, 1, dtype=torch.bool))
    characters = torch.export.Dim("characters", min=1)
    shapes = {name: {0: characters} for name in INPUTS}
    outputs = OUTPUTS if config.translations else OUTPUTS[:-1]
    with replacing(path) as temporary, _quietly():
        program = torch.onnx.export(
            network, frame, dynamo=True, input_names=INPUTS, output_names=outputs, dynamic_shapes=shapes,
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
