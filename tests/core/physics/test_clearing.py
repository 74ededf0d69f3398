# SPDX-License-Identifier: Apache-2.0
"""Cloth that is lifted off the skin: against a dense solution, and on a ball in a shell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.refine import clearing as module
from ssilk_core.physics.refine.clearing import (
    DEEPEST,
    FARTHEST,
    HEIGHT,
    SHALLOWEST,
    STIFFER,
    SkinClearing,
    winding_number,
)
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import State
from ssilk_core.scene.assets import LOOSE, PINNED, Body, Garment, Mesh, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import Fabric

RADIUS, GAP, DEPTH = 0.2, 0.02, 0.006  # of a ball and the shell around it, and of a dent in the shell [m]
CAP = 0.9  # cosine of the angle of the dent


def skin_of(path: str, count: int) -> SkinWeights:
    return SkinWeights(path, np.zeros((count, 1), dtype=int), np.ones((count, 1)))


@pytest.fixture(scope="module")
def shell(scene) -> Scene:
    """A ball in a loose shell; the lower half of the shell is pinned."""
    ball, cloth = (trimesh.creation.icosphere(subdivisions=3, radius=radius) for radius in (RADIUS, RADIUS + GAP))
    count = len(cloth.vertices)
    garment = Garment(
        Mesh("/shell", cloth.vertices, cloth.faces),
        skin_of("/shell", count),
        np.where(cloth.vertices[:, 2] < 0, PINNED, LOOSE),
    )
    body = Body(Mesh("/ball", ball.vertices, ball.faces), skin_of("/ball", len(ball.vertices)))
    rig = ProxyRig("/rig", (), [], np.zeros((0, 4, 4)), skin_of("/rig", count))
    return Scene(replace(scene.character, bodies=(body,)), garment, rig)


@pytest.fixture(autouse=True)
def fewer_points(monkeypatch) -> None:
    monkeypatch.setattr(module, "POINTS", 8001)  # a ball needs no more


def dented(shell: Scene, axis: int, depth: float = DEPTH) -> torch.Tensor:
    """The shell with a cap around an axis beneath the skin, shape (V, 3, 1)."""
    points = shell.garment.mesh.points
    sunk = points * ((RADIUS - depth) / (RADIUS + GAP))
    return torch.tensor(np.where(points[:, axis, None] > CAP * (RADIUS + GAP), sunk, points))[:, :, None]


def at_rest(shell: Scene) -> tuple[IncrementalPotential, StepInputs]:
    potential = IncrementalPotential(shell, Fabric("toy"), device=torch.device("cpu"))
    joints = shell.character.skeleton.joint_count
    body = CollisionBody(shell.character.merged_body(), joints, device="cpu")
    still = torch.eye(3, 4)[None, :, :, None].repeat(joints, 1, 1, 1)
    return potential, StepInputs(body.pose(still, exact=True), torch.zeros(3, 1, dtype=torch.float64))


def test_a_dent_is_lifted_and_the_rest_stays(shell):
    potential, inputs = at_rest(shell)
    clearing, x = SkinClearing(shell, potential), dented(shell, 2)
    before = clearing._lifts(x, inputs.body)
    assert 50 < before.shown.item() == len(before.frame)
    assert before.gap.max().item() == pytest.approx(DEPTH + HEIGHT, abs=5e-4)
    unbounded = torch.full((1,), torch.inf)
    found = clearing.lift(x, inputs, unbounded)
    after = clearing._lifts(found, inputs.body)
    assert after.shown.item() == 0
    moved = (found - x).norm(dim=1)[:, 0]
    assert 0.8 * (DEPTH + HEIGHT) < moved.max() < 3 * (DEPTH + HEIGHT)
    dent = (x[:, :, 0] != torch.tensor(shell.garment.mesh.points)).any(1)
    assert moved[~dent].mean() < 0.3 * moved[dent].mean() and not moved[shell.classes == PINNED].any()
    assert torch.equal(clearing.lift(found, inputs, unbounded), found)


def test_frames_are_lifted_each_by_itself_within_their_energy(shell):
    potential, inputs = at_rest(shell)
    clearing, calm = SkinClearing(shell, potential), torch.tensor(np.array(shell.garment.mesh.points))[:, :, None]
    frames = [dented(shell, 2), dented(shell, 0), calm, dented(shell, 1, depth=0.009)]
    most = torch.tensor([torch.inf, -torch.inf, 0.0, torch.inf])
    body = inputs.body.select(torch.zeros(4, dtype=torch.int64))
    found = clearing.lift(torch.cat(frames, -1), StepInputs(body, inputs.gravity.expand(3, 4)), most)
    for number, (x, bound) in enumerate(zip(frames, most)):
        alone = clearing.lift(x, inputs, bound[None])
        np.testing.assert_allclose(found[..., number], alone[..., 0], atol=5e-5)
        moved = (found[..., number] - x[..., 0]).norm(dim=1).max().item()
        assert 1e-3 < moved <= FARTHEST + 1e-6 if bound == torch.inf else moved == 0
    free = clearing.lift(frames[0], inputs, most[:1])
    less = State.at(potential, free, inputs).energy - 1e-6
    assert not torch.equal(clearing.lift(frames[0], inputs, less), free)


def test_pinned_and_deep_cloth_is_left(shell):
    potential, inputs = at_rest(shell)
    clearing, points = SkinClearing(shell, potential), shell.garment.mesh.points
    pinned = torch.tensor(np.where(points[:, 2:] < -CAP * (RADIUS + GAP), 0.9, 1.0) * points)[:, :, None]
    lifts = clearing._lifts(pinned, inputs.body)
    assert lifts.shown.item() > 50 and not lifts.asking.any()
    assert torch.equal(clearing.lift(pinned, inputs, torch.full((1,), torch.inf)), pinned)
    deep = clearing._lifts(dented(shell, 2, depth=1.4 * DEEPEST), inputs.body)
    assert len(deep.frame) < 0.5 * deep.shown.item() and deep.gap.max() <= DEEPEST + HEIGHT


def test_a_frame_that_does_not_gain_lifts_cloth_that_lies_less_deep(monkeypatch, shell):
    potential, inputs = at_rest(shell)
    clearing, x, asked = SkinClearing(shell, potential), dented(shell, 2), []
    within = module.Lifts.within

    def spy(lifts, depth):
        asked.append(within(lifts, depth))
        return asked[-1]

    monkeypatch.setattr(module.Lifts, "within", spy)
    assert torch.equal(clearing.lift(x, inputs, torch.full((1,), -torch.inf)), x)
    depths = [lifts.deepest.item() for lifts in asked]
    assert depths[0] == pytest.approx(DEPTH, abs=5e-4) and depths == sorted(depths, reverse=True)
    assert all(later <= DEPTH / 2 for later in depths[1:]) and DEPTH / 4 < SHALLOWEST


def test_a_frame_that_gains_goes_on_however_little_is_left(monkeypatch, shell):
    potential, inputs = at_rest(shell)
    clearing, x = SkinClearing(shell, potential), dented(shell, 2)
    step, rounds = clearing._step, []

    def short_step(state, inputs, lifts):
        rounds.append(lifts.shown.item())
        return 0.7 * step(state, inputs, lifts)

    monkeypatch.setattr(clearing, "_step", short_step)
    monkeypatch.setattr(module, "SHALLOWEST", 1.0)  # all cloth lies less deep
    found = clearing.lift(x, inputs, torch.full((1,), torch.inf))
    assert len(rounds) > 1 and rounds[1] < rounds[0]
    assert clearing._lifts(found, inputs.body).shown.item() < 0.5 * rounds[1]


def test_a_round_gains_where_enough_of_what_asks_is_covered(monkeypatch, shell):
    potential, inputs = at_rest(shell)
    clearing, x, unbounded = SkinClearing(shell, potential), dented(shell, 2), torch.full((1,), torch.inf)
    for least, lifted in ((0.5, True), (1e3, False)):
        monkeypatch.setattr(module, "LEAST_GAIN", least)
        assert torch.equal(clearing.lift(x, inputs, unbounded), x) != lifted


def test_what_cannot_rise_does_not_hold_the_rest_back(shell):
    potential, inputs = at_rest(shell)
    clearing, points = SkinClearing(shell, potential), torch.tensor(shell.garment.mesh.points)[:, :, None]
    band = (shell.classes == PINNED)[:, None, None] & (points.numpy() < -0.5 * RADIUS)[:, 2:]
    x = dented(shell, 2).where(~torch.tensor(band), 0.9 * points)
    before = clearing._lifts(x, inputs.body)
    assert 0 < before.asking.item() < 0.3 * before.shown.item()
    after = clearing._lifts(clearing.lift(x, inputs, torch.full((1,), torch.inf)), inputs.body)
    assert after.asking.item() == 0 and after.shown.item() <= before.shown.item() - before.asking.item()


def test_a_vertex_that_moved_as_far_as_it_may_does_not_stop_the_others(monkeypatch, shell):
    potential, inputs = at_rest(shell)
    clearing, x = SkinClearing(shell, potential), dented(shell, 2)
    step, far = clearing._step, int((x[:, 2, 0]).argmax())

    def step_with_a_leap(state, inputs, lifts):
        found = step(state, inputs, lifts)
        found[far] *= 100
        return found

    monkeypatch.setattr(clearing, "_step", step_with_a_leap)
    moved = (clearing.lift(x, inputs, torch.full((1,), torch.inf)) - x).norm(dim=1)[:, 0]
    assert moved[far].item() == pytest.approx(FARTHEST)
    assert moved[torch.arange(len(moved)) != far].max() > 0.8 * (DEPTH + HEIGHT)


def test_frames_take_the_lifts_of_others_and_their_own(shell):
    potential, inputs = at_rest(shell)
    clearing = SkinClearing(shell, potential)
    one, two = (clearing._lifts(torch.cat([dented(shell, axis)] * 2, -1), twice(inputs)) for axis in (0, 2))
    mixed = one.where(torch.tensor([False, True]), two)
    for frame, source in ((0, two), (1, one)):
        part, whole = (lifts.select(torch.tensor([frame])) for lifts in (mixed, source))
        for name in module.ROWS:
            assert torch.equal(getattr(part, name), getattr(whole, name))
        assert part.shown.item() == whole.shown.item()


def twice(inputs: StepInputs):
    """The body of a frame in two frames."""
    return inputs.body.select(torch.zeros(2, dtype=torch.int64))


def test_skin_inside_another_part_asks_for_nothing(shell):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    other = Body(
        Mesh("/other", ball.vertices + [0, 0, 1.5 * RADIUS], ball.faces), skin_of("/other", len(ball.vertices))
    )
    shown = []
    for more in ((), (other,)):
        two = replace(shell, character=replace(shell.character, bodies=(*shell.character.bodies, *more)))
        potential, inputs = at_rest(two)
        shown.append(SkinClearing(two, potential)._lifts(dented(shell, 2), inputs.body).shown.item())
    assert shown[1] < 0.2 * shown[0]


def test_a_step_is_that_of_a_dense_solution(monkeypatch, shell):
    monkeypatch.setattr(module, "REDUCTION", 1e-6)  # soft modes, which cost little, converge last
    potential, inputs = at_rest(shell)
    clearing, x = SkinClearing(shell, potential), dented(shell, 2)
    lifts, state = clearing._lifts(x, inputs.body), State.at(potential, x, inputs)
    matrix = potential.hessian(x, inputs, state.body_distance)
    dense = matrix.rows.to_dense().double().numpy()
    right, place = np.zeros(len(dense)), potential.block_pattern.place
    diagonal = dense.diagonal().reshape(-1, 3).mean(axis=1)
    for face, weights, normal, gap in zip(lifts.face, lifts.weights, lifts.normal, lifts.gap):
        corners = place[shell.garment.mesh.faces[face]]
        row = np.zeros(len(dense))
        for corner, weight in zip(corners, weights.tolist()):
            if corner >= 0:
                row[3 * corner : 3 * corner + 3] = weight * normal.double().numpy()
        spring = STIFFER * diagonal[corners[corners >= 0]].max()
        dense += spring * np.outer(row, row)
        right += spring * gap.item() * row
    expected = np.zeros(x.shape[:2])
    expected[potential.free] = np.linalg.solve(dense, right).reshape(-1, 3)
    np.testing.assert_allclose(clearing._step(state, inputs, lifts)[:, :, 0], expected, atol=1e-5)
    assert np.abs(expected).max() > DEPTH


def test_surfaces_wind_around_what_they_enclose():
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    corners = cube.vertices[cube.faces]
    places = np.array([[0, 0, 0], [0.4, 0.3, -0.4], [0.7, 0, 0], [3, 2, 1]])
    found = winding_number(torch.tensor(corners[None] - places[:, None, None]))
    np.testing.assert_allclose(found, [1, 1, 0, 0], atol=1e-12)
    twice = torch.tensor(np.concatenate([corners, 2 * corners])[None])
    assert winding_number(twice).item() == pytest.approx(2)
