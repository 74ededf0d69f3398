# SPDX-License-Identifier: Apache-2.0
"""Bodies that a shot shapes by blendshapes: as UsdSkel shows them there, so they are written, met and counted."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.cli import main

FRAMES = 5
BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion"]


def bulge(points: np.ndarray, reach: float, height: float) -> np.ndarray:
    """Offsets away from the axis of the pillar around a height, zero elsewhere."""
    away = points * [1, 0, 1]
    near = np.exp(-(((points[:, 1:2] - height) / 0.12) ** 2))
    offsets = reach * away / np.linalg.norm(away, axis=1, keepdims=True).clip(0.05) * near
    offsets[np.abs(offsets).max(axis=1) < 1e-4] = 0
    return offsets


def add_shape(stage: Usd.Stage, name: str, offsets: np.ndarray, between: np.ndarray | None = None) -> None:
    """Add a blendshape to the pillar, of the points that it moves, with an in-between at a half."""
    body = stage.GetPrimAtPath("/Hero/Body")
    rows = np.flatnonzero(offsets.any(axis=1))
    shape = UsdSkel.BlendShape.Define(stage, f"/Hero/Body/{name.title()}")
    shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(rows.astype(np.int32)))
    shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(offsets[rows].astype(np.float32)))
    if between is not None:
        half = shape.CreateInbetween("half")
        half.SetWeight(0.5)
        half.SetOffsets(Vt.Vec3fArray.FromNumpy(between[rows].astype(np.float32)))
    binding = UsdSkel.BindingAPI(body)
    binding.CreateBlendShapesAttr([*(binding.GetBlendShapesAttr().Get() or ()), name])
    targets = binding.CreateBlendShapeTargetsRel().GetTargets()
    binding.CreateBlendShapeTargetsRel().SetTargets([*targets, shape.GetPath()])


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """A pillar with shapes, one of which is called as the garment's first, and a brief clip."""
    folder = toy.copy(tmp_path_factory.mktemp("shaped"))
    stage = Usd.Stage.Open(str(folder / "rigged.usda"))
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get(), dtype=float)
    add_shape(stage, "breathe", bulge(points, 0.04, 1.1), between=bulge(points, 0.03, 0.95))
    add_shape(stage, "shape_000", bulge(points, 0.03, 0.8))
    add_shape(stage, "heavy", bulge(points, 0.02, 1.2))
    stage.GetRootLayer().Save()
    toy.write_clip(folder / "brief.usda", frames=FRAMES)
    return folder


def shot(path, weights: dict[float, list[float]] | list[float], names=("breathe", "shape_000"), under="rigged.usda"):
    """Write a shot over the character, moved by the brief clip, with weights of blendshapes; return its name."""
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().subLayerPaths.append(under)
    stage.SetTimeCodesPerSecond(30)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    Sdf.CreatePrimInLayer(stage.GetRootLayer(), "/Hero")
    Sdf.CopySpec(Sdf.Layer.FindOrOpen("brief.usda"), "/Clip", stage.GetRootLayer(), "/Hero/Clip")
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Clip"))
    animation.CreateBlendShapesAttr(names)
    if isinstance(weights, dict):
        for code, row in weights.items():
            animation.CreateBlendShapeWeightsAttr().Set(row, code)
    else:
        animation.CreateBlendShapeWeightsAttr(weights)
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/Hero")).CreateAnimationSourceRel().SetTargets(["/Hero/Clip"])
    stage.GetRootLayer().Save()
    return str(path)


def seen(path, mesh="/Hero/Body") -> np.ndarray:
    """The points of a mesh in each frame [m], once UsdSkel has baked blendshapes and skinning, shape (F, V, 3)."""
    stage = Usd.Stage.Open(Usd.Stage.Open(str(path)).Flatten())
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Gf.Interval.GetFullInterval())
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath(mesh)).GetPointsAttr()
    return np.array([attribute.Get(float(time)) for time in range(FRAMES)], dtype=float)


BREATH = {0.0: [0.0, 0.0], 1.5: [0.7, 0.0], 4.0: [1.2, 0.5]}
SHOTS = {
    "in-betweens, and weights between frames": (BREATH, ("breathe", "shape_000")),
    "another order": ({0.0: [0.2, 9.0, 0.0], 4.0: [0.0, 9.0, 1.0]}, ("heavy", "none", "breathe")),
    "weights below none": ({0.0: [-0.5, 0.0], 2.0: [0.5, 0.0], 4.0: [-0.5, 0.0]}, ("breathe", "shape_000")),
    "constant weights": ([0.6, 1.0], ("breathe", "heavy")),
    "on in one frame": ({0.0: [0.0], 2.0: [1.0], 3.0: [0.0]}, ("breathe",)),
}  # fmt: skip


@pytest.mark.parametrize(("weights", "names"), SHOTS.values(), ids=SHOTS)
def test_a_body_is_written_as_its_shot_shapes_it(copy, weights, names):
    path = shot(copy / "shot.usda", weights, names)
    assert main([*BAKE, path, "-o", "baked.usda"]) == 0
    assert np.ptp(seen(path), axis=0).max() > 0.01
    np.testing.assert_allclose(seen("baked.usda"), seen(path), atol=2e-6)
    written = Usd.Stage.Open("baked.usda")
    (weights,) = (
        UsdSkel.Animation(prim).GetBlendShapeWeightsAttr()
        for prim in written.Traverse()
        if prim.IsA(UsdSkel.Animation)
    )
    every = np.array([weights.Get(time) for time in weights.GetTimeSamples()])
    assert every.min() >= 0 and every.max() <= 1  # importers clamp others
