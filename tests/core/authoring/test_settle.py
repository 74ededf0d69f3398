# SPDX-License-Identifier: Apache-2.0
"""Garments are settled out of the body with little change of shape, on their own side, seams and layers together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.authoring.preflight.cloth_samples import sample_cloth
from ssilk_core.authoring.preflight.contact_planes import covering_planes
from ssilk_core.authoring.preflight.fit import _why_still, penetration
from ssilk_core.authoring.preflight.settle import FARTHEST, GAP, _Cloth, _layer_ties, part_inside, settle
from ssilk_core.authoring.preflight.sides import OuterSurface, find_facing
from ssilk_core.scene.assets import Floats, Ints, Mesh
from ssilk_core.scene.mesh.topology import edges

RADIUS, COLUMNS, ROWS = 0.1, 32, 27


def tube(radius: float, columns: int = COLUMNS, rows: int = ROWS, height: float = 0.6, name: str = "Tube") -> Mesh:
    """Return a tube about the y axis, its normals outward."""
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(0, height, rows)
    rings = np.broadcast_arrays(radius * np.sin(angle), y[:, None], radius * np.cos(angle))
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    faces = np.r_[np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]]
    return Mesh(name, np.stack(rings, axis=-1).reshape(-1, 3), faces)


def limb(radius: float = RADIUS) -> Mesh:
    """Return a closed cylinder about the y axis, longer than the tube."""
    rings = 41  # long triangles are near much of the cloth
    side = tube(radius, 96, rings, 1.0)
    ends = np.array([[0.0, 0, 0], [0, 1, 0]])
    ring, last = np.arange(96), (rings - 1) * 96 + np.arange(96)
    low = np.c_[np.roll(ring, -1), ring, np.full(96, rings * 96)]
    high = np.c_[last, np.roll(last, -1), np.full(96, rings * 96 + 1)]
    return Mesh("Limb", np.r_[side.points, ends] - [0, 0.2, 0], np.r_[side.faces, low, high])


def dented(mesh: Mesh, depth: float = 0.01, width: float = 0.06) -> Mesh:
    """Return the tube with a patch pressed in, to a depth below the limb's surface."""
    near = np.exp(-((np.linalg.norm(mesh.points - [0, 0.3, RADIUS], axis=1) / width) ** 4))
    inward = near * (np.hypot(mesh.points[:, 0], mesh.points[:, 2]) - RADIUS + depth)
    return replace(mesh, points=mesh.points - inward[:, None] * outward(mesh.points))


def outward(points: Floats) -> Floats:
    flat = points * [1, 0, 1]
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def height_above(points: Floats, radius: float = RADIUS) -> Floats:
    return np.hypot(points[:, 0], points[:, 2]) - radius


def strain(rest: Floats, points: Floats, faces: Ints) -> Floats:
    first, second = edges(faces).T
    length = np.linalg.norm(rest[first] - rest[second], axis=1)
    return np.abs(np.linalg.norm(points[first] - points[second], axis=1) / length - 1)


def test_a_dent_comes_out_smoothly_and_all_else_stays():
    clean = tube(RADIUS + 0.006)
    cloth = dented(clean)
    found = settle(cloth, limb())
    points, samples = cloth.points + found.offsets, sample_cloth(cloth.points, cloth.faces)
    assert abs(found.before.depth - 0.01) < 3e-4 and not found.left
    assert height_above(samples.of(points)).min() > GAP - 2e-4  # the limb has 96 corners
    moved = found.offsets.any(axis=1)
    assert found.moved == moved.sum() and not moved[np.abs(cloth.points[:, 1] - 0.3) > 0.27].any()
    assert not moved[cloth.points[:, 2] < -0.09].any()
    each = cloth.points.copy()
    deep = height_above(each) < GAP
    each[deep] *= np.where([True, False, True], ((RADIUS + GAP) / (RADIUS + height_above(each)))[deep, None], 1)
    ours, theirs = strain(cloth.points, points, cloth.faces), strain(cloth.points, each, cloth.faces)
    assert ours.max() < 0.7 * theirs.max() and ours[ours > 1e-9].mean() < theirs[theirs > 1e-9].mean()


def test_cloth_that_is_clear_of_the_body_is_left_alone():
    found = settle(tube(RADIUS + 0.006), limb())
    assert not found.offsets.any() and not found.left and found.before.depth == 0


def test_cloth_deeper_than_40_mm_is_not_fitted_and_stays():
    for depth, moves in ((0.038, True), (0.042, False)):
        found = settle(dented(tube(RADIUS + 0.006, 24, 15), depth), limb())
        assert abs(found.before.depth - depth) < 1e-3 and found.offsets.any() == moves == (not found.left)
        assert not found.failed


@pytest.mark.parametrize("end", [lambda points: points * [0.99, 1, 0.99], lambda points: points * np.nan])
def test_what_settling_would_make_worse_stays(monkeypatch, end):
    monkeypatch.setattr("ssilk_core.authoring.preflight.settle._Solve.run", lambda solve: end(solve.cloth.points))
    cloth = dented(tube(RADIUS + 0.006, 24, 15))
    found = settle(cloth, limb())
    assert found.failed and found.left and not found.offsets.any() and found.after is found.before
    assert "because no shape was found" in _why_still(found)


def test_an_inspection_promises_only_what_settling_does(monkeypatch):
    cloth = dented(tube(RADIUS + 0.006, 24, 15))
    found, inside = next(penetration(cloth, limb())), part_inside(cloth, limb())
    assert found.fixable and found.fix.endswith("--fix settles it") and found.count == len(inside.vertices) > 0
    assert f"up to {1000 * inside.depth:.1f} mm deep" in found.found
    run = "ssilk_core.authoring.preflight.settle._Solve.run"
    monkeypatch.setattr(run, lambda solve: solve.cloth.points * [1 + 1e-6, 1, 1 + 1e-6])
    found = next(penetration(cloth, limb()))
    assert not found.fixable and found.fix.endswith(f"--fix leaves {found.count} vertices inside")


def test_cloth_that_a_limb_pierces_stays_and_a_dent_beside_it_comes_out():
    """A sheet that a rod goes through, and a sleeve on the same rod with a dent."""
    thin, row = 0.025, np.linspace(-0.3, 0.3, 25)
    x, z = (part.reshape(-1) for part in np.meshgrid(row, row))
    corner = (np.arange(24)[:, None] * 25 + np.arange(24)).reshape(-1)
    faces = np.r_[np.c_[corner, corner + 1, corner + 26], np.c_[corner, corner + 26, corner + 25]]
    sleeve = tube(thin + 0.006, 20, 12, 0.2)
    dent = np.linalg.norm(sleeve.points - [0, 0.1, thin + 0.006], axis=1) < 0.02
    points = sleeve.points - np.where(dent[:, None], [0, 0, 0.012], 0)
    both = Mesh("Both", np.r_[np.c_[x, np.full(625, 0.4), z], points], np.r_[faces, sleeve.faces + 625])
    found = settle(both, limb(thin))
    assert 0 < len(found.pierced) < 20 and (found.pierced < 625).all() and not found.offsets[found.pierced].any()
    assert np.array_equal(found.after.vertices, found.pierced) and found.offsets[625:][dent].any()
    assert found.largest < FARTHEST and not found.failed
    pierced, inside, *_ = penetration(both, limb(thin))
    assert (pierced.severity, pierced.code, pierced.fixable) == ("error", "pierced", False)
    assert inside.code == "penetration" and inside.fixable and pierced.indices == tuple(found.pierced)


def test_cloth_of_which_a_limb_pierces_every_triangle_settles_no_face():
    """Free vertices of coarse cloth may all belong to faces with a held one."""
    sheet, rod = tube(RADIUS + 0.006), OuterSurface(limb())
    facing = find_facing(sheet.points, sheet.faces, rod)
    assert len(covering_planes(rod, sheet.points, sheet.faces, facing, 0.01).offsets) > 0
    assert len(covering_planes(rod, sheet.points, sheet.faces[:0], facing, 0.01).offsets) == 0


def test_a_garment_whose_equations_are_singular_stays(monkeypatch):
    def singular(*asked: object, **options: object) -> None:
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.setattr("scipy.sparse.linalg.splu", singular)
    found = settle(dented(tube(RADIUS + 0.006, 24, 15)), limb())
    assert found.failed and found.left and not found.offsets.any()


def test_seams_stay_closed():
    whole = dented(tube(RADIUS + 0.006))
    seam = np.arange(0, whole.vertex_count, COLUMNS)  # through the middle of the dent
    copy = np.arange(whole.vertex_count)
    copy[seam] = whole.vertex_count + np.arange(len(seam))
    faces = whole.faces.copy()
    beyond = (faces % COLUMNS == COLUMNS - 1).any(axis=1)
    faces[beyond] = copy[faces[beyond]]
    cut = Mesh("Cut", np.r_[whole.points, whole.points[seam]], faces)
    found = settle(cut, limb())
    assert found.offsets[seam].any() and np.array_equal(found.offsets[seam], found.offsets[copy[seam]])


def test_cloth_beyond_a_thin_limb_comes_back_to_its_own_side():
    thin = 0.02
    sleeve = tube(thin + 0.006, 20, 31, 0.3)
    points = sleeve.points.copy()
    lost = np.flatnonzero(np.linalg.norm(points - [0, 0.15, thin], axis=1) < 0.011)
    points[lost, 2] -= 2 * thin + 0.009  # out of the limb on the other side, or deep in it
    points[lost[0], 2] += 0.012
    found = settle(replace(sleeve, points=points), limb(thin))
    settled = points + found.offsets
    assert not found.left and settled[lost, 2].min() > 0.8 * thin
    assert np.linalg.norm(found.offsets[sleeve.points[:, 2] < -0.01], axis=1).max() < 0.01


def test_layers_keep_their_order():
    """An outer layer 2 mm above an inner one that is inside moves out with it."""
    inner, outer = (dented(tube(RADIUS + gap), depth=0.012 - gap) for gap in (0.006, 0.008))
    both = Mesh("Coat", np.r_[inner.points, outer.points], np.r_[inner.faces, outer.faces + inner.vertex_count])
    assert height_above(both.points).min() < -0.005
    found = settle(both, limb())
    lower, upper = np.split(height_above(both.points + found.offsets), 2)
    assert not found.left and lower.min() > GAP - 2e-4 and (upper - lower).min() > 1e-3


def test_a_fine_layer_is_not_tied_to_itself():
    fine, above = (tube(radius, 56, 14, 0.04) for radius in (0.026, 0.028))  # edges of 3 mm
    both = Mesh("Cuff", np.r_[fine.points, above.points], np.r_[fine.faces, above.faces + fine.vertex_count])
    single, double = (_Cloth(mesh, limb(0.02)) for mesh in (fine, both))
    everything = [np.ones(len(cloth.points), dtype=bool) for cloth in (single, double)]
    facings = [find_facing(cloth.points, cloth.faces, cloth.surface) for cloth in (single, double)]
    assert not len(_layer_ties(single, facings[0], everything[0]))
    ties = np.hypot(*double.points[_layer_ties(double, facings[1], everything[1])][..., ::2].T)
    assert len(ties.T) >= fine.vertex_count and np.allclose(np.ptp(ties, axis=0), 0.002)


def test_a_corner_of_the_body_between_vertices_of_the_cloth_is_covered():
    """A coarse roof over a spike: no vertex of it is near, and no sample need be."""
    spike = np.array([[-0.1, 0, -0.1], [0.1, 0, -0.1], [0, 0, 0.1], [0, 0.05, 0.0]])
    body = Mesh("Spike", spike, np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]))
    x, z = np.meshgrid(np.linspace(-0.2, 0.2, 9), np.linspace(-0.2, 0.2, 9))
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1)
    faces = np.r_[np.c_[corner, corner + 9, corner + 1], np.c_[corner + 1, corner + 9, corner + 10]]
    roof = Mesh("Roof", np.c_[x.reshape(-1) + 0.017, np.full(81, 0.045), z.reshape(-1) + 0.008], faces)
    found = settle(roof, body)
    assert np.array_equal(settle(roof, body).offsets, found.offsets)
    from ssilk_core.authoring.setup.surface import closest_on_surface

    after = Mesh("Roof", roof.points + found.offsets, faces)
    above = closest_on_surface(spike[3:], after)
    height = np.einsum("k,kc->c", above.barycentric[0], after.points[above.corners[0]])[1] - spike[3, 1]
    assert not found.left and height > 0.5 * GAP
