# SPDX-License-Identifier: Apache-2.0
"""Which round of a loop is written, and how its end is led into its beginning."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.delivery.bake.looped import MOST_ROUNDS, Loop, looped, seam
from ssilk_core.scene.assets import GarmentPose, Motion
from ssilk_core.scene.cycles import Cycle

PERIOD, FPS = 24, 30.0


def loop() -> Loop:
    motion = Motion("walk", FPS, np.tile([1.0, 0, 0, 0], (2, 1, 1)), np.zeros((2, 1, 3)))
    return Loop(Cycle(PERIOD, True, 0.0, np.zeros(3), 0.0), PERIOD, motion)


def rolled(values: np.ndarray, asked: list[int]):
    """Poses with one weight each, some at a time; lists how many were asked for."""
    for start in range(0, len(values), 10):
        part = values[start : start + 10, None]
        asked.append(len(part))
        yield GarmentPose(start, np.tile([1.0, 0, 0, 0], (len(part), 1, 1)), part)


def decode(pose: GarmentPose) -> np.ndarray:
    return np.repeat(pose.weights[:, None].astype(float), 3, axis=2)


def play(values: np.ndarray, fps: float = FPS):
    asked: list[int] = []
    return looped(rolled(values, asked), loop(), PERIOD + 1, fps, decode), sum(asked)


def wave(count: int) -> np.ndarray:
    return 0.5 + 0.2 * np.sin(2 * np.pi * np.arange(count) / PERIOD)


def test_rounds_are_played_until_the_state_repeats_and_no_more():
    count = loop().samples
    found, asked = play(wave(count) + 0.3 * np.exp(-np.arange(count) / 12))
    assert found.repeats and found.rounds == 5 and asked < 6 * PERIOD  # 0.45 exp(-2 k) is under 0.5 mm from 3.4 on
    np.testing.assert_allclose(found.pose.weights[:, 0], wave(PERIOD + 1), atol=6e-4)
    assert found.pose.weights[0] == pytest.approx(found.pose.weights[-1], abs=1e-7)
    assert found.first.weights[0, 0] == pytest.approx(0.8)  # from rest


def test_where_none_repeats_the_nearest_is_taken_and_its_end_led_into_its_beginning():
    count = loop().samples
    drift = 0.2 * np.sin(np.arange(count) / 37.0)
    found, asked = play(wave(count) + drift)
    assert not found.repeats and asked == count
    ends = [abs(drift[(k + 1) * PERIOD] - drift[k * PERIOD]) for k in range(1, MOST_ROUNDS)]
    assert found.begins == (1 + int(np.argmin(ends))) * PERIOD
    course = found.pose.weights[:, 0]
    assert course[0] == pytest.approx(course[-1], abs=1e-7)
    lead = (wave(count) + drift)[found.begins - 2 : found.begins + 1]
    assert course[-2] - course[-1] == pytest.approx(lead[1] - lead[2], abs=1e-3)  # with its velocity
    np.testing.assert_allclose(course[: PERIOD // 2], (wave(count) + drift)[found.begins :][: PERIOD // 2], atol=1e-6)


def test_the_last_frame_alone_is_led_into_the_first_where_half_a_second_has_no_other():
    count = loop().samples
    found, _ = play(wave(count) + 0.2 * np.sin(np.arange(count) / 37.0), fps=1.0)
    course = found.pose.weights[:, 0]
    assert np.isfinite(course).all() and course[0] == pytest.approx(course[-1], abs=1e-7)


@pytest.mark.parametrize("closed", [True, False])
def test_a_seam_is_measured_where_a_round_leads(closed):
    """A point on a circle that travels and turns with the round, and is 3 mm off at its end."""
    cycle = Cycle(PERIOD, closed, 0.4, np.array([1.0, 0.0, 0.2]), 0.0)

    def at(sample: int) -> np.ndarray:
        phase = 2 * np.pi * sample / PERIOD
        return np.array([[0.1 * np.sin(phase), 0.1 * np.cos(phase), 0.0]])

    def ahead(points: np.ndarray) -> np.ndarray:
        return points @ cycle.turn.T + cycle.step

    begin, last = [at(0), at(1), at(2)], PERIOD if closed else PERIOD - 1
    smooth = seam(cycle, begin, [ahead(at(last - 1)), ahead(at(last))], FPS)
    second = np.linalg.norm(at(1) - 2 * at(0) + at(-1)) * FPS
    assert smooth.apart < (1e-12 if closed else 1e-3) and smooth.jump == pytest.approx(second, rel=1e-6)
    off = np.array([0.0, 0.003, 0.0])
    shifted = seam(cycle, begin, [ahead(at(last - 1)) + off, ahead(at(last)) + off], FPS)
    assert shifted.apart == pytest.approx(0.003, abs=1e-12 if closed else 1e-3)
