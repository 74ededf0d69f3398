# SPDX-License-Identifier: Apache-2.0
"""Point caches in time codes of any length, and those whose vertices are in another order."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt
from ssilk_usd.shots.trajectories import MeshTrajectories

from ssilk_core.errors import SsilkError

FRAMES, STEP = 5, 200  # a frame in 200 of 4,800 codes in a second


@pytest.fixture
def cache(tmp_path):
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(20)], axis=1)
    corner = (np.arange(3)[:, None] * 5 + np.arange(4)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 6], corner[:, None] + [0, 6, 5]])
    path = tmp_path / "cache.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(4800)
    stage.SetFramesPerSecond(24)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(9600)  # longer than what is sampled
    mesh = UsdGeom.Mesh.Define(stage, "/Cloth")
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    for frame in range(FRAMES):
        moved = (points + 0.1 * frame).astype(np.float32)
        mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(moved), STEP * (frame + 1))
    stage.GetRootLayer().Save()
    return str(path), points, faces


def test_frames_are_those_that_are_sampled(cache):
    path, points, faces = cache
    found = MeshTrajectories(path, len(points), faces)
    assert (len(found), found.fps) == (FRAMES, 24.0)
    np.testing.assert_allclose(found.seconds, np.arange(1, FRAMES + 1) / 24)
    np.testing.assert_allclose(found[3], points + 0.3, atol=1e-6)


def test_vertices_in_another_order_are_refused(cache):
    path, points, faces = cache
    other = np.random.default_rng(0).permutation(len(points))
    with pytest.raises(SsilkError, match="its edges join other vertices than the garment's"):
        MeshTrajectories(path, len(points), other[faces])


def test_quads_may_be_divided_along_their_other_diagonals(cache):
    path, points, faces = cache
    first, second = np.split(faces, 2)
    turned = np.concatenate([np.c_[first[:, :2], second[:, 2]], np.c_[first[:, 1:], second[:, 2]]])
    assert len(MeshTrajectories(path, len(points), turned)) == FRAMES
