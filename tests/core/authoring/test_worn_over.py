# SPDX-License-Identifier: Apache-2.0
"""Garments that start inside each other are found, and the outer one is settled off the inner one that stays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from ssilk_core.authoring.preflight.inner_surface import LayeredSurface, Sheet
from ssilk_core.authoring.preflight.repair import plan_repair
from ssilk_core.authoring.preflight.settle import GAP, TOLERANCE, Settled, part_inside, settle
from ssilk_core.authoring.preflight.worn_over import layers
from ssilk_core.physics.intersections.pairs import intersections_between
from ssilk_core.scene.assets import Body, Character, Garment, Mesh, Skeleton, SkinWeights

from .test_settle import RADIUS, height_above, limb, outward, strain, tube

INNER = RADIUS + 0.02  # [m] radius of the inner garment, which hangs off the limb


def inner() -> Mesh:
    return tube(INNER, columns=40, rows=31, name="Shirt")


def outer(depth: float = 0.008) -> Mesh:
    """A tube 6 mm over the inner garment, with a patch pressed through it, and still outside the limb."""
    mesh = tube(INNER + 0.006, name="Jacket")
    near = np.exp(-((np.linalg.norm(mesh.points - [0, 0.3, INNER], axis=1) / 0.06) ** 4))
    return replace(mesh, points=mesh.points - (near * (0.006 + depth))[:, None] * outward(mesh.points))


def crossing(mesh: Mesh, points: np.ndarray | None = None) -> int:
    cloth, other = mesh.points if points is None else points, inner()
    return len(intersections_between(cloth, mesh.faces, other.points, other.faces))


def character() -> Character:
    body = limb()
    names, count = ("Root", "Root/Spine"), body.vertex_count
    skeleton = Skeleton("/Hero/Rig", names, np.array([-1, 0]), *[np.tile(np.eye(4), (2, 1, 1))] * 2)
    skin = SkinWeights("/Hero/Limb", (body.points[:, 1:2] > 0.3).astype(int), np.ones((count, 1)))
    return Character("hero.usda:/Hero", skeleton, (Body(body, skin),))


@cache
def settled() -> Settled:
    """The outer garment over the inner one."""
    return settle(outer(), limb(), inner=[inner()])


def test_the_outer_garment_leaves_the_inner_one_with_little_change_of_shape():
    mesh, body = outer(), limb()
    assert crossing(mesh) > 0 and not len(part_inside(mesh, body).vertices)  # the body alone finds nothing wrong
    assert not settle(mesh, body).moved
    found = settled()
    points = mesh.points + found.offsets
    assert not found.left and crossing(mesh, points) == 0
    assert height_above(points, INNER).min() > GAP - 2 * TOLERANCE - INNER * (1 - np.cos(np.pi / 40))
    assert np.abs(strain(mesh.points, points, mesh.faces)).max() < 0.25 and found.largest < 0.02
    far = np.linalg.norm(mesh.points - [0, 0.3, INNER], axis=1) > 0.25
    assert far.any() and not found.offsets[far].any()


def test_winding_of_the_inner_garment_makes_no_difference():
    mesh, other = outer(), inner()
    turned = Mesh(other.path, other.points, other.faces[:, ::-1])
    found = settle(mesh, limb(), inner=[turned])
    np.testing.assert_allclose(found.offsets, settled().offsets, atol=1e-9)


def test_past_a_hem_nothing_lies_beneath():
    sheet = Sheet(inner(), limb())
    rows = np.array([[0, 0.3, INNER - 0.005], [0, 0.3, INNER + 0.005], [0, -0.02, INNER - 0.005], [0, 0.3, 0.06]])
    np.testing.assert_array_equal(sheet.nearest(rows).inside, [True, False, False, False])  # the last is too deep
    surface = LayeredSurface(limb(), [inner()])
    np.testing.assert_array_equal(surface.inside(rows), [True, False, False, True])  # and in the limb


def test_what_crosses_is_told_with_where_and_repaired():
    mesh = outer()
    (finding,) = layers(mesh, character(), {"shirt": inner()})
    faces = np.unique(intersections_between(mesh.points, mesh.faces, inner().points, inner().faces)[:, 0])
    assert finding.code == "garments-cross" and finding.fixable and finding.indices == tuple(faces.tolist())
    assert f"{len(faces)} of {len(mesh.faces)} triangles intersect those of shirt" in finding.found
    assert "vertices lie beneath it, up to 8" in finding.found and finding.found.endswith("mm deep, at Root, Spine")
    repair = plan_repair(character(), Garment(mesh), None, inner=[inner()])
    points = (mesh.points + repair.offsets)[np.argsort(repair.kept)]
    assert crossing(mesh, points) == 0
    assert not list(layers(replace(mesh, points=points), character(), {"shirt": inner()}))
    assert not list(layers(mesh, character(), {}))


def test_what_cannot_come_out_is_told_and_not_called_repaired():
    """The garments the wrong way round: the outer one lies well beneath the inner one, all around."""
    mesh = tube(RADIUS + 0.002, columns=16, rows=13, name="Jacket")
    wide = tube(RADIUS + 0.06, columns=16, rows=13, name="Coat")
    skewed = replace(wide, points=wide.points * np.where(wide.points[:, 1:2] > 0.3, 1, [0.63, 1, 0.63]))
    (finding,) = layers(mesh, character(), {"coat": skewed})
    assert not finding.fixable and "it may be the inner one" in finding.fix


def test_without_libigl_it_says_that_nothing_was_checked(monkeypatch):
    monkeypatch.setattr("ssilk_core.authoring.preflight.worn_over.can_find", lambda: False)
    (finding,) = layers(outer(), character(), {"shirt": inner()})
    assert finding.code == "not-checked" and "libigl" in finding.found
