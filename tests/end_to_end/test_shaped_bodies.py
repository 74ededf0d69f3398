# SPDX-License-Identifier: Apache-2.0
"""Bodies that a shot shapes by blendshapes: as UsdSkel shows them there, so they are written, met and counted."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.delivery.gltf.play import GlbShot

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


def seen(path, mesh="/Hero/Body", frames=range(FRAMES)) -> np.ndarray:
    """The points of a mesh in each frame in its stage [m], as UsdSkel deforms them, shape (F, V, 3)."""
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root.Find(stage.GetPrimAtPath(mesh))
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    prim, found = stage.GetPrimAtPath(mesh), []
    query = cache.GetSkinningQuery(prim)
    rig = cache.GetSkelQuery(UsdSkel.BindingAPI(prim).GetInheritedSkeleton())
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim)) if query.HasBlendShapes() else None
    for code in map(float, frames):
        points = UsdGeom.Mesh(prim).GetPointsAttr().Get(code)
        if shapes:
            weights = query.GetBlendShapeMapper().Remap(rig.GetAnimQuery().ComputeBlendShapeWeights(code))
            given = shapes.ComputeSubShapeWeights(weights)
            rows, offsets = shapes.ComputeBlendShapePointIndices(), shapes.ComputeSubShapePointOffsets()
            assert shapes.ComputeDeformedPoints(*given, rows, offsets, points)
        assert query.ComputeSkinnedPoints(rig.ComputeSkinningTransforms(code), points, code)
        place = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(rig.GetPrim()))
        found.append(np.array(points, dtype=float) @ place[:3, :3] + place[3, :3])
    return np.array(found)


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


@pytest.fixture(scope="module")
def breathing(world):
    """Shots of a breathing pillar, as commands write them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(world)
        path = shot(world / "breath.usda", BREATH)
        for name, *options in (
            ("network.usda",), ("solved.usda", "--refine", "20"), ("alone.usda", "--no-body"),
            ("shot.glb", "--target", "glb"), ("layers/", "--refine", "2"),
            ("points.usda", "--refine", "2", "--refined-output", "points"),
        ):  # fmt: skip
            assert main([*BAKE, path, "-o", name, *options]) == 0
        assert main(["simulate", "rigged.usda", "--motion", path, "-o", "simulated.usda"]) == 0
        assert main(["simulate", "rigged.usda", "--motion", path, "-o", "cache.usda", "--points"]) == 0
        cache = ["skin", "cache.usda", "--stage", "rigged.usda", "--motion", path, "-o", "skinned.usda"]
        assert main(cache) == 0
    return world


@pytest.mark.parametrize("name", ["solved.usda", "points.usda", "simulated.usda", "cache.usda", "skinned.usda"])
def test_solvers_and_caches_write_the_body_as_its_shot_shapes_it(breathing, name):
    np.testing.assert_allclose(seen(breathing / name), seen(breathing / "breath.usda"), atol=2e-6)


def test_layers_and_binaries_have_the_shapes_of_the_shot(breathing):
    body = seen(breathing / "breath.usda")
    layers = breathing / "layers/shots/breath/shot.usda"
    np.testing.assert_allclose(seen(layers, "/Shot/model/Body"), body, atol=2e-6)
    glb = GlbShot(breathing / "shot.glb")
    number = next(number for number, mesh in enumerate(glb.meshes) if mesh.name == "Body")
    np.testing.assert_allclose([glb.points(time)[number] for time in glb.frame_times], body, atol=2e-6)


def radii(points: np.ndarray, spine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights along the axis of the pillar and distances from it, where its spine is posed as (4, 4) says [m]."""
    local = (points - spine[3, :3]) @ np.linalg.inv(spine[:3, :3])
    return local[:, 1], np.linalg.norm(local[:, [0, 2]], axis=1)


def deepest(breathing, name: str) -> float:
    """How deep cloth lies in the pillar that the shot shows at most [m], beneath the narrowest of its outline."""
    stage = Usd.Stage.Open(str(breathing / "breath.usda"))
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Usd.PrimDefaultPredicate)
    rig = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")))
    found = 0.0
    bodies, cloths = seen(breathing / "breath.usda"), seen(breathing / name, "/Hero/Skirt")
    for code, (body, cloth) in enumerate(zip(bodies, cloths)):
        hips = np.array(rig.ComputeJointSkelTransforms(float(code))[0])
        (heights, skin), (at, away) = radii(body, hips), radii(cloth, hips)
        levels = np.unique(heights[skin > 0.1].round(4))
        narrow = np.cos(np.pi / 16)  # of a ring of 16 points, between them
        outline = [narrow * skin[np.abs(heights - level) < 1e-3].min() for level in levels]
        found = max(found, float((np.interp(at, levels, outline) - away).max()))
    return found


def test_solved_cloth_is_outside_of_the_body_that_is_seen(breathing):
    assert deepest(breathing, "network.usda") > 0.02  # which does not see it
    for name in ("solved.usda", "simulated.usda", "skinned.usda"):
        assert deepest(breathing, name) < 0.002, name


def test_skin_that_shows_is_that_of_the_body_that_is_seen(breathing):
    names = ("network.usda", "alone.usda", "solved.usda")
    shown = {name: read_provenance(breathing / name)["shown_skin"] for name in names}
    assert shown["network.usda"]["mean"] > 0.1 and shown["solved.usda"]["mean"] < 0.005
    assert shown["alone.usda"]["mean"] == pytest.approx(shown["network.usda"]["mean"], abs=1e-3)


def test_the_solver_in_latents_meets_it(breathing, monkeypatch):
    monkeypatch.chdir(breathing)
    for motion, name in (("breath.usda", "latent.usda"), ("brief.usda", "still.usda")):
        assert main([*BAKE, motion, "--quality", "latent", "-o", name]) == 0
    moved = seen("latent.usda", "/Hero/Skirt") - seen("still.usda", "/Hero/Skirt")
    assert np.linalg.norm(moved, axis=-1).max() > 1e-3


def test_what_sees_the_shapes_and_what_does_not_is_told(copy, capsys):
    path = shot(copy / "shot.usda", BREATH)
    off = np.linalg.norm(seen(path) - seen(shot(copy / "still.usda", [0.0, 0.0])), axis=-1).max()
    moved = f"blendshapes move Body by up to {1000 * off:.3g} mm ("
    assert main([*BAKE, path, "-o", "baked.usda"]) == 0
    told = capsys.readouterr().err
    assert (
        f"warning: {path}: {moved}" in told
        and "does not see it change: --refine N or --quality hero solve for it" in told
    )
    assert main([*BAKE, path, "-o", "baked.usda", "--refine", "1"]) == 0
    told = capsys.readouterr().err
    assert moved in told and "the solver meets it so" in told and "warning" not in told
    main(["inspect", "rigged.usda", "--motion", path])
    assert "training sees the shape of the character's stage alone" in capsys.readouterr().err


def alone(path, names, weights) -> str:
    """Write the brief clip with weights of blendshapes as an animation that stands alone; return its name."""
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().TransferContent(Sdf.Layer.FindOrOpen("brief.usda"))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Clip"))
    animation.CreateBlendShapesAttr(names)
    for code, row in weights.items():
        animation.CreateBlendShapeWeightsAttr().Set(row, code)
    stage.GetRootLayer().Save()
    return str(path)


def fuller(path) -> str:
    """Write the character with a pose and two shapes that are on in its stage; return its name."""
    layer = Sdf.Layer.CreateNew(str(path))
    layer.TransferContent(Sdf.Layer.FindOrOpen("rigged.usda"))
    stage = Usd.Stage.Open(layer)
    Sdf.CopySpec(Sdf.Layer.FindOrOpen("brief.usda"), "/Clip", layer, "/Hero/Look")
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Look"))
    for attribute in (animation.GetRotationsAttr(), animation.GetTranslationsAttr()):
        value = attribute.Get(0)
        attribute.Clear()
        attribute.Set(value)
    animation.CreateBlendShapesAttr(["heavy", "breathe"])
    animation.CreateBlendShapeWeightsAttr([0.4, 0.75])
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/Hero")).CreateAnimationSourceRel().SetTargets(["/Hero/Look"])
    layer.Save()
    return str(path)


def test_shapes_that_are_on_in_the_stage_count_from_there(copy):
    stage = fuller(copy / "fuller.usda")
    bake = ["bake", "model.safetensors", "--stage", stage, "-o", "baked.usda", "--motion"]
    path = shot(
        copy / "shot.usda", {0.0: [0.0, 0.0], 4.0: [1.0, 1.0]}, under="fuller.usda", names=("breathe", "heavy")
    )
    assert main([*bake, path]) == 0
    np.testing.assert_allclose(seen("baked.usda"), seen(path), atol=2e-6)
    (copy / "again").mkdir()  # what was baked has the stage's shape in its points
    shutil.copy("baked.usda", "again/shot.usda")
    assert main([*bake, "again/shot.usda"]) == 0
    np.testing.assert_allclose(seen("baked.usda"), seen(path), atol=2e-6)
    same = shot(copy / "same.usda", [0.4, 0.75], under="fuller.usda", names=("heavy", "breathe"))
    assert main([*bake, same]) == 0
    np.testing.assert_allclose(seen("baked.usda"), seen(same), atol=2e-6)
    assert not UsdSkel.BindingAPI(Usd.Stage.Open("baked.usda").GetPrimAtPath("/Hero/Body")).GetBlendShapesAttr().Get()


def test_a_clip_alone_shapes_bodies_as_where_it_is_bound_and_leaves_those_of_which_it_names_no_shape(copy, capsys):
    stage, weights = fuller(copy / "fuller.usda"), {0.0: [0.0], 4.0: [1.0]}
    bake = ["bake", "model.safetensors", "--stage", stage, "-o", "baked.usda", "--motion"]
    assert main([*bake, alone(copy / "clip_alone.usda", ["breathe"], weights)]) == 0
    told = capsys.readouterr().err
    assert "'heavy'" in told and "heavy_off" not in told
    path = shot(copy / "shot.usda", weights, under="fuller.usda", names=("breathe",))
    np.testing.assert_allclose(seen("baked.usda"), seen(path), atol=2e-6)
    assert main([*bake, alone(copy / "smile_alone.usda", ["smile"], weights)]) == 0
    same = shot(copy / "same.usda", [0.4, 0.75], under="fuller.usda", names=("heavy", "breathe"))
    np.testing.assert_allclose(seen("baked.usda"), seen(same), atol=2e-6)


def test_a_pillar_that_breathes_and_holds_still_is_a_motion(copy):
    path = shot(copy / "shot.usda", {1.0: [0.0, 0.0], 4.0: [1.0, 0.0]})
    stage = Usd.Stage.Open(path)
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Clip"))
    for attribute in (animation.GetRotationsAttr(), animation.GetTranslationsAttr()):
        value = attribute.Get(0)
        attribute.Clear()
        attribute.Set(value)
    stage.GetRootLayer().Save()
    assert main([*BAKE, path, "-o", "baked.usda"]) == 0
    assert Usd.Stage.Open("baked.usda").GetEndTimeCode() == 4
    np.testing.assert_allclose(seen("baked.usda", frames=range(1, 5)), seen(path, frames=range(1, 5)), atol=2e-6)


def test_shapes_are_named_apart_from_all_that_is_there(copy):
    layer = Sdf.Layer.FindOrOpen("rigged.usda")
    Sdf.CopySpec(layer, "/Hero/Body", layer, "/Hero/Lashes")
    stage = Usd.Stage.Open(layer)
    targets = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Hero/Lashes")).GetBlendShapeTargetsRel()
    targets.SetTargets([path.ReplacePrefix("/Hero/Body", "/Hero/Lashes") for path in targets.GetTargets()])
    UsdGeom.Subset.Define(stage, "/Hero/Body/breathe")
    layer.Save()
    path = shot(copy / "shot.usda", BREATH)
    assert main([*BAKE, path, "-o", "baked.usda"]) == 0
    for mesh in ("Body", "Lashes"):
        np.testing.assert_allclose(seen("baked.usda", f"/Hero/{mesh}"), seen(path, f"/Hero/{mesh}"), atol=2e-6)
    assert Usd.Stage.Open("baked.usda").GetPrimAtPath("/Hero/Body/breathe").IsA(UsdGeom.Subset)


def test_weights_that_are_no_numbers_are_refused(copy, capsys):
    path = shot(copy / "shot.usda", {0.0: [0.0, 0.0], 2.0: [float("nan"), 0.0], 4.0: [1.0, 0.0]})
    assert main([*BAKE, path, "-o", "baked.usda"]) == 2
    told = capsys.readouterr().err
    assert "blendShapeWeights hold NaN or infinity, first at time code 2;" in told
    assert not (copy / "baked.usda").exists()
