# SPDX-License-Identifier: Apache-2.0
"""Frames that are freed: sheets through each other, a fold, a limb through cloth, plates that leave no room."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from ssilk_core.physics.certify import certifier as module
from ssilk_core.physics.certify.certifier import Certifier, Frames, runs
from ssilk_core.physics.certify.crossings import contour_forces
from ssilk_core.physics.certify.faults import FaultFinder
from ssilk_core.physics.certify.metric import DisplacementMetric
from ssilk_core.physics.certify.settle import THICKNESS, Settler
from ssilk_core.physics.certify.untangle import HEIGHT, Untangler
from ssilk_core.physics.intersections.pairs import intersections_between, self_intersections
from ssilk_core.scene.assets import LOOSE, Body, Garment, Mesh, ProxyRig, Scene, SkinWeights

N, SIDE = 16, 0.16  # cells along a sheet, and its length [m]


def sheet(n: int = N) -> tuple[np.ndarray, np.ndarray]:
    """A square around the origin in the plane z = 0, two triangles in each of n x n cells."""
    y, x = (np.mgrid[: n + 1, : n + 1] / n - 0.5) * SIDE
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return points, np.concatenate([np.c_[a, a + 1, a + n + 1], np.c_[a + 1, a + n + 2, a + n + 1]])


def skin_of(path: str, count: int) -> SkinWeights:
    return SkinWeights(path, np.zeros((count, 1), dtype=int), np.ones((count, 1)))


def wearing(scene: Scene, points: np.ndarray, faces: np.ndarray, body: Mesh | None = None) -> Scene:
    """A garment, and at most one body, whose joints do not move."""
    garment = Garment(Mesh("/cloth", points, faces), skin_of("/cloth", len(points)), np.full(len(points), LOOSE))
    rig = ProxyRig("/rig", (), [], np.zeros((0, 4, 4)), skin_of("/rig", len(points)))
    bodies = () if body is None else (Body(body, skin_of("/body", body.vertex_count)),)
    return Scene(replace(scene.character, bodies=bodies), garment, rig)


@pytest.fixture(scope="module")
def layers(scene) -> Scene:
    """Two sheets, 10 mm apart."""
    points, faces = sheet()
    shifted = points + [0.0013, 0.0021, 0.01]
    return wearing(scene, np.concatenate([points, shifted]), np.concatenate([faces, faces + len(points)]))


def pushed(scene: Scene, depth: float) -> np.ndarray:
    """The lower of two sheets with a bump in its middle, that comes through the upper one by a depth [m]."""
    points = scene.garment.mesh.points.copy()
    lower = np.arange(len(points)) < len(points) // 2
    bump = np.exp(-(points[:, :2] ** 2).sum(axis=1) / 0.02**2)
    points[lower, 2] += (0.01 + depth) * bump[lower]
    return points


def still(scene: Scene, frames: list[np.ndarray], body: np.ndarray | None = None, cuts=frozenset()) -> Frames:
    turns = np.tile(np.eye(3), (scene.garment.mesh.vertex_count, 1, 1))
    return Frames(len(frames), 30.0, frames.__getitem__, lambda _: body, lambda _: turns, cuts)


def test_forces_pull_an_edge_out_of_a_face_the_short_way():
    # A triangle that stands upright through a large one in z = 0, its tip 1 below.
    face = np.array([[-10.0, -10, 0], [10, -10, 0], [0, 10, 0]])
    points = np.concatenate([face, [[-1.0, 0, 2], [1, 0, 2], [0, 0, -1]]])
    forces = contour_forces(points, np.array([[0, 1, 2], [3, 4, 5]]), np.array([[0, 1]]))
    assert forces[5, 2] > 0 and forces[:3, 2].sum() < 0  # apart along the normal
    assert np.allclose(forces.sum(axis=0), 0, atol=1e-12)  # both ends are pulled towards each other
    assert np.allclose(forces[3:, 0].sum(), 0, atol=1e-12) and abs(forces[5, 0]) < 1e-12  # by symmetry


def test_forces_open_triangles_with_a_common_vertex():
    points = np.array([[0.0, 0, 0], [4, -2, 0], [4, 2, 0], [2, 0.1, 1], [2, -0.2, -1]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    pairs = self_intersections(points, faces)
    assert pairs.tolist() == [[0, 1]]
    for _ in range(400):
        if not len(self_intersections(points, faces)):
            break
        points = points + 0.05 * contour_forces(points, faces, pairs)
    assert not len(self_intersections(points, faces))


@pytest.mark.parametrize("depth", [0.003, 0.015])
def test_sheets_pushed_through_each_other_come_apart(layers, depth):
    start = pushed(layers, depth)
    finder = FaultFinder(layers)
    assert finder.find(start, None).count
    mesh = layers.garment.mesh
    found = Untangler(mesh, finder).free(start, None)
    assert found.is_free and not len(self_intersections(found.points, mesh.faces))
    moved = np.linalg.norm(found.points - start, axis=1)
    assert 0.3 * depth < moved.max() < 3 * depth  # both sheets give way
    settler = Settler(mesh, finder, DisplacementMetric(mesh, 0.01))
    settled = settler.settle(found.points, start, found.moved, None)
    assert not len(self_intersections(settled, mesh.faces))
    away = np.linalg.norm(settled - start, axis=1)
    assert (away**2).sum() < (moved**2).sum()  # as near as contact lets it
    assert (settled[~found.moved] == start[~found.moved]).all()
    # The bump is beneath the other sheet again.
    tip = np.linalg.norm(start[: len(start) // 2, :2], axis=1).argmin()
    above = np.linalg.norm(start[len(start) // 2 :, :2] - start[tip, :2], axis=1).argmin() + len(start) // 2
    assert settled[tip, 2] < settled[above, 2]


def test_a_sheet_comes_out_of_the_one_beneath_which_stays(scene, layers):
    """The upper of two sheets is the garment, the lower one lies beneath it and comes through."""
    half = layers.garment.mesh.vertex_count // 2
    points, faces = layers.garment.mesh.points[half:], sheet()[1]
    below = pushed(layers, 0.006)[:half]
    worn = wearing(scene, points, faces)
    frames = replace(still(worn, [points, points]), beneath=lambda frame: below - [0, 0, 0.02 * frame])
    assert not Certifier(worn).faults(frames)  # alone nothing is wrong
    certifier = Certifier(worn, faces)
    faults = certifier.faults(frames)
    assert list(faults) == [0] and (faults[0].pairs[:, 0] < len(faces)).all()
    assert (faults[0].pairs[:, 1] >= len(faces)).all()
    found = certifier.certify(frames, faults)
    assert not found.left and found.points[0].shape == points.shape
    assert not len(intersections_between(found.points[0], faces, below, faces))
    assert not len(self_intersections(found.points[0], faces))
    away = found.points[0] - points
    assert 0.003 < away[:, 2].max() < 0.012 and np.linalg.norm(away, axis=1).min() < 1e-3  # over the bump alone
    tip = np.linalg.norm(points[:, :2], axis=1).argmin()
    assert found.points[0][tip, 2] > below[:, 2].max() - 1e-3  # on the side that it was on


def test_what_is_wanted_beyond_contact_ends_at_the_barrier(layers):
    mesh = layers.garment.mesh
    lower = np.arange(mesh.vertex_count) < mesh.vertex_count // 2
    target = mesh.points + np.where(lower[:, None], [0, 0, 0.012], 0.0)  # 2 mm through the upper sheet
    settler = Settler(mesh, FaultFinder(layers), DisplacementMetric(mesh, 0.01))
    settled = settler.settle(mesh.points, target, np.ones(len(target), dtype=bool), None)
    assert not len(self_intersections(settled, mesh.faces))
    gap = settled[~lower, 2].mean() - settled[lower, 2].mean()
    assert 0 < gap <= THICKNESS
    # Both sheets share the way: each is 1 mm from where it was wanted.
    assert settled[lower, 2].mean() == pytest.approx(0.011, abs=THICKNESS)


def test_a_fold_through_itself_opens(scene):
    points, faces = sheet()
    one = wearing(scene, points, faces)
    # The right half is folded over onto the left one, and a little through it.
    x, height = points[:, 0], np.interp(points[:, 0], [-SIDE / 2, 0, SIDE / 2], [0, 0, -0.004])
    turn = np.clip(x / 0.02, 0, np.pi)
    start = points.copy()
    start[:, 0] = np.where(x > 0, 0.02 * np.sin(turn) - np.maximum(x - 0.02 * np.pi, 0), x)
    start[:, 1] *= np.interp(x, [0, SIDE / 2], [1, 0.85])
    start[:, 2] = np.where(x > 0, 0.012 * (1 - np.cos(turn)) + 6.5 * height, 0)
    finder = FaultFinder(one)
    assert len(finder.find(start, None).pairs) > 10
    found = Certifier(one).certify(still(one, [start]), {0: finder.find(start, None)})
    assert not found.left and not len(self_intersections(found.points[0], faces))
    assert np.linalg.norm(found.points[0] - start, axis=1).max() < 0.02


@pytest.mark.slow
def test_cloth_that_a_limb_came_through_is_lifted_off_it(scene):
    limb = trimesh.creation.capsule(height=0.3, radius=0.05, count=[24, 24])
    tube = trimesh.creation.cylinder(radius=0.06, height=0.2, sections=32)
    tube = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(tube.vertices, tube.faces, 0.02))
    tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
    tube.remove_unreferenced_vertices()
    tube.merge_vertices()
    points = np.array(tube.vertices)
    limb.apply_translation(-limb.bounds.mean(axis=0))
    worn = wearing(scene, points, np.array(tube.faces), Mesh("/limb", limb.vertices, limb.faces))
    sunk = points.copy()
    dent = (points[:, 0] > 0.04) & (np.abs(points[:, 2]) < 0.04)
    sunk[dent, :2] *= 0.045 / 0.06  # 5 mm beneath the skin
    finder = FaultFinder(worn)
    skin = finder.place(np.array(limb.vertices))
    before = finder.find(sunk, skin)
    assert len(before.skin) > 20 and not len(before.pairs)
    assert (before.skin.height < 0).all() and before.skin.height.min() > -0.007
    found = Certifier(worn).certify(still(worn, [sunk], np.array(limb.vertices)), {0: before})
    assert not found.left and not finder.find(found.points[0], skin).count
    radius = np.linalg.norm(found.points[0][dent, :2], axis=1)
    assert radius.max() < 0.05 + 4 * HEIGHT  # as far as it must, no farther
    far = np.abs(points[:, 0]) < 0.01
    assert np.abs(found.points[0][far] - sunk[far]).max() < 3e-3


def test_cloth_between_plates_without_room_is_told_and_kept(scene):
    points, faces = sheet(6)
    near = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.35 * SIDE - [0, 0, 0.01]
    plates, square = np.concatenate([near, near + [0, 0, 0.02]]), np.array([[0, 1, 2], [0, 2, 3]])
    body = Mesh("/plates", plates, np.concatenate([square, square[:, ::-1] + len(near)]))  # both face the cloth
    worn = wearing(scene, points, faces, body)
    pinched = plates.copy()
    pinched[: len(near), 2] += 0.014  # each passes the other by 8 mm
    pinched[len(near) :, 2] -= 0.014
    certifier = Certifier(worn)
    frames = still(worn, [points, points], pinched)
    faults = certifier.faults(frames)
    assert list(faults) == [0, 1]
    found = certifier.certify(frames, faults)
    assert list(found.left) == [0, 1]
    assert all(found.left[frame].count <= faults[frame].count for frame in faults)
    assert all(np.isfinite(each).all() for each in found.points.values())


@pytest.fixture(scope="module")
def course(layers) -> list[np.ndarray]:
    """A bump that comes through the other sheet and goes again, in 40 frames."""
    return [pushed(layers, 0.012 * np.sin(np.pi * frame / 39) - 0.009) for frame in range(40)]


@pytest.mark.slow
def test_corrections_come_and_go_and_other_frames_stay(layers, course):
    certifier, frames = Certifier(layers), still(layers, course)
    faults = certifier.faults(frames)
    first, last = min(faults), max(faults)
    assert list(faults) == list(range(first, last + 1))
    found = certifier.certify(frames, faults)
    assert 10 < first <= last < 29
    assert not found.left and found.faulty == tuple(faults)
    ease = round(module.EASE * 30)
    assert set(faults) <= set(found.points) <= set(range(first - ease, last + ease + 1))
    assert min(found.points) < first and max(found.points) > last
    moved = [np.zeros_like(course[0]) for _ in course]
    for frame, points in found.points.items():
        moved[frame] = points - course[frame]
        assert not len(self_intersections(points, layers.garment.mesh.faces))
    steps = [np.linalg.norm(after - before, axis=1).max() for before, after in pairwise(moved)]
    largest = max(np.linalg.norm(each, axis=1).max() for each in moved)
    assert max(steps) < 0.5 * largest  # nothing appears at once


def test_the_same_frames_are_certified_alike(layers, course):
    some = course[14:18]
    frames = still(layers, some)
    one, other = (Certifier(layers).certify(frames, Certifier(layers).faults(frames)) for _ in range(2))
    assert one.points.keys() == other.points.keys() and one.points
    assert all((one.points[frame] == other.points[frame]).all() for frame in one.points)


def test_nothing_is_taken_along_over_a_cut(layers, course):
    certifier = Certifier(layers)
    frames = [course[0]] * 8 + course[17:20] + [course[0]] * 8
    apart = still(layers, frames, cuts=frozenset({8, 11}))
    found = certifier.certify(apart, certifier.faults(apart))
    assert list(found.points) == [8, 9, 10]


def test_runs_end_at_cuts():
    assert runs([3, 4, 5, 9, 10, 12], [5]) == [(3, 4), (5, 5), (9, 10), (12, 12)]
