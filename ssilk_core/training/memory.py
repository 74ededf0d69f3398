# SPDX-License-Identifier: Apache-2.0
"""How much memory a training step needs, before it is asked for."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from ..assets import Scene
from ..config import ModelConfig, TrainConfig

SHARE = 0.8  # of the free memory that a training may plan for


def free_memory(device: torch.device) -> int:
    """Return the bytes that can still be had on a device; on the CPU the container's limit counts."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    if device.type != "cpu":
        return 8 << 30  # no portable question exists for other devices
    pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 8 << 30
    try:
        meminfo = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        pages = int(meminfo["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError):
        return pages
    return pages


def step_memory(scene: Scene, config: ModelConfig, frames: int, body_vertices: int) -> int:
    """Predict the bytes that one training step holds at its peak, for `frames` decoded at once.

    Counts the float32 numbers that the backward pass keeps for each vertex, triangle, hinge and joint; the
    constants were fitted to measured peaks (benchmarks/memory.py).
    """
    mesh = scene.garment.mesh
    vertices, faces = mesh.vertex_count, len(mesh.faces)
    joints = len(scene.joint_names)
    numbers = 60 * vertices + 26 * faces + 42 * (faces * 3 // 2) + 60 * joints + 30 * body_vertices
    network = 40 * sum(config.widths) + 20 * config.latent
    return 4 * frames * (numbers + network) + (256 << 20)


def decoded_frames(config: TrainConfig, batch: int) -> int:
    """Return the frames that the larger phase decodes at once."""
    return max(batch * config.window, config.warm_batch if config.warm else 0)


def fitting_batch(
    scene: Scene, model: ModelConfig, config: TrainConfig, body_vertices: int, available: int
) -> tuple[int, int]:
    """Return the largest batch and warm batch, up to the configured ones, whose steps fit into `available` bytes."""
    per_frame = step_memory(scene, model, 1, body_vertices) - step_memory(scene, model, 0, body_vertices)
    frames = int(max(1, (SHARE * available - step_memory(scene, model, 0, body_vertices)) // per_frame))
    return max(1, min(config.batch, frames // config.window)), max(1, min(config.warm_batch, frames))
