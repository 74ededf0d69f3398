# SPDX-License-Identifier: Apache-2.0
"""Refining a rollout of the toy world: monotone, what it looks back on, and where it ends."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.physics.refine import RefinementMeans, RefineOptions, Refiner, clearing
from ssilk_core.physics.simulate import SimulationOptions, quasi_static_states, simulate
from ssilk_core.physics.simulate.newton import SolverOptions
from ssilk_core.scene.assets import PINNED
from ssilk_core.scene.fabrics import Fabric

pytestmark = pytest.mark.usefixtures("few_contacts")

CLOTH = Fabric("toy", bending=1e-4, margin=0.01)
ROUGH = replace(CLOTH, friction=0.4)
FRAMES = 9


@pytest.fixture(scope="module")
def rollout(scene, toy_model, toy_motion):
    """A motion and the network's vertices over it, some of them inside the ball."""
    model, motion = toy_model(scene, scale=0.2, feedback_points=0), toy_motion(scene, FRAMES)
    points = np.concatenate([decode(model, motion, pose) for pose in garment_poses(model, motion, 30.0)])
    points[:, scene.classes != PINNED] += [0, 0, 0.08]
    return motion, points


KEPT: dict[tuple[object, ...], tuple[object, ...]] = {}  # with what it is of, whose place in memory is in the key


def refined(scene, motion, points, cloth=CLOTH, **options):
    """Refined vertices (F, V, 3) and what was changed in each frame; what several tests ask for is computed once."""
    key = id(scene), id(motion), id(points), cloth, clearing.ROUNDS, *sorted(options.items())
    if key not in KEPT:
        frames = list(Refiner(scene, cloth, RefineOptions(**options), fps=motion.fps).frames(motion, points))
        changed = np.stack([frame.points for frame in frames]), [frame.change for frame in frames]
        KEPT[key] = (*changed, scene, motion, points)
    return KEPT[key][:2]


def test_no_frame_gains_energy_with_more_iterations(scene, rollout) -> None:
    motion, points = rollout
    found = [refined(scene, motion, points, iterations=n)[1] for n in (1, 3, 9)]
    for few, more in pairwise(found):
        assert all(a.before == pytest.approx(b.before, abs=1e-12) for a, b in zip(few, more))
        assert all(b.after <= a.after + 1e-12 for a, b in zip(few, more))
    assert all(change.after < change.before for change in found[0])


def test_vertices_come_out_of_the_body(scene, rollout) -> None:
    _, changes = refined(scene, *rollout, iterations=9)
    summary = RefinementMeans(changes).figures()
    assert summary["inside the body before"] > 0.01 and summary["inside the body"] < 0.002
    assert summary["energy [J]"] < summary["energy before [J]"]


@pytest.mark.parametrize("feedback", [False, True])
def test_pinned_vertices_stay_and_what_moved_is_stated(scene, rollout, feedback) -> None:
    motion, points = rollout
    found, changes = refined(scene, motion, points, iterations=3, feedback=feedback)
    pinned = scene.classes == PINNED
    np.testing.assert_allclose(found[:, pinned], points[:, pinned], atol=2e-6)
    largest = np.linalg.norm(found - points, axis=-1).max(axis=1)
    assert all(0 < change.moved < most for change, most in zip(changes, largest))


@pytest.mark.parametrize("rounds, close", [(0, 1e-6), (clearing.ROUNDS, 5e-4)], ids=["solved", "lifted too"])
def test_without_feedback_a_stretch_by_itself_comes_out_alike(monkeypatch, scene, rollout, rounds, close) -> None:
    # Lifts end where a linear solve in single precision does, each to 1e-4 of some centimetres.
    monkeypatch.setattr(clearing, "ROUNDS", rounds)
    motion, points = rollout
    whole, _ = refined(scene, motion, points, iterations=3, batch=4)
    one_by_one, _ = refined(scene, motion, points, iterations=3, batch=1)
    part, _ = refined(scene, motion.clip(3, 8), points[3:8], iterations=3)
    np.testing.assert_allclose(one_by_one, whole, atol=close)
    np.testing.assert_allclose(part[1:], whole[4:8], atol=close)  # the first has no past, and no drag


def on_the_ball(scene):
    """The scene with a garment that touches the body, on which it rubs."""
    mesh = scene.garment.mesh
    near = replace(mesh, points=mesh.points + [0, 0, 0.07])
    return replace(scene, garment=replace(scene.garment, mesh=near))


@pytest.mark.slow
def test_with_feedback_it_becomes_the_simulator(scene, rollout) -> None:
    motion, points, scene = rollout[0].clip(0, 4), rollout[1][:4], on_the_ball(scene)
    solver = SolverOptions(tolerance=1e-3, iterations=200)
    options = SimulationOptions(solver=solver, quasi_static_solver=solver)
    (expected,) = simulate(scene, ROUGH, [motion], options)
    start = points.copy()
    start[0] = quasi_static_states(scene, ROUGH, motion.clip(0, 1), options)[0]  # what the simulator begins with
    found, changes = refined(scene, motion, start, ROUGH, iterations=200, tolerance=1e-3, feedback=True)
    assert max(change.residual for change in changes) < 1e-3
    np.testing.assert_allclose(found, expected, atol=5e-4)
    (smooth,) = simulate(scene, CLOTH, [motion], options)
    assert np.abs(smooth - expected).max() > 2e-3  # so that friction is seen
    alone, _ = refined(scene, motion, start, ROUGH, iterations=20, tolerance=1e-3)
    assert np.abs(alone - expected).max() > 1e-3


def jitter(points):
    """RMS third difference of vertices (F, V, 3) [m]."""
    return np.sqrt((np.diff(points, 3, axis=0) ** 2).sum(-1).mean())


@pytest.fixture(scope="module")
def shaken(scene, rollout):
    """The rollout with a loose garment that goes to and fro by 20 mm, from frame to frame."""
    motion, points = rollout
    away = np.where(np.arange(FRAMES) % 2, 0.02, 0.0)[:, None, None] * [1, 0, 0]
    return motion, points + away * (scene.classes != PINNED)[:, None]


def test_without_feedback_jitter_of_the_network_is_not_amplified(scene, shaken) -> None:
    found, _ = refined(scene, *shaken, iterations=8)
    assert jitter(found) < 1.2 * jitter(shaken[1])  # the ball adds some


def test_with_feedback_jitter_of_the_network_is_left_behind(scene, rollout, shaken) -> None:
    smooth, rough = (refined(scene, *each, iterations=3, feedback=True)[0] for each in (rollout, shaken))
    assert jitter(rough) < 1.1 * jitter(smooth) < 0.1 * jitter(shaken[1])


def test_with_feedback_a_shot_begins_at_rest(scene, rollout) -> None:
    motion, points = rollout
    _, changes = refined(scene, motion, points, iterations=1, feedback=True)
    assert changes[0].residual < RefineOptions(iterations=1).tolerance < changes[1].residual
    _, alone = refined(scene, motion, points, iterations=1)
    assert alone[0].residual > changes[0].residual


@pytest.mark.slow
def test_shots_at_once_are_what_each_is_by_itself(scene, rollout) -> None:
    motion, points, scene = *rollout, on_the_ball(scene)
    shots = [(motion, points), (motion.clip(3, FRAMES), points[3:])]
    refiner = Refiner(scene, ROUGH, RefineOptions(iterations=3, feedback=True), fps=motion.fps)
    frames = list(refiner.shots_at_once(*zip(*shots)))
    assert [len(frame) for frame in frames] == [2] * (FRAMES - 3) + [1] * 3
    for number, shot in enumerate(shots):
        found = np.stack([frame[number].points for frame in frames if len(frame) > number])
        alone, changes = refined(scene, *shot, ROUGH, iterations=3, feedback=True)
        assert np.abs(found - alone).max() < 1e-4  # steps that do not converge amplify rounding
        assert frames[2][number].change.after == pytest.approx(changes[2].after, rel=1e-4)
    with pytest.raises(SsilkError, match="the longest first"):
        next(refiner.shots_at_once(*zip(*shots[::-1])))
    with pytest.raises(SsilkError, match="without feedback"):
        next(Refiner(scene, CLOTH, RefineOptions(iterations=3), fps=motion.fps).shots_at_once(*zip(*shots)))


def test_a_cut_is_not_looked_back_over(scene, rollout) -> None:
    motion, points = rollout
    moved = motion.translations.copy()
    moved[5:, 0] += [20.0, 0.0, 0.0]
    points = points + np.where(np.arange(FRAMES) >= 5, 20.0, 0.0)[:, None, None] * [1, 0, 0]
    cut = replace(motion, translations=moved)
    found, _ = refined(scene, cut, points, iterations=2, feedback=True, tolerance=0.05)
    after, _ = refined(scene, cut.clip(5, FRAMES), points[5:], iterations=2, feedback=True, tolerance=0.05)
    np.testing.assert_allclose(found[5:], after, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"), [({"iterations": 0}, "1 to 10000"), ({"iterations": 2, "batch": 0}, "at least 1")]
)
def test_options_that_cannot_be_are_refused(change, words) -> None:
    with pytest.raises(SsilkError, match=words):
        RefineOptions(**change)


def test_what_does_not_fit_is_refused(scene, rollout) -> None:
    motion, points = rollout
    refiner = Refiner(scene, CLOTH, RefineOptions(iterations=1), fps=60.0)
    with pytest.raises(SsilkError, match="30 frames per second; 60 is needed"):
        next(refiner.frames(motion, points))
    broken = points.copy()
    broken[0, 3] = np.nan
    with pytest.raises(SsilkError, match="first state of 1 of 1 frames has no finite energy"):
        refined(scene, motion, broken, iterations=1)


def test_with_feedback_a_network_state_that_is_not_finite_is_refused(scene, rollout) -> None:
    motion, points = rollout
    broken = points.copy()
    broken[3, np.flatnonzero(scene.classes != PINNED)[0]] = np.nan  # the simulator's own starts are finite there
    with pytest.raises(SsilkError, match="first state of 1 of 1 frames has no finite energy"):
        refined(scene, motion, broken, iterations=1, feedback=True, tolerance=0.05)
