# SPDX-License-Identifier: Apache-2.0
"""Prediction of the memory that a training step needs."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import fail
from ..network.settings import ModelConfig
from ..physics.intersections.figures import EVERY
from ..physics.samples import contact_samples
from ..scene.assets import LOOSE, PINNED, Scene
from ..scene.fabrics import Fabric
from ..scene.mesh.stitches import held_stitches
from .settings import MOST_SMOOTHED_VERTICES, TrainConfig

if TYPE_CHECKING:
    import torch

PLANNED_SHARE = 0.8  # of the free memory
DEFAULT_FREE_MEMORY = 8 << 30  # bytes, where the system offers no portable way to ask
MAX_SEARCHED = 1 << 25  # pairs of a sample and a triangle of the body at once, as `collision.closest_point` takes
CONTOUR_BYTES = 160  # for each triangle of a frame that is searched: bounds, corners, and places for pairs
CONTOUR_VERTEX_BYTES = 72  # likewise for each vertex: positions and gradients, which are summed in whole numbers
OBSTACLE_NUMBERS = 24  # for each contact sample of a frame: the distances to two obstacles, and the ways from them
STITCH_NUMBERS = 60  # for each frame: arms, normal and offset, with their gradients
MEMINFO = Path("/proc/meminfo")
CONTAINER = Path("/sys/fs/cgroup")
# Limit, usage, statistics and the name of reclaimable cache in them, for versions 2 and 1 of control groups.
CONTROL_GROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


def free_memory(device: torch.device | str) -> int:
    """Return the free memory of a device [bytes]; on the CPU within the container's limit."""
    kind = str(device).partition(":")[0]
    if kind == "cuda":
        import torch

        return int(torch.cuda.mem_get_info(device)[0])
    if kind != "cpu" or not MEMINFO.is_file():
        return DEFAULT_FREE_MEMORY
    machine = int(_numbers(MEMINFO)["MemAvailable:"]) * 1024
    left = (_left_in_container(*names) for names in CONTROL_GROUPS if (CONTAINER / names[0]).is_file())
    return int(min([machine, *left]))


def _left_in_container(limit: str, usage: str, statistics: str, cache: str) -> float:
    """Return the free bytes under a control group's limit; reclaimable file cache counts as free."""
    most = (CONTAINER / limit).read_text().strip()
    if most == "max":
        return float("inf")
    stat = CONTAINER / statistics
    reclaimable = int(_numbers(stat).get(cache, 0)) if stat.is_file() else 0
    return max(0, int(most) - int((CONTAINER / usage).read_text()) + reclaimable)


def _numbers(path: Path) -> dict[str, str]:
    """Return the second word of each line by its first."""
    return {words[0]: words[1] for line in path.read_text().splitlines() if len(words := line.split()) > 1}


@dataclass(frozen=True, eq=False)
class StepMemory:
    """Predicts what a training step holds at its peak, from the sizes of its garment, body and network.

    Counts float32 numbers for each frame and vertex, contact sample, body vertex, joint and unit of the network, one
    table of squared distances, the matrix that smooths blendshapes, and the search for the closest triangles on a
    CPU. The constants were fitted to measured peaks, on the safe side (benchmarks/memory.py).

    Attributes:
        body_vertices: those of the body that the garment can touch.
        samples: at which the garment meets the body (`physics.samples`), its vertices among them.
        stitches: that hold its islands on one another.
        smoothed: vertices whose blendshapes are smoothed by a matrix that is still to be built.
        contours: whether the garment's intersections with itself are searched for.
        obstacles: whether there are any around the character.
    """

    scene: Scene
    model: ModelConfig
    body_vertices: int
    samples: int
    stitches: int = 0
    smoothed: int = 0
    contours: bool = False
    obstacles: bool = False

    @classmethod
    def of(
        cls, scene: Scene, model: ModelConfig, config: TrainConfig, fabric: Fabric, body_vertices: int
    ) -> StepMemory:
        """Return that of a training of which nothing is built yet."""
        mesh = scene.garment.mesh
        samples = len(contact_samples(mesh, fabric).area)
        stitches = len(held_stitches(mesh, fabric, scene.classes))
        smoothed, contours = smoothed_vertices(scene, model, config), searches_contours(scene, config)
        obstacles = bool(config.collider_fraction and model.proximity_points)
        return cls(scene, model, body_vertices, samples, stitches, smoothed, contours, obstacles)

    def needed(self, frames: int) -> int:
        """Predict the bytes of a step that decodes so many frames at once."""
        mesh = self.scene.garment.mesh
        cloth = 200 * mesh.vertex_count + 25 * self.samples + STITCH_NUMBERS * self.stitches
        cloth += OBSTACLE_NUMBERS * (self.samples + self.model.proximity_points) if self.obstacles else 0
        numbers = cloth + 22 * self.body_vertices + 60 * len(self.scene.joint_names)
        network = 12 * sum(self.model.widths) + 20 * self.model.latent
        searched = self.samples * self.body_vertices
        pairs = min(MAX_SEARCHED, 2 * frames * searched)  # a closed mesh has twice as many faces
        crossed = CONTOUR_BYTES * len(mesh.faces) + CONTOUR_VERTEX_BYTES * mesh.vertex_count if self.contours else 0
        found = 4 * searched + 8 * pairs + ceil(frames / EVERY) * crossed
        return 4 * frames * (numbers + network) + found + 4 * self.smoothed**2 + (40 << 20)

    def fitting_batch(self, config: TrainConfig, available: int) -> tuple[int, int]:
        """Return the largest batch and pretraining batch, up to the configured ones, that fit into so many bytes."""
        most = decoded_frames(config, config.batch)
        frames = bisect_right(range(most + 1), PLANNED_SHARE * available, key=self.needed) - 1
        if frames == most:
            return config.batch, config.pretraining_batch
        return max(1, min(config.batch, int(frames / _frames_of_a_window(config)))), max(
            1, min(config.pretraining_batch, frames)
        )

    def check_one_window_fits(self, config: TrainConfig, available: int) -> None:
        """Raise `SsilkError` unless a step on a single window fits into `available` bytes."""
        needed = self.needed(ceil(_frames_of_a_window(config)))
        if not needed <= available:
            fail(
                self.scene.garment.mesh.path,
                f"a batch of one window of {config.window} poses needs {needed / 2**30:.2g} GiB",
                f"{available / 2**30:.2g} GiB are free",
                "free some, take another device (--device), or shorter windows (--set window=...)",
            )


def searches_contours(scene: Scene, config: TrainConfig) -> bool:
    """Return whether a training searches for contours of intersection, which count where cloth is loose."""
    return bool(config.intersection_weight and (scene.classes == LOOSE).any())


def smoothed_vertices(scene: Scene, model: ModelConfig, config: TrainConfig) -> int:
    """Return how many vertices `training.shape_smoothing` smooths."""
    free = int((scene.classes != PINNED).sum())
    return free if config.shape_smoothing and model.shapes and free <= MOST_SMOOTHED_VERTICES else 0


def decoded_frames(config: TrainConfig, batch: int) -> int:
    """Return the frames that the larger phase decodes at once."""
    return max(ceil(batch * _frames_of_a_window(config)), config.pretraining_batch if config.static_fraction else 0)


def _frames_of_a_window(config: TrainConfig) -> float:
    """Return the decoded frames per window, with its share of the single poses."""
    return config.window + config.static_batch / config.batch + 2 * config.initial_loss


def fits_in_memory(work: Callable[[], None]) -> bool:
    """Run `work`.

    Return whether the memory of the device was enough. On failure no tensor of `work` is kept alive.
    """
    try:
        work()
    except RuntimeError as error:
        if not _of_memory(error):
            raise
        return False
    return True


def _of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or its cause, is a lack of memory; failed graph captures hide it in their cause."""
    import torch

    while error is not None:
        if isinstance(error, torch.OutOfMemoryError) or "out of memory" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
