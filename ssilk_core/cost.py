# SPDX-License-Identifier: Apache-2.0
"""The cost model: what a trained garment takes in time, operations, memory and on disk.

Times are measured on this machine. All other costs follow from sizes. Each frame costs, in multiply-adds,

    P, S, D         the weights of the networks; retraining alone changes P, S and all but D's last layer
    readout         shapes * activations, in reduced models
    blendshapes     3 V shapes
    skinning        12 V influences to blend matrices, 9 V to apply them

The share of blendshapes and influences grows with the vertices of the mesh, and that of the networks falls.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .assets import Motion
from .checkpoint import ModelFile, save_model
from .runtime import Player
from .runtime.playback import BLOCK

POINT_BYTES = 12  # bytes of a vertex in a point cache
TILE_PARAMETERS = ("decoder.shapes", "decoder.skin_offset")  # the runtime holds these only as tiles
MIN_SECONDS, MIN_PASSES = 0.6, 3  # to measure for at least, and passes over the motion


@dataclass(frozen=True)
class Time:
    """Milliseconds a frame, of blocks of consecutive frames: median and 95 % quantile."""

    median: float
    high: float

    @classmethod
    def of(cls, milliseconds: list[float]) -> Time:
        """Return the quantiles of the times of several blocks."""
        return cls(*(float(value) for value in np.percentile(milliseconds, (50, 95))))


@dataclass(frozen=True)
class ShotBytes:
    """Bytes of a shot: those of its asset, without any frame, and those that each frame adds."""

    asset: float
    frame: float

    def of(self, frames: int) -> float:
        """Return the bytes of a shot of so many frames."""
        return self.asset + self.frame * frames


def play_time(player: Player, motion: Motion, *, seconds: float = MIN_SECONDS) -> Time:
    """Measure what a frame takes to play: character, latents, decoder and all vertices, on a processor."""
    _pass(player, motion)  # warms up
    blocks, passes, end = [], 0, time.perf_counter() + seconds
    while passes < MIN_PASSES or time.perf_counter() < end:
        blocks += _pass(player, motion)
        passes += 1
    return Time.of(blocks)


def _pass(player: Player, motion: Motion) -> list[float]:
    """Play a motion once; return the milliseconds a frame of each block."""
    playback, found = player.play(motion), []
    for start in range(0, motion.frame_count, BLOCK):
        frames = range(start, min(start + BLOCK, motion.frame_count))
        begun = time.perf_counter()
        for frame in frames:
            playback.vertices(frame)
        found.append(1000 * (time.perf_counter() - begun) / len(frames))
    return found


def operations(file: ModelFile) -> dict[str, int]:
    """Return the multiply-adds of one frame, by part."""
    parameters, config = file.parameters, file.config
    vertices, free = file.scene.garment.mesh.vertex_count, parameters["decoder.shapes"].shape[0]
    networks = {name: _weights(file, part) for name, part in zip("PSD", ("initialiser", "stepper", "output"))}
    return {
        **networks,
        "readout": config.shapes * config.activations,
        "blendshapes": 3 * free * config.shapes,
        "skinning": vertices * (12 * file.scene.rig.skin.indices.shape[1] + 9),
    }


def _weights(file: ModelFile, network: str) -> int:
    return sum(value.size for name, value in file.parameters.items() if name.startswith(network) and value.ndim > 1)


def memory(player: Player) -> int:
    """Return the bytes that playing keeps in memory: parameters, and the tiles of shapes and weights for skinning."""
    parameters = (value.size * 4 for name, value in player.file.parameters.items() if name not in TILE_PARAMETERS)
    tiles = (tile.shapes.nbytes + tile.weights.nbytes + tile.joints.nbytes for tile in player.tiles)
    return sum(parameters) + sum(tiles)


def model_bytes(file: ModelFile, *, pack: bool) -> int:
    """Return how large a model's file is."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_model(path, file, pack=pack)
        return path.stat().st_size
