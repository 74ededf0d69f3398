# SPDX-License-Identifier: Apache-2.0
"""Solved frames that are kept: what begins alike goes on to the same bits, and only what changed is solved again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.network.latent_solver import LatentMemory, LatentOptions, LatentRoller, memory, shots
from ssilk_core.network.rollout import RolloutBlock
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.fabrics import Fabric

CLOTH = Fabric("toy", bending=1e-4, margin=0.02)
FRAMES, APART = 14, 4
PRE_ROLL = 0.1  # seconds: three frames


@pytest.fixture(autouse=True)
def kept_often(monkeypatch):
    monkeypatch.setattr(memory, "APART", APART)


@pytest.fixture
def roller(scene, toy_model) -> Callable[..., LatentRoller]:
    model = toy_model(scene)

    def build(**options: object) -> LatentRoller:
        settings = LatentOptions(iterations=2, first_iterations=3)
        return LatentRoller(model, CLOTH, settings, pre_roll=PRE_ROLL, **options)

    return build


def states(blocks: list[RolloutBlock]) -> np.ndarray:
    """All that a rollout decodes to, frame by frame, (F, ...)."""
    flat = [torch.cat([each.activation, each.transforms.flatten(0, 2)]).T for each in blocks]
    return torch.cat(flat).numpy()


def changed(motion: Motion, frame: int) -> Motion:
    """The motion, with a step aside from a frame on; rotations are normalised once more."""
    translations = motion.translations.copy()
    translations[frame:, 0, 0] += 0.05
    return replace(motion, translations=translations)


@pytest.mark.parametrize("frame", [1, 5, 9, 10, FRAMES - 1])
def test_a_motion_that_changes_is_solved_from_there_on_to_the_same_bits(scene, toy_motion, roller, frame):
    solved: list[int] = []
    kept = LatentMemory()
    lasting = roller(memory=kept, advanced=lambda: solved.append(1))
    whole = toy_motion(scene, FRAMES)
    list(lasting(changed(whole, FRAMES)))  # both are rounded alike
    assert len(solved) == FRAMES + 3
    solved.clear()
    kept.begin()
    other = changed(whole, frame)
    np.testing.assert_array_equal(states(list(lasting(other))), states(list(roller()(other))))
    again = FRAMES - frame if frame > 1 else FRAMES + 3  # the run-up continues the first step
    assert again <= len(solved) < again + APART


def test_what_was_interrupted_goes_on_where_it_was(scene, toy_motion, roller):
    class Interrupted(Exception):
        pass

    def advanced() -> None:
        solved.append(1)
        if len(solved) == 9:
            raise Interrupted

    solved: list[int] = []
    kept, motion = LatentMemory(), toy_motion(scene, FRAMES)
    with pytest.raises(Interrupted):
        list(roller(memory=kept, advanced=advanced)(motion))
    kept.begin()
    again = states(list(roller(memory=kept, advanced=advanced)(motion)))
    np.testing.assert_array_equal(again, states(list(roller()(motion))))
    assert len(solved) == FRAMES + 3


def test_spans_are_kept_apart_and_small_blocks_are_the_same(scene, toy_motion, roller):
    solved: list[int] = []
    kept = LatentMemory()
    lasting = roller(memory=kept, chunk=3, advanced=lambda: solved.append(1))
    spans = [toy_motion(scene, 5), toy_motion(scene, 7, speed=2.0)]
    found = [list(lasting(span)) for span in spans]
    assert [block.start for block in found[1]] == [0, 3, 6]
    for blocks, span in zip(found, spans):
        np.testing.assert_allclose(states(blocks), states(list(roller()(span))), atol=1e-6)
    count = len(solved)
    kept.begin()
    for blocks, span in zip(found, spans):
        np.testing.assert_array_equal(states(list(lasting(span))), states(blocks))
    assert len(solved) == count


def test_a_range_that_shrinks_or_grows_keeps_its_frames(scene, toy_motion, roller):
    solved: list[int] = []
    kept, whole = LatentMemory(), toy_motion(scene, FRAMES)
    lasting = roller(memory=kept, advanced=lambda: solved.append(1))
    wanted = states(list(roller()(whole.clip(0, FRAMES))))
    for count in (9, FRAMES, 6):
        kept.begin()
        found = states(list(lasting(whole.clip(0, count))))
        np.testing.assert_allclose(found, wanted[:count], atol=1e-6)
    assert len(solved) < FRAMES + 3 + APART


def test_what_follows_is_kept_of_few_frames(scene, toy_motion, roller):
    kept = LatentMemory()
    list(roller(memory=kept)(toy_motion(scene, FRAMES)))
    (span,) = kept._spans
    assert sorted(span.ends) == [0, 4, 8, 12, 16] and len(span.frames) == FRAMES + 3
    assert all(frame.past is None and not frame.solution.x.numel() for frame in span.frames)


def test_few_elements_stay_those_of_the_first_motion(scene, toy_motion, toy_model, monkeypatch):
    chosen: list[int] = []
    choose = shots.choose_elements
    monkeypatch.setattr(shots, "choose_elements", lambda *given: chosen.append(1) or choose(*given))
    model, solved = toy_model(scene), []
    settings = LatentOptions(iterations=2, first_iterations=3, sampled=True)

    def few(**options: object) -> LatentRoller:
        return LatentRoller(model, CLOTH, settings, **options)

    kept, motion = LatentMemory(), changed(toy_motion(scene, FRAMES), FRAMES)
    lasting = few(memory=kept, advanced=lambda: solved.append(1))
    np.testing.assert_array_equal(states(list(lasting(motion))), states(list(few()(motion))))
    assert len(chosen) == 2 and len(solved) == FRAMES
    kept.begin()
    other = states(list(lasting(changed(toy_motion(scene, FRAMES), 10))))
    assert len(chosen) == 2 and 4 <= len(solved) - FRAMES < 4 + APART and np.isfinite(other).all()
