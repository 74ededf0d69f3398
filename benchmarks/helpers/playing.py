# SPDX-License-Identifier: Apache-2.0
"""Ways of playing a garment over a motion, each with the time that its parts take."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np
import torch
from baselines.descriptors import joint_bank
from baselines.networks import Baseline, BaselineConfig, baseline
from torch import Tensor

from ssilk_core.network.checkpoint import ModelFile, network
from ssilk_core.network.model.batch import motion_inputs
from ssilk_core.network.model.descriptors import DOWN
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.character import character_frames
from ssilk_core.network.runtime.playback import BLOCK
from ssilk_core.network.runtime.skinning import skin_garment, vertex_block
from ssilk_core.physics.skinning import Skinning, blend_matrices, transform_points
from ssilk_core.scene.assets import Motion
from ssilk_core.training.motion_bank import build_bank

DESCRIPTORS, REST, LATENTS, DECODER, KINEMATICS, SKINNING = PARTS = (
    "descriptors and character", "networks of the poses alone", "latents", "decoder", "proxy kinematics",
    "blendshapes and skinning",
)  # fmt: skip
TOTALS = {
    "model": (LATENTS, DECODER),
    "+ kinematics": (LATENTS, DECODER, KINEMATICS),
    "+ blendshapes and skinning": (LATENTS, DECODER, KINEMATICS, SKINNING),
    "full, poses included": PARTS,
}
Laps = dict[str, float]
Way = Callable[[Motion], Laps]
Times = dict[str, dict[str, list[float]]]  # median and 95th percentile [us] by way, then by part or total


class Stopwatch:
    """Adds up processor time since the last lap under the name of a part [s]: other work cannot lengthen it."""

    def __init__(self) -> None:
        self.laps: Laps = defaultdict(float)
        self.last = time.process_time()

    def lap(self, part: str) -> None:
        now = time.process_time()
        self.laps[part] += now - self.last
        self.last = now


def spans(count: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def with_numpy(player: Player, motion: Motion, compiled: bool = False) -> Laps:
    """Play a motion at the model's rate as `runtime.Playback` does; return the time of each part [s].

    Args:
        compiled: whether in compiled loops, as a longer motion.
    """
    monitor, before = Stopwatch(), None
    assert player.stepper is not None
    for frames in spans(motion.frame_count, BLOCK):
        lookback = min(frames.start, 2)
        given = character_frames(
            motion.clip(frames.start - lookback, frames.stop),
            player.skeleton,
            player.file.joints,
            lookback,
            player.file.config.descriptors,
            player.proximity,
        )
        monitor.lap(DESCRIPTORS)
        course = player.stepper.prepare(player.quasi_static(given.static), given, before)
        monitor.lap(REST)
        states = player.stepper.roll(course, compiled)
        before = states[-2:]
        monitor.lap(LATENTS)
        if course.outputs is None:
            activations, transforms = player.decoder.decode(states)
        else:
            activations, transforms = player.decoder.pose_of(course.outputs.T)
        monitor.lap(DECODER)
        matrices = player.kinematics.matrices(transforms, given.matrices)
        monitor.lap(KINEMATICS)
        for part in spans(len(states), vertex_block(player.file.scene.garment.mesh.vertex_count)):
            posed = activations[:, part], matrices[..., part], given.origins[part]
            player.sparse_skin.skin(*posed) if compiled else skin_garment(player.tiles, *posed)
        monitor.lap(SKINNING)
    return monitor.laps


class Skinner:
    """Blendshapes and skinning in PyTorch, with what no frame changes computed beforehand.

    Args:
        rest: points (V, 3); shapes: of those that move (V', 3, K); free: which ones move (V',).
        skin: influences; weights: dense ones (V, used joints).
    """

    def __init__(self, rest: Tensor, shapes: Tensor, free: Tensor, skin: Skinning, weights: Tensor) -> None:
        whole = shapes.new_zeros(len(rest), *shapes.shape[1:]).index_copy(0, free, shapes)
        self.rest, self.shapes, self.used, self.weights = rest, whole.flatten(0, 1), skin.used, weights

    def __call__(self, activations: Tensor, matrices: Tensor) -> Tensor:
        """Return points (V, 3, N) of activations (K, N) and matrices of all joints (J, 3, 4, N)."""
        offsets = (self.shapes @ activations).unflatten(0, self.rest.shape)
        return transform_points(blend_matrices(self.weights, matrices[self.used]), self.rest[:, :, None] + offsets)


@torch.no_grad()
def with_torch(model: GarmentModel, skinner: Skinner, motion: Motion, chunk: int) -> Laps:
    """Play a motion with the network itself, `chunk` frames at a time; return the time of each part [s].

    Latents advance frame by frame in any case. The stepper sees each pose moved and held still in one call.
    """
    monitor = Stopwatch()
    given = motion_inputs(model, [motion])
    monitor.lap(DESCRIPTORS)  # with the quasi-static latents, which PyTorch computes at once
    states: list[Tensor] = []
    for frames in spans(motion.frame_count, chunk):
        rest, pose = given.rest[frames], given.pose[frames]
        starting = max(0, min(2 - frames.start, len(rest)))
        seen = slice(max(0, frames.start + starting - 2), frames.stop)
        body = BodyFrames(given.character[seen], given.bend[seen])
        states = model.roll([*states[-2:], *rest[:starting]], rest[starting:], pose[starting:], body)
        monitor.lap(LATENTS)
        activations, transforms = model.pose(torch.cat(states[-len(rest) :]))
        monitor.lap(DECODER)
        character = given.character[frames, ..., 0].permute(1, 2, 3, 0)
        matrices = model.decoder.proxy_matrices(transforms, character)
        monitor.lap(KINEMATICS)
        for part in spans(len(rest), vertex_block(len(skinner.rest))):
            skinner(activations[:, part], matrices[..., part])
        monitor.lap(SKINNING)
    return monitor.laps


@torch.no_grad()
def with_baseline(model: Baseline, skinner: Skinner, motion: Motion, chunk: int) -> Laps:
    """Play a motion with a baseline, `chunk` frames at a time; return the time of each part [s]."""
    monitor, skeleton = Stopwatch(), model.scene.character.skeleton
    bank = build_bank([motion], skeleton, model.joints, model.config.fps, torch.device("cpu"))
    inner = torch.as_tensor(skeleton.parents[model.joints] >= 0)
    lookback = joint_bank(bank, inner, model.config.fps)
    down = torch.tensor(DOWN).expand(bank.frame_count, 3)
    every = torch.arange(bank.frame_count)
    static, pose = lookback.static_descriptor(every, down), lookback.dynamic_descriptor(every, down)[:, None]
    monitor.lap(DESCRIPTORS)
    states = [model.initial(static[:1])]
    monitor.lap(REST)
    for frames in spans(bank.frame_count, chunk):
        states = model.roll(states[-1:], states[-1][None], pose[frames])[1:]
        monitor.lap(LATENTS)
        codes = model.code(torch.cat(states))
        monitor.lap(DECODER)
        skinner(codes.T, bank.character(every[frames]))
        monitor.lap(SKINNING)
    return monitor.laps


def ways(file: ModelFile, chunks: dict[str, int]) -> dict[str, Way]:
    """Return the ways of playing a garment by name: numpy, then PyTorch and NCS in chunks of frames by name.

    NCS is untrained, which takes as long.
    """
    player, model = Player(file), network(file)
    ncs = baseline(file.scene, BaselineConfig(method="ncs", fps=file.config.fps), file.joints).eval()
    decoder = model.decoder
    with torch.no_grad():
        own = Skinner(decoder.rest, decoder.shapes, decoder.free, decoder.skin, decoder.skin_weights())
        theirs = Skinner(ncs.rest, ncs.shapes, ncs.free, ncs.skin, ncs.skin.dense(ncs.skin.weights))
    found: dict[str, Way] = {"numpy": lambda motion: with_numpy(player, motion)}
    found["compiled loops"] = lambda motion: with_numpy(player, motion, compiled=True)
    for name, chunk in chunks.items():
        found[f"PyTorch, {name}"] = lambda motion, chunk=chunk: with_torch(model, own, motion, chunk)  # type: ignore[misc]
        found[f"NCS, {name}"] = lambda motion, chunk=chunk: with_baseline(ncs, theirs, motion, chunk)  # type: ignore[misc]
    return found


def measured(players: dict[str, Way], motion: Motion, repeats: int) -> Times:
    """Return median and 95th percentile [us] per frame by way, then by part or total; the ways take turns."""
    laps: dict[str, list[Laps]] = {name: [] for name in players}
    for repeat in range(repeats + 1):
        for name, play in players.items():
            taken = play(motion)
            if repeat:  # the first one warms caches
                laps[name].append(taken)
    sums = {**{part: (part,) for part in PARTS}, **TOTALS}
    return {
        name: {row: spread([sum(lap.get(part, 0.0) for part in parts) / motion.frame_count for lap in taken])
               for row, parts in sums.items()}
        for name, taken in laps.items()
    }  # fmt: skip


def spread(seconds: list[float]) -> list[float]:
    """Return median and 95th percentile [us]."""
    return (1e6 * np.percentile(seconds, (50, 95))).tolist()
