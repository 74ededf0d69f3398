# SPDX-License-Identifier: Apache-2.0
"""What is said and kept of steps that were skipped."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssilk_core.training.divergence import CHECK_INTERVAL, DivergenceMonitor, locate_frames
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.skipped_steps import SkippedSteps

CPU = torch.device("cpu")


def step(faults: SkippedSteps, iteration: int, **broken: bool) -> None:
    """Record a step in which terms were broken or not; all are whole and the gradient is not where `gradient`."""
    bad = any(broken.values())
    terms = {
        name: torch.tensor(float("nan") if broken.get(name) else 1.0) for name in ("stretch", "bending", "inertia")
    }
    faults.record(torch.tensor(bad), torch.tensor(iteration), terms, {"first": torch.tensor([iteration])})


def test_a_skipped_step_is_named_by_term_and_iteration_once():
    monitor = DivergenceMonitor(faults := SkippedSteps(CPU))
    step(faults, 0)
    assert monitor.check() == ""
    step(faults, 1, bending=True)
    step(faults, 2)
    assert monitor.check() == "1 step up to iteration 2 was skipped: bending not finite."
    assert monitor.check() == ""
    step(faults, 3, gradient=True)
    step(faults, 4, stretch=True, inertia=True)
    assert monitor.check() == "2 steps up to iteration 5 were skipped: stretch and inertia and gradient not finite."
    assert monitor.count == 3 and monitor.iteration == 5


def test_of_many_ever_fewer_are_told_of():
    faults, told = SkippedSteps(CPU), []
    faults.count.fill_(5000)  # of earlier runs: these count anew
    monitor = DivergenceMonitor(faults)
    for iteration in range(1000):
        step(faults, iteration, stretch=iteration % 10 == 0)
        if (iteration + 1) % CHECK_INTERVAL == 0:
            told.append(monitor.check())
    assert 4 < sum(map(bool, told)) < 15 and told[0]


@pytest.mark.parametrize(("share", "is_diverging"), [(0.4, False), (0.6, True)])
def test_training_diverges_once_most_of_the_last_hundred_steps_were_skipped(share, is_diverging):
    monitor, broken = (
        DivergenceMonitor(faults := SkippedSteps(CPU)),
        np.random.default_rng(0).permutation(100) < share * 100,
    )
    for iteration in range(1000):
        step(faults, iteration, stretch=bool(broken[iteration % 100]) and iteration >= 500)
        if (iteration + 1) % CHECK_INTERVAL == 0:
            monitor.check()
            assert not monitor.is_diverging or iteration > 540
    assert monitor.is_diverging == is_diverging and monitor.non_finite_terms == ["stretch"]


def test_skipped_steps_of_long_ago_are_forgiven():
    monitor = DivergenceMonitor(faults := SkippedSteps(CPU))
    for iteration in range(200):
        step(faults, iteration, bending=iteration < 70)
        if (iteration + 1) % CHECK_INTERVAL == 0:
            monitor.check()
    assert faults.count == 70 and not monitor.is_diverging


def test_frames_of_a_bank_are_those_of_the_motions(scene, toy_motion):
    """A motion at twice the model's rate that is cut in two, after one that starts late and one that is too short."""
    late = toy_motion(scene, 30, path="/late").clip(10, 30)
    short = toy_motion(scene, 3, path="/short")
    fast = toy_motion(scene, 80, fps=60.0, path="/fast")
    moved = np.array(fast.translations)
    moved[40:, 0] += 5.0
    motions = [late, short, type(fast)(fast.path, fast.fps, fast.rotations, moved)]
    bank = build_bank(motions, scene.character.skeleton, np.arange(3), 30.0, CPU)
    found = locate_frames(torch.tensor([0, 19, 20, 25, 39, 40, 41]), bank, motions, scene.character.skeleton, 30.0)
    assert [(place["motion"], place["frame"]) for place in found] == [
        *(("/late", 10), ("/late", 29)),
        *(("/fast", 0), ("/fast", 10), ("/fast", 38), ("/fast", 40), ("/fast", 42)),
    ]
