# SPDX-License-Identifier: Apache-2.0
"""Triangles that intersect others: against closed forms, and against a slow test of all pairs in float64."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssilk_core.physics.intersections.cloth import TOGETHER, ClothIntersections
from ssilk_core.physics.intersections.figures import SelfIntersections
from ssilk_core.physics.intersections.pairs import intersections_between, self_intersections
from ssilk_core.scene.assets import Garment, Mesh, Scene, SkinWeights


def sheet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit square of n x n cells in the plane z = 0, two triangles in each."""
    y, x = np.mgrid[: n + 1, : n + 1] / n
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return points, np.concatenate([np.c_[a, a + 1, a + n + 1], np.c_[a + 1, a + n + 2, a + n + 1]])


def volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
    return float(np.linalg.det(np.stack([b - a, c - a, d - a])))


def meets(p: np.ndarray, q: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether a segment has a point in common with a triangle, in general position."""
    if volume(*triangle, p) * volume(*triangle, q) > 0:
        return False
    sides = [volume(p, q, triangle[i], triangle[i - 2]) for i in range(3)]
    return all(side >= 0 for side in sides) or all(side <= 0 for side in sides)


def slow_pairs(points: np.ndarray, faces: np.ndarray) -> list[list[int]]:
    """The pairs that intersect, in general position: neighbours with a common edge never do."""
    found = []
    for (f, one), (g, other) in combinations(enumerate(faces.tolist()), 2):
        shared = set(one) & set(other)
        edges = [
            (edge, across)
            for corners, across in ((one, other), (other, one))
            for edge in combinations(corners, 2)
            if not shared & set(edge)
        ]
        if len(shared) < 2 and any(meets(*points[list(edge)], points[across]) for edge, across in edges):
            found.append([f, g])
    return found


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), crumpled=st.floats(0.05, 1.0))
def test_pairs_are_those_of_a_test_of_all(seed, crumpled):
    points, faces = sheet(3)
    points = points + crumpled * np.random.default_rng(seed).normal(size=points.shape)
    assert self_intersections(points, faces).tolist() == slow_pairs(points, faces)
    left, right = faces[:9], faces[9:]
    apart = points + [0.1, 0.05, 0.02]
    both = np.concatenate([points, apart])
    between = [[f, g - 9] for f, g in slow_pairs(both, np.concatenate([left, right + len(points)])) if f < 9 <= g]
    assert intersections_between(points, left, apart, right).tolist() == between


def crossing(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Two sheets of n x n cells, one upright through the other, along a line within a row of cells of each."""
    points, faces = sheet(n)
    upright = np.stack([points[:, 0], 0 * points[:, 1] + 0.5 + 0.25 / n, points[:, 1] - 0.5 - 0.25 / n], axis=-1)
    return np.concatenate([points, upright]), np.concatenate([faces, faces + len(points)])


@pytest.mark.parametrize("n", [3, 5])
def test_crossing_sheets_intersect_in_a_row_of_cells_of_each(n):
    points, faces = crossing(n)
    half = len(points) // 2
    found = self_intersections(points, faces)
    rows = np.unique(found[:, 0]), np.unique(found[:, 1]) - len(faces) // 2
    assert all(len(row) == 2 * n for row in rows)  # both triangles of n cells
    own = faces[: len(faces) // 2]
    assert np.array_equal(intersections_between(points[:half], own, points[half:], own), found - [0, len(own)])


def folded(points: np.ndarray, angle: float) -> np.ndarray:
    """A sheet whose half beyond x = 1/2 is turned about this line."""
    over = np.maximum(points[:, 0] - 0.5, 0)
    return np.column_stack([points[:, 0].clip(max=0.5) + over * np.cos(angle), points[:, 1], over * np.sin(angle)])


def test_a_fold_intersects_where_it_is_flat_alone():
    points, faces = sheet(4)
    for angle in (0.0, 1.0, 3.1, np.pi - 1e-6, -3.1):
        assert not len(self_intersections(folded(points, angle), faces))
    flat = self_intersections(np.round(folded(points, np.pi), 12), faces)
    assert set(flat.flat) == set(range(len(faces)))
    # Around one vertex: a corner of the sheet is turned through a triangle that shares only the vertex with its own.
    fan = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.2, -0.5], [0.2, 0.5, 0.5]])
    assert self_intersections(fan, np.array([[0, 1, 2], [0, 3, 4]])).tolist() == [[0, 1]]
    fan[3:, :2] *= -1
    assert not len(self_intersections(fan, np.array([[0, 1, 2], [0, 3, 4]])))


def dressed_in(scene: Scene, points: np.ndarray, faces: np.ndarray) -> Scene:
    """The toy character in another garment, whose vertices beyond x = 1/2 are on the second joint."""
    joints = (points[:, :1] > 0.5).astype(int)
    skin = SkinWeights("/sheet", joints, np.ones((len(points), 1)))
    garment = Garment(Mesh("/sheet", points, faces), skin, np.full(len(points), 2))
    return replace(scene, garment=garment, rig=replace(scene.rig, skin=skin))


def test_figures_are_of_frames_with_the_worst_and_where(scene):
    points, faces = sheet(4)
    points = points + 0.01 * np.random.default_rng(1).normal(size=points.shape)
    cloth = ClothIntersections.of(dressed_in(scene, points, faces))
    through = points.copy()
    through[-2:] = [0.3, 0.36, 0.1], [0.31, 0.3, -0.1]  # a corner, pulled through the sheet
    share = len(set(np.ravel(slow_pairs(through, faces)))) / len(faces)
    assert 0 < share < 0.5
    lost = np.full_like(points, np.nan)
    calm = cloth.counts([points, points], [0, 4])
    found = cloth.figures([("calm", calm), ("turn", cloth.counts([points, through], [100, 104]))])
    assert (found.frames, found.triangles, found.clip, found.frame) == (4, len(faces), "turn", 104)
    assert found.worst == pytest.approx(share) and found.mean == pytest.approx(share / 4)
    unknown = ClothIntersections(cloth.mesh)  # of no joints
    assert unknown.figures([("a", unknown.counts([through], [0]))]).regions == {}
    hit = cloth.triangles(through)
    turned = cloth.regions[hit].mean()
    assert found.regions == pytest.approx({"Hips": 1 - turned, "Spine": turned}) and turned > 0
    assert str(found).startswith(f"{share / 4:.3%} of the triangles intersect others, {share:.2%} in the worst of 4")
    assert found.summary()["most in one frame"] == f"{share:.2%}, turn at frame 104"
    assert cloth.figures([("lost", cloth.counts([points, lost], [0, 4]))]).worst == 1
    still = cloth.figures([("calm", calm)])
    assert (still.mean, still.worst, still.regions) == (0, 0, {}) and "worst" not in str(still)
    assert not {"most in one frame", "mostly at"} & still.summary().keys()
    assert SelfIntersections(**found.to_metadata()) == replace(
        found, **{name: pytest.approx(value, rel=1e-3) for name, value in asdict(found).items()
                  if isinstance(value, float | dict)}
    )  # fmt: skip


def test_nothing_counts_at_rest_and_what_crosses_there_counts_elsewhere(scene):
    points, faces = crossing(4)
    cloth = ClothIntersections.of(dressed_in(scene, points, faces))
    assert len(self_intersections(points, faces)) and not cloth.triangles(points).any()
    half = len(points) // 2
    moved = np.concatenate([points[:half], points[half:] + [0, -0.25, 0]])  # on to the next row
    assert cloth.triangles(moved).sum() == 2 * 8 and cloth.triangles(points + [1, 2, 3]).sum() == 0


def slit(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A sheet that is cut along a part of x = 1/2, where both sides have vertices of their own at the same places."""
    seam = np.flatnonzero((points[:, 0] == 0.5) & (points[:, 1] < 0.7))
    beyond = points[faces][:, :, 0].max(axis=1) > 0.5
    own = np.arange(len(points))
    own[seam] = len(points) + np.arange(len(seam))
    return np.concatenate([points, points[seam]]), np.where(beyond[:, None], own[faces], faces)


def test_a_seam_of_doubled_vertices_is_one_as_long_as_it_is_closed(scene):
    points, faces = slit(*sheet(4))
    assert len(self_intersections(points, faces))  # triangles touch, and have no vertex in common
    cloth = ClothIntersections.of(dressed_in(scene, points, faces))
    for angle in (0.0, 1.0, 3.1):
        assert not cloth.triangles(folded(points, angle)).any()
    for gap, crossed in ((0.9 * TOGETHER, False), (0.05, True)):
        overlapping = points.copy()
        overlapping[25:, 0] -= gap  # the border beyond slides past the other, on both sides of it
        overlapping[25:, 2] += gap * np.array([1, -1, 1]) / 4
        assert cloth.triangles(overlapping).any() == crossed


def test_what_a_stitch_joins_does_not_count(patched_scene):
    cloth, mesh = ClothIntersections.of(patched_scene), patched_scene.garment.mesh
    patch = np.unique(mesh.faces[-8:])
    assert not cloth.triangles(mesh.points).any()
    sunk = mesh.points.copy()
    sunk[patch[4], 2] += 0.003  # the middle of the patch goes through what it lies on
    assert len(self_intersections(sunk, mesh.faces)) and not cloth.triangles(sunk).any()
    away = mesh.points.copy()
    away[patch] += [0, 0.3, 0.001]
    away[patch[:3], 2] += 0.05  # across another part
    assert cloth.triangles(away)[-8:].any()
