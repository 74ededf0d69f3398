# SPDX-License-Identifier: Apache-2.0
"""What is said and drawn of a training, without Blender."""

from __future__ import annotations

import math

import numpy as np
import pytest

from blender_addon.arrays.curves import COLORS, GROUND, picture, series
from blender_addon.outside.jobs import JobState
from blender_addon.outside.training_report import compared, findings, improvement, progress

SCORE = {"total": 0.6, "collisions": 0.0123, "dynamics": 0.023}
CURVE = {"lbs": {"total": 1.0}, "points": [{"iteration": 5, "validation": SCORE}]}


@pytest.mark.parametrize(
    ("state", "told"),
    [
        (JobState("waiting"), "Waits until the trainings before it have ended"),
        (JobState("running"), "Prepares the training"),
        (JobState("running", 120, 500, 185.2), "120 of 500, 3 min left"),
        (JobState("running", 120, 500, 42.2), "120 of 500, 42 s left"),
        (JobState("running", 120, 500, 7380), "120 of 500, 2 h 3 min left"),
        (JobState("running", 1, 500), "1 of 500"),
        (JobState("running", 120, 500, 185.2, cancelled=True), "Ends after its current step"),
        (JobState("running", 600, 900, 65, round=1), "600 of 900, 1 min left"),
        (JobState("stopped", 600, 900, round=1), "Finished after 600 iterations; it can go on and get better"),
        (JobState("done", 900, 900, round=2), "Trained for 900 iterations, until it got no better"),
        (JobState("done", 500, 500), "Trained for 500 iterations"),
        (JobState("done", 420, 500), "Trained for 420 iterations"),
        (JobState("stopped", 120, 500), "Stopped at 120 of 500; it can be resumed"),
        (JobState("lost", 3, 9), "Ended without a word at 3 of 9, perhaps with the machine; resume it"),
        (JobState("failed", error="clip.usdc: no joints."), "clip.usdc: no joints."),
    ],
)
def test_progress_is_one_line(state, told):
    assert progress(state) == told


def test_validations_say_what_is_learned():
    running = JobState("running", checkpoint=5)
    assert findings(running, CURVE, moves=True) == [
        ("40.0% less energy than linear blend skinning", False),
        ("1.23% of the vertices inside the body", False),
        ("Dynamics are being learned: 23 mm of motion of its own", False),
        ("Best model: from iteration 5; play it live or bake it to see it on your shot", False),
    ]
    shown = {**CURVE["points"][0]["validation"], "shown_skin": {"mean": 0.0078, "worst": 0.02, "bare": 0.5}}
    told = findings(running, {**CURVE, "points": [{"iteration": 5, "validation": shown}]}, moves=True)
    assert told[2:4] == [
        ("0.78% of the covered skin shows, 2.00% in the worst frame", False),
        ("50.00% of it is bare: no cloth is near", False),
    ]
    stiff = {**CURVE, "points": [{"iteration": 5, "validation": {**SCORE, "total": 1.5, "dynamics": 0.0019}}]}
    told = findings(running, stiff, moves=True)
    assert ("50.0% more energy than linear blend skinning", True) in told
    assert ("Nothing dynamic is being learned: train longer, or check that the motions move", True) in told
    assert not any("ynamic" in text for text, _ in findings(running, stiff, moves=False))
    assert findings(running, {}, moves=True)[0][0].startswith("No validation yet")
    assert findings(JobState("stopped"), {}, moves=True) == []


def test_what_a_training_has_reached_is_told_beside_where_it_began():
    points = [
        {"iteration": done, "validation": {**SCORE, "shown_skin": {"mean": mean, "worst": 0.1, "bare": 0.14}}}
        for done, mean in ((5, 0.0231), (9, 0.0084), (12, 0.0099))
    ]
    state = JobState("running", checkpoint=9, round=2, spent=840)
    assert improvement(state, {**CURVE, "points": points}) == [
        "0.84% of the covered skin shows, 2.31% at first; 14.00% is bare",
        "Gets better until you finish it: 14 min so far",
    ]  # fmt: skip
    assert improvement(JobState("running", checkpoint=5), {**CURVE, "points": points[:1]}) == [
        "2.31% of the covered skin shows; 14.00% is bare"
    ]
    assert improvement(JobState("running", checkpoint=5), CURVE) == ["40.0% less energy than linear blend skinning"]
    assert improvement(state, {}) == []


def test_series_leave_out_what_is_not_finite():
    found = series(
        [(1, {"stretch": 2.0}), (2, {"stretch": None, "inertia": 0.5}), (3, {"stretch": 1.0, "drag": None})]
    )
    assert {name: rows.tolist() for name, rows in found.items()} == {
        "stretch": [[1, 2], [3, 1]],
        "inertia": [[2, 0.5]],
    }


def test_a_picture_shows_each_line_where_it_is():
    rising, flat = np.array([[0, 0.0], [10, math.sinh(1)]]) * [1, 1e-3], np.array([[0, 0.0], [10, 0.0]])
    image = picture([rising, flat], 64)
    assert image.shape == (64, 64, 4)
    assert (image[..., 3] == 1).all()
    marked = [np.isclose(image[..., :3], color).all(-1) for color in COLORS[:2]]
    rows = [np.argmax(marked[0][:, column]) for column in (20, 40, 63)]
    assert rows[0] < rows[1] < rows[2] >= 58
    assert marked[1][:3, 5:].all()
    assert not marked[1][3:].any()
    np.testing.assert_array_equal(image[60, 3], GROUND)


def test_pictures_of_nothing_and_of_one_point_are_drawn():
    assert (picture([], 8) == GROUND).all()
    assert (picture([np.array([[3, 0.1]])], 8)[..., :3] == COLORS[0]).all(-1).any()


def test_a_line_begins_where_its_term_does():
    early, late = np.array([[0, 0.0], [10, 0.0]]), np.array([[5, 1.0], [10, 1.0]])
    image = picture([early, late], 65)
    columns = np.flatnonzero(np.isclose(image[..., :3], COLORS[1]).all(-1).any(axis=0))
    assert (columns[0], columns[-1]) == (32, 64)


@pytest.mark.parametrize(
    ("total", "lbs", "told", "worse"),
    [
        (-0.007, 1.0, "over 100% less energy than linear blend skinning", False),
        (-2.0, -1.0, "100.0% less energy than linear blend skinning", False),
        (-1.0, -2.0, "50.0% more energy than linear blend skinning", True),
    ],
)
def test_energies_below_zero_are_no_more_than_all_lower(total, lbs, told, worse):
    assert compared(total, lbs) == (told, worse)
