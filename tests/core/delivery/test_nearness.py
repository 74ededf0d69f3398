# SPDX-License-Identifier: Apache-2.0
"""Points that are not of the garment where its character wears it are refused before anything is fitted."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.delivery.bake.nearness import need_near
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Character, Deformer, Garment, Mesh, Motion, ProxyRig, Scene, Skeleton, SkinWeights

FRAMES = 12


@pytest.fixture
def worn() -> tuple[Deformer, Motion, np.ndarray]:
    """A skirt on hips that walk off and turn, and cloth that sways about it."""
    angle, height = np.meshgrid(np.arange(16) * np.pi / 8, np.linspace(0.95, 0.5, 8))
    radius = 0.15 + 0.3 * (0.95 - height)
    points = np.stack([radius * np.sin(angle), height, radius * np.cos(angle) + 0.03], axis=-1).reshape(-1, 3)
    row, column = (part.ravel() for part in np.mgrid[0:7, 0:16])
    a, b = row * 16 + column, row * 16 + (column + 1) % 16
    faces = np.concatenate([np.c_[a, a + 16, b], np.c_[b, a + 16, b + 16]])
    mesh = Mesh("skirt.usda:/Skirt", points, faces)
    skin = SkinWeights.rigid(mesh.path, 0, len(points))
    hips = np.eye(4)[None].copy()
    hips[0, 1, 3] = 1.0
    skeleton = Skeleton("hero.usda:/Rig", ("Hips",), np.array([-1]), hips, hips)
    rig = ProxyRig(mesh.path, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    garment = Garment(mesh, skin, np.ones(len(points), dtype=int))
    deformer = Deformer(Scene(Character("hero.usda:/Hero", skeleton, ()), garment, rig), skin, np.zeros((0, 128, 3)))
    turn, steps = 0.4 * np.sin(np.arange(FRAMES) / 4), 0.05 * np.arange(FRAMES)
    rotations = np.stack([np.cos(turn / 2), 0 * turn, np.sin(turn / 2), 0 * turn], axis=-1)[:, None]
    places = np.stack([steps, np.ones(FRAMES), 0.3 * steps], axis=-1)[:, None]
    cos, sin, none = np.cos(turn), np.sin(turn), 0 * turn
    about = np.stack([cos, none, sin, none, none + 1, none, -sin, none, cos], axis=-1).reshape(-1, 3, 3)
    posed = np.einsum("fij,vj->fvi", about, points - [0, 1, 0]) + places
    posed += 0.03 * np.sin(np.arange(FRAMES))[:, None, None] * (0.95 - points[:, 1:2]) * [1, 0, 0]
    return deformer, Motion("walk", 30.0, rotations, places), posed


def test_cloth_that_sways_and_flies_is_taken(worn):
    deformer, motion, posed = worn
    need_near(deformer, motion, posed, "cache")
    flying = posed + 0.9 * (1 - np.exp(-np.arange(FRAMES) / 2))[:, None, None] * [0, 0.5, -1]
    need_near(deformer, motion, flying, "cache")


@pytest.mark.parametrize("scale", [0.01, 100.0, 0.0254, 1 / 0.3048])
def test_points_in_other_units_are_refused(worn, scale):
    deformer, motion, posed = worn
    with pytest.raises(SsilkError, match=f"edges are {scale:.3g} times as long.*set metersPerUnit"):
        need_near(deformer, motion, scale * posed, "cache")


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], r"\(x, y, z\) become \(x, z, -y\)"),  # z up, and nobody said so
        ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], r"\(x, y, z\) become \(x, -z, y\)"),
        ([[0, 1, 0], [0, 0, 1], [1, 0, 0]], "become"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "mirrored"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], r"become \(-x, y, -z\)"),  # it looks the other way
    ],
)
def test_points_along_other_axes_are_refused_with_what_would_fit(worn, matrix, says):
    deformer, motion, posed = worn
    with pytest.raises(SsilkError, match=says):
        need_near(deformer, motion, posed @ np.array(matrix, dtype=float).T, "cache")


def test_points_somewhere_else_are_refused_or_told(worn):
    deformer, motion, posed = worn
    with pytest.raises(SsilkError, match="1493 mm RMS off the skinned garment in the nearest"):
        need_near(deformer, motion, posed + [1.5, 0, 0], "cache")
    told: list[object] = []
    need_near(deformer, motion, posed + [0.35, 0, 0], "cache", told.append)
    assert len(told) == 1 and "mm RMS off the skinned garment" in str(told[0])
