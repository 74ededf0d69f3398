# SPDX-License-Identifier: Apache-2.0
"""Cost model of a trained garment: time, operations, memory and bytes on disk.

Times are measured on this machine. All other costs follow from sizes. The multiply-adds of a frame are

    P, S, D         the weights of the networks; only retraining changes P, S and all but the last layer of D
    readout         shapes * activations, in reduced models
    blendshapes     3 V shapes
    skinning        12 V influences to blend matrices, 9 V to apply them

With more vertices, the share of blendshapes and skinning grows and that of the networks falls. What a shot stores,
such as a refined garment, is played without networks.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ..network.checkpoint import ModelFile, save_model
from ..network.runtime import Playback, Player
from ..network.runtime.playback import BLOCK
from ..network.runtime.skinning import Tile, vertex_block
from ..network.runtime.stored import StoredPlayer
from ..scene.assets import Deformer, GarmentPose, Motion, Scene

POINT_BYTES = 12  # bytes of a vertex in a point cache
TILE_PARAMETERS = ("decoder.shapes", "decoder.skin_offset")  # the runtime stores these only as tiles
MIN_SECONDS, MIN_PASSES = 0.6, 3  # least duration of a measurement [s], and least passes over the motion


@dataclass(frozen=True)
class Time:
    """Time per frame over blocks of consecutive frames: median and 95 % quantile [ms]."""

    median: float
    high: float

    @classmethod
    def of(cls, milliseconds: list[float]) -> Time:
        """Return the quantiles of the times of several blocks."""
        return cls(*(float(value) for value in np.percentile(milliseconds, (50, 95))))


@dataclass(frozen=True)
class ShotBytes:
    """Size of a shot: its asset without frames [bytes], and each frame [bytes]."""

    asset: float
    frame: float

    def of(self, frames: int) -> float:
        """Return the size of a shot with this number of frames [bytes]."""
        return self.asset + self.frame * frames


def play_time(player: Player, motion: Motion, *, seconds: float = MIN_SECONDS) -> Time:
    """Measure the time to play a frame on the CPU: character, latents, decoder and all vertices."""

    def frames(playback: Playback, block: range) -> None:
        for frame in block:
            playback.vertices(frame)

    return _timed(lambda: partial(frames, player.play(motion)), motion.frame_count, seconds)


def stored_time(
    deformer: Deformer, motion: Motion, poses: Sequence[GarmentPose], *, seconds: float = MIN_SECONDS
) -> Time:
    """Measure the time to play a frame of stored poses on the CPU: character, joints, blendshapes, all vertices."""
    player = StoredPlayer(deformer)
    whole, size = GarmentPose.joined(poses), vertex_block(deformer.scene.garment.mesh.vertex_count)

    def frames(block: range) -> None:
        for start in range(block.start, block.stop, size):
            part = slice(start, min(start + size, block.stop))
            player.vertices(motion, whole.part(part))

    return _timed(lambda: frames, motion.frame_count, seconds)


def _timed(begin: Callable[[], Callable[[range], None]], count: int, seconds: float) -> Time:
    """Return the time per frame of what plays blocks of consecutive frames, in passes over all of them."""
    _pass(begin(), count)  # warms up
    blocks, passes, end = [], 0, time.perf_counter() + seconds
    while passes < MIN_PASSES or time.perf_counter() < end:
        blocks += _pass(begin(), count)
        passes += 1
    return Time.of(blocks)


def _pass(play: Callable[[range], None], count: int) -> list[float]:
    """Play all frames once; return the time per frame of each block [ms]."""
    found = []
    for start in range(0, count, BLOCK):
        frames = range(start, min(start + BLOCK, count))
        begun = time.perf_counter()
        play(frames)
        found.append(1000 * (time.perf_counter() - begun) / len(frames))
    return found


def operations(file: ModelFile) -> dict[str, int]:
    """Return the multiply-adds of one frame, by part."""
    parameters, config = file.parameters, file.config
    free = parameters["decoder.shapes"].shape[0]
    networks = {name: _weights(file, part) for name, part in zip("PSD", ("initialiser", "stepper", "output"))}
    return {
        **networks,
        "readout": config.shapes * config.activations,
        "blendshapes": 3 * free * config.shapes,
        "skinning": _skinning(file.scene),
    }


def stored_operations(deformer: Deformer) -> dict[str, int]:
    """Return the multiply-adds of a frame of stored poses, by part."""
    return {"blendshapes": deformer.shapes.size, "skinning": _skinning(deformer.scene)}


def _skinning(scene: Scene) -> int:
    return scene.garment.mesh.vertex_count * (12 * scene.rig.skin.indices.shape[1] + 9)


def _weights(file: ModelFile, network: str) -> int:
    return sum(value.size for name, value in file.parameters.items() if name.startswith(network) and value.ndim > 1)


def memory(player: Player) -> int:
    """Return the memory that playback uses for parameters and for the tiles of shapes and weights [bytes]."""
    parameters = (value.size * 4 for name, value in player.file.parameters.items() if name not in TILE_PARAMETERS)
    return sum(parameters) + _of_tiles(player.tiles)


def stored_memory(deformer: Deformer) -> int:
    """Return the memory that playing stored poses uses for the tiles of shapes and weights [bytes]."""
    return _of_tiles(StoredPlayer(deformer).tiles)


def _of_tiles(tiles: list[Tile]) -> int:
    return sum(tile.shapes.nbytes + tile.weights.nbytes + tile.joints.nbytes for tile in tiles)


def model_bytes(file: ModelFile, *, pack: bool) -> int:
    """Return the size of a model's file [bytes]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_model(path, file, pack=pack)
        return path.stat().st_size
