# SPDX-License-Identifier: Apache-2.0
"""`ssilk bake --refine` on the toy world: points, joints, layers, what is stated, and what verifying finds."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, bake
from ssilk_core.quality.levels import QUALITIES

BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda"]


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("refined"))
    toy.write_clip(folder / "brief.usda", frames=5)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*BAKE, "-o", "network.usda"]) == 0
        assert main([*BAKE, "-o", "points.usda", "--refine", "3", "--refined-output", "points"]) == 0
        assert main([*BAKE, "-o", "joints.usda", "--refine", "3"]) == 0
    return folder


@pytest.fixture
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def points_of(path) -> np.ndarray:
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in shot.frame_times])


def test_points_are_bound_to_nothing_and_say_what_was_changed(there):
    shot = Shot("points.usda")
    assert not shot.is_skinned and Shot("joints.usda").is_skinned and len(shot.frame_times) == 5
    stated = read_provenance("points.usda")["refined"]
    assert stated["iterations"] == 3 and stated["energy [J]"] < stated["energy before [J]"]
    moved = np.linalg.norm(points_of("points.usda") - points_of("network.usda"), axis=-1)
    assert 0.5 * stated["moved [m]"] < np.sqrt((moved**2).mean()) < 2 * stated["moved [m]"]


def test_joints_are_as_near_to_the_points_as_stated(there):
    stated = read_provenance("joints.usda")["refined"]
    away = np.linalg.norm(points_of("joints.usda") - points_of("points.usda"), axis=-1) * 1000
    assert away.max() == pytest.approx(stated["joints lose, at most [mm]"], rel=0.01)
    assert np.sqrt((away**2).mean()) == pytest.approx(stated["joints lose, RMS [mm]"], rel=0.01)
    assert away.max() <= 5 and np.sqrt((away**2).mean()) <= 1 and stated["shapes of the shot"] > 0
    assert stated["bytes of the points alone"] == 12 * away.size


@pytest.mark.parametrize("shot", ["points.usda", "joints.usda"])
def test_refined_shots_are_verified(there, shot):
    assert main(["verify", shot]) == 0


def test_points_that_someone_moved_do_not_verify(there, capsys):
    stage = Usd.Stage.Open("points.usda")
    prim = next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh) and prim.GetName() == "Skirt")
    points = UsdGeom.Mesh(prim).GetPointsAttr()
    moved = np.array(points.Get(3.0))
    share = np.random.default_rng(0).uniform(0, 0.2, (len(moved), 1))
    moved += share * (moved.mean(axis=0) - moved)  # inwards, where the extent holds it
    points.Set(Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)), 3.0)
    stage.Export("moved.usda")
    assert main(["verify", "moved.usda"]) == 3
    assert "has an energy of" in capsys.readouterr().err


def test_joints_of_other_points_do_not_verify(there, capsys):
    stage = Usd.Stage.Open("joints.usda")
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.BlendShape):
            offsets = UsdSkel.BlendShape(prim).GetOffsetsAttr()
            offsets.Set(Vt.Vec3fArray.FromNumpy(np.array(offsets.Get()) + np.float32(0.01)))
        if prim.IsA(UsdSkel.Root):
            stage.GetAttributeAtPath(f"{prim.GetPath()}.extent").Clear()
            for time in range(5):
                UsdGeom.Boundable(prim).GetExtentAttr().Set(Vt.Vec3fArray([(-9, -9, -9), (9, 9, 9)]), time)
    stage.Export("other.usda")
    assert main(["verify", "other.usda"]) == 3
    assert "from the points that they stand for" in capsys.readouterr().err


def test_layers_add_the_shapes_of_the_shot_to_those_of_the_asset(there):
    assert main([*BAKE, "-o", "shapes", "--refine", "3"]) == 0
    layer, asset = "shapes/shots/brief/model/anim.usdc", "shapes/assets/model/geometry.usdc"
    away = np.linalg.norm(points_of(layer) - points_of("points.usda"), axis=-1)
    assert away.max() < 5e-3 and np.sqrt((away**2).mean()) < 1e-3
    stages = list(map(Usd.Stage.Open, (asset, layer)))
    shapes = [{prim.GetName() for prim in each.Traverse() if prim.IsA(UsdSkel.BlendShape)} for each in stages]
    assert shapes[0] < shapes[1]
    stage = Usd.Stage.Open(layer)
    quality = stage.GetDefaultPrim().GetVariantSet("quality")
    assert set(quality.GetVariantNames()) == {"full", "skin"} and quality.SetVariantSelection("skin")
    plain = points_of(stage)
    assert quality.SetVariantSelection("full") and np.abs(points_of(stage) - plain).max() > 1e-3
    del stage, stages, quality
    assert main(["verify", layer]) == 0
    assert main([*BAKE, "-o", "shapes"]) == 0  # the network's own, on the same asset
    np.testing.assert_allclose(points_of(layer), points_of("network.usda"), atol=2e-6)


def test_linear_blend_skinning_is_refined_to_shapes_too(there):
    assert main([*BAKE, "-o", "lbs.usda", "--lbs", "--refine", "2"]) == 0
    shot = read_provenance("lbs.usda")["refined"]
    assert Shot("lbs.usda").is_skinned and shot["joints lose, at most [mm]"] <= 5


def test_layers_offer_refined_points_beside_the_joints(there):
    assert main([*BAKE, "-o", "layers", "--refine", "3", "--refined-output", "points"]) == 0
    stage = Usd.Stage.Open("layers/shots/brief/model/anim.usdc")
    np.testing.assert_allclose(points_of(stage), points_of("network.usda"), atol=2e-6)
    assert stage.GetDefaultPrim().GetVariantSet("deformation").SetVariantSelection("points")
    np.testing.assert_allclose(points_of(stage), points_of("points.usda"), atol=2e-6)


@pytest.fixture(scope="module")
def hero(folder):
    """What is told of hero.usda, a shot of the level for heroes."""
    told = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(told):
        patch.chdir(folder)
        assert main([*BAKE, "-o", "hero.usda", "--quality", "hero", "--json"]) == 0
    return [json.loads(line) for line in told.getvalue().splitlines()]


def test_the_level_for_heroes_is_refined(there, hero):
    detail = hero[-1]["detail"]
    assert detail["refined: inside the body"].endswith("%") and detail["refined: moved, RMS [mm]"] > 0
    assert detail["refined: iterations"] > 0 and Shot("hero.usda").is_skinned


def test_with_feedback_the_cloth_goes_on_from_refined_frames(there, hero, capsys):
    words = ["--refine", "3", "--refined-output", "points", "--feedback"]
    assert main([*BAKE, "-o", "feedback.usda", *words]) == 0
    away = np.linalg.norm(points_of("feedback.usda") - points_of("points.usda"), axis=-1).max(axis=1)
    assert away[-1] > 1e-4, "in points.usda each frame is held where the network has it"
    assert main(["verify", "feedback.usda"]) == 0
    assert main([*BAKE, "-o", "said.usda", "--refine", str(QUALITIES["hero"].refine), "--feedback"]) == 0
    np.testing.assert_array_equal(points_of("hero.usda"), points_of("said.usda"))
    capsys.readouterr()
    assert main(["verify", "said.usda"]) == 0
    assert "its vertices are not compared with the solver's again" in capsys.readouterr().err
    stage = Usd.Stage.Open("said.usda")
    stage.SetEndTimeCode(2)
    stage.Export("cut.usda")
    assert main(["verify", "cut.usda"]) == 3 and "3 samples; 5 are needed" in capsys.readouterr().err


def test_with_feedback_cloth_of_any_model_may_rub(there, capsys):
    words = ["--refine", "3", "--refined-output", "points", "--feedback"]
    assert main([*BAKE, "-o", "smooth.usda", *words]) == 0
    capsys.readouterr()
    assert main([*BAKE, "-o", "rough.usda", *words, "--material", "friction=2"]) == 0
    assert "friction 2 in refinement; the network plays without it" in capsys.readouterr().err
    assert np.abs(points_of("rough.usda") - points_of("smooth.usda")).max() > 1e-4
    assert main(["verify", "rough.usda"]) == 0


def test_with_feedback_the_cloth_is_on_its_way_when_a_range_begins(there):
    """The motion before the range is refined as well: its frames do not begin at rest."""
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="brief.usda")
    request = replace(request, refine=2, feedback=True, refined_output="points")
    bake(request, "whole.usda")
    bake(replace(request, range="2-4"), "part.usda")
    np.testing.assert_allclose(points_of("part.usda"), points_of("whole.usda")[-3:], atol=1e-5)


def test_samples_within_frames_are_refined_too(there):
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="brief.usda")
    bake(replace(request, refine=1, refined_output="points", feedback=True, samples_per_frame=2), "blurred.usda")
    stage = Usd.Stage.Open("blurred.usda")
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Skirt")).GetPointsAttr().GetTimeSamples()[:3] == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--refine", "-1"], "a whole number from 0 to 10000"),
        (["--refine", "2", "--budget", "1MB"], "a budget for refined frames"),
        (["--feedback"], "--feedback: no --refine"),
        (["--refine", "2", "--material", "friction=0.4"], "--material friction=0.4: networks know no friction"),
        (["--quality", "hero", "--material", "friction=-1"], "friction = -1"),
        (["--quality", "hero", "--material", "friction=40"], "friction = 40; Coulomb's coefficient of cloth is some"),
        (["--quality", "hero", "--material", "bending=2x"], "for a model of one fabric"),
    ],
)
def test_what_cannot_be_done_is_refused(there, capsys, words, complaint):
    assert main([*BAKE, "-o", "refused.usda", *words]) == 2
    assert complaint in capsys.readouterr().err and not (there / "refused.usda").exists()
