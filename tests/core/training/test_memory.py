# SPDX-License-Identifier: Apache-2.0
"""Memory is predicted before it is used, and batches are lowered until they fit."""

import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ssilk_core.errors import SsilkError
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import PINNED, TIGHT
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.training import memory
from ssilk_core.training.memory import (
    PLANNED_SHARE,
    StepMemory,
    decoded_frames,
    fits_in_memory,
    free_memory,
    smoothed_vertices,
)
from ssilk_core.training.obstacles import Obstacles
from ssilk_core.training.settings import TrainConfig

MODEL, CONFIG = ModelConfig(), TrainConfig(batch=32, window=16, static_batch=32, pretraining_batch=700)


def test_more_of_anything_needs_more(scene):
    step = StepMemory(scene, MODEL, 1000, 200)
    base = step.needed(64)
    wider = replace(MODEL, widths=(256, 512, 513))
    assert step.needed(65) > base
    more = {"body_vertices": 1001}, {"samples": 201}, {"stitches": 1}, {"smoothed": 1}, {"contours": True}
    for change in (*more, {"obstacles": True}, {"model": wider}):
        assert replace(step, **change).needed(64) > base


def test_the_matrix_that_smooths_is_counted_where_there_is_one(scene):
    free = int((scene.classes != PINNED).sum())
    assert 0 < smoothed_vertices(scene, MODEL, CONFIG) == free < len(scene.classes)
    for model, config in ((replace(MODEL, shapes=0), CONFIG), (MODEL, replace(CONFIG, shape_smoothing=0))):
        assert smoothed_vertices(scene, model, config) == 0


def test_what_a_step_keeps_of_its_contact_samples_is_counted(scene):
    """A coarse mesh has several samples for each vertex; the gradient keeps their positions, planes and distances."""
    frames, kept, counts = 8, [], []
    for fabric in (FABRICS["paper"], FABRICS["default"]):
        energy, storages = GarmentEnergy(scene.garment.mesh, fabric, scene.classes), {}

        def keep(found: torch.Tensor, storages: dict[int, int] = storages) -> torch.Tensor:
            storages[found.untyped_storage().data_ptr()] = found.untyped_storage().nbytes()
            return found

        x = torch.tensor(scene.garment.mesh.points, dtype=torch.float32)[:, :, None].repeat(1, 1, frames)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda found: found):
            sampled = energy.cloth.positions(x.requires_grad_())
            planes = torch.ones_like(sampled), torch.ones_like(sampled[:, 0])
            energy.gravity_and_collision(x, x[0].detach(), x[0].detach(), sampled, *planes)
        kept.append(sum(storages.values()) + 4 * (sampled.numel() + planes[0].numel() + planes[1].numel()))
        counts.append(len(energy.cloth.samples.area))
    few, many = (StepMemory(scene, MODEL, 0, count).needed(frames) for count in counts)
    assert counts[1] > 2 * counts[0] and many - few > kept[1] - kept[0] > 0


def test_what_a_step_keeps_of_its_stitches_is_counted(patched_scene):
    mesh, frames, kept = patched_scene.garment.mesh, 8, {}
    energy = GarmentEnergy(mesh, FABRICS["default"], patched_scene.classes)

    def keep(found: torch.Tensor) -> torch.Tensor:
        kept[found.untyped_storage().data_ptr()] = found.untyped_storage().nbytes()
        return found

    x = torch.tensor(mesh.points, dtype=torch.float32)[:, :, None].repeat(1, 1, frames)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda found: found):
        energy.stitch(x.requires_grad_())
    none, some = (
        StepMemory(patched_scene, MODEL, 0, 0, count).needed(frames) for count in (0, len(energy.stitching))
    )
    assert some - none > sum(kept.values()) > 0


class Held(TorchDispatchMode):
    """Bytes of what the operations within have returned, and somebody still holds, at most."""

    def __init__(self) -> None:
        super().__init__()
        self.most, self._alive = 0, []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        found = func(*args, **(kwargs or {}))
        self._alive = [each for each in self._alive if each() is not None] + [
            weakref.ref(each) for each in ([found] if isinstance(found, torch.Tensor) else ())
        ]
        storages = {each.untyped_storage().data_ptr(): each.untyped_storage().nbytes() for ref in self._alive
                    if (each := ref()) is not None}  # fmt: skip
        self.most = max(self.most, sum(storages.values()))
        return found


def test_what_the_distances_to_obstacles_take_is_counted_where_there_are_any(scene):
    samples, frames = 500, 16
    turn = torch.eye(3).expand(2, frames, 3, 3).contiguous()
    obstacles = Obstacles(turn, torch.zeros(2, frames, 3), torch.ones(2, frames, 3), torch.zeros(2, frames))
    points = torch.randn(samples, 3, frames)
    with torch.no_grad(), Held() as held:
        obstacles.nearest(points)
    blind = StepMemory(scene, MODEL, 100, samples)
    counted = replace(blind, obstacles=True).needed(frames) - blind.needed(frames)
    assert counted >= held.most > 4 * 12 * samples * frames
    for share, points_seen, there in ((0.25, 24, True), (0.0, 24, False), (0.25, 0, False)):
        model, config = replace(MODEL, proximity_points=points_seen), replace(CONFIG, collider_fraction=share)
        assert StepMemory.of(scene, model, config, FABRICS["silk"], 100).obstacles is there


def test_what_the_search_for_contours_takes_is_counted_where_cloth_is_loose(scene, monkeypatch):
    """What the kernel is handed is held all at once."""
    pytest.importorskip("triton")
    from ssilk_core.physics.kernels import contours as kernel

    frames, held, mesh = 32, [], scene.garment.mesh
    grid = (-(-len(mesh.faces) // kernel.TILE), 8)
    for name in ("_search_pairs", "_measure_contours"):
        monkeypatch.setattr(kernel, name, {grid: lambda *given, **_: held.extend(given)})
    faces = torch.tensor(mesh.faces)
    x = torch.tensor(mesh.points, dtype=torch.float32)[:, :, None].repeat(1, 1, frames)[..., ::4]
    kernel.contours_kernel(x, faces, faces, faces[:, 0], faces[:1, 0], 0.2)
    storages = {each.untyped_storage().data_ptr(): each for each in held if isinstance(each, torch.Tensor)}
    kept = sum(each.untyped_storage().nbytes() for each in storages.values())
    config = replace(CONFIG, intersection_weight=0.02, shape_smoothing=0)
    pinned = replace(scene, garment=replace(scene.garment, classes=np.minimum(scene.classes, TIGHT)))
    loose, tight, without = (
        StepMemory.of(each, MODEL, asked, FABRICS["silk"], 100).needed(frames)
        for each, asked in ((scene, config), (pinned, config), (scene, replace(config, intersection_weight=0)))
    )
    assert tight == without and loose - without > kept > 0


def test_frames_cost_the_same_each(scene):
    costs = [StepMemory(scene, MODEL, 1000, 200).needed(frames) for frames in (100, 110, 120)]  # beyond the search
    assert costs[2] - costs[1] == costs[1] - costs[0] > 10 * 4 * 3 * 60  # the positions alone


def test_the_larger_phase_counts():
    assert decoded_frames(CONFIG, 32) == 700
    assert decoded_frames(CONFIG, 64) == 64 * 17  # a window of 16 poses, and one of the single poses
    assert decoded_frames(replace(CONFIG, static_fraction=0.0), 32) == 32 * 17


def test_what_fits_is_left_as_it_is(scene):
    assert StepMemory(scene, MODEL, 1000, 200).fitting_batch(CONFIG, 1 << 40) == (32, 700)
    moving = replace(CONFIG, static_fraction=0.0, batch=2)  # no step decodes the 700
    assert StepMemory(scene, MODEL, 1000, 200).fitting_batch(moving, 1 << 40) == (2, 700)


@pytest.mark.parametrize("megabytes", [450, 600, 900])
def test_a_lowered_batch_fits_and_one_more_would_not(scene, megabytes):
    available = megabytes << 20
    config = replace(CONFIG, batch=10_000, pretraining_batch=100_000, static_batch=10_000)
    step = StepMemory(scene, MODEL, 1000, 200)
    batch, warm = step.fitting_batch(config, available)
    assert 1 < batch < 10_000 and 1 < warm < 100_000
    assert step.needed(max(batch * 17, warm)) <= PLANNED_SHARE * available
    assert step.needed((batch + 1) * 17) > PLANNED_SHARE * available
    assert step.needed(warm + 1) > PLANNED_SHARE * available


def test_at_least_one_window_is_trained_on(scene):
    assert StepMemory(scene, MODEL, 1000, 200).fitting_batch(CONFIG, 1 << 20) == (1, 1)


def test_one_window_must_fit(scene):
    step = StepMemory(scene, MODEL, 1000, 200)
    needed = step.needed(CONFIG.window + 1)
    step.check_one_window_fits(CONFIG, needed)
    with pytest.raises(SsilkError, match=r"one window of 16 poses needs 0\.094 GiB; 0\.094 GiB are free; .*window="):
        step.check_one_window_fits(CONFIG, needed - 1)


def test_a_lack_of_memory_is_told_from_other_errors():
    done: list[int] = []
    assert fits_in_memory(lambda: done.append(1)) and done == [1]

    def lacking() -> None:
        raise torch.OutOfMemoryError("tried to allocate")

    def captured() -> None:
        """The end of a graph's capture fails, too, and that is what is seen."""
        try:
            lacking()
        finally:
            raise RuntimeError("operation failed due to a previous error during capture")

    assert not fits_in_memory(lacking) and not fits_in_memory(captured)
    with pytest.raises(RuntimeError, match="must match the size"):
        fits_in_memory(lambda: print(torch.ones(2) + torch.ones(3)))


def test_what_did_not_fit_is_held_no_longer():
    held = []

    def work() -> None:
        large = torch.zeros(10)
        held.append(weakref.ref(large))
        raise torch.OutOfMemoryError

    assert not fits_in_memory(work) and held[0]() is None


def test_free_memory_is_within_the_machine():
    total = int(Path("/proc/meminfo").read_text().split()[1]) * 1024 if Path("/proc/meminfo").exists() else 1 << 50
    assert 0 < free_memory(torch.device("cpu")) <= total


@pytest.mark.parametrize(
    "files, expected",
    [
        ({"memory.max": "3000000\n", "memory.current": "1000000\n"}, 2_000_000),
        (
            {
                "memory.max": "3000000\n",
                "memory.current": "1000000\n",
                "memory.stat": "anon 5\ninactive_file 400000\n",
            },
            2_400_000,
        ),
        ({"memory.max": "1000\n", "memory.current": "5000\n"}, 0),
        ({"memory.max": "max\n", "memory.current": "1000000\n"}, None),
        ({"memory/memory.limit_in_bytes": "3000000\n", "memory/memory.usage_in_bytes": "500000\n"}, 2_500_000),
        ({}, None),
    ],
)
def test_the_limit_of_a_container_counts(tmp_path, monkeypatch, files, expected):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    unlimited = free_memory(torch.device("cpu"))
    monkeypatch.setattr(memory, "CONTAINER", tmp_path)
    found = free_memory(torch.device("cpu"))
    assert found == expected if expected is not None else found > min(unlimited, 1 << 28) // 2
