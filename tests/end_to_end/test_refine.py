# SPDX-License-Identifier: Apache-2.0
"""`ssilk bake --refine` on the toy world: points, joints, layers, what is stated, and what verifying finds."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt
from ssilk_usd.play import Shot
from ssilk_usd.provenance import read_provenance

from ssilk_core.bake import BakeRequest, bake
from ssilk_core.cli import main

BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda"]


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("refined"))
    toy.write_clip(folder / "brief.usda", frames=5)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*BAKE, "-o", "network.usda"]) == 0
        assert main([*BAKE, "-o", "points.usda", "--refine", "3"]) == 0
        assert main([*BAKE, "-o", "joints.usda", "--refine", "3", "--refined-output", "joints"]) == 0
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
    assert 0.5 < np.sqrt((away**2).mean()) / stated["joints lose, RMS [mm]"] < 2  # not weighted by mass here
    network = np.linalg.norm(points_of("network.usda") - points_of("points.usda"), axis=-1) * 1000
    assert (away**2).mean() < (network**2).mean()


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


def test_layers_offer_refined_points_beside_the_joints(there):
    assert main([*BAKE, "-o", "layers", "--refine", "3"]) == 0
    stage = Usd.Stage.Open("layers/shots/brief/model/anim.usdc")
    np.testing.assert_allclose(points_of(stage), points_of("network.usda"), atol=2e-6)
    assert stage.GetDefaultPrim().GetVariantSet("deformation").SetVariantSelection("points")
    np.testing.assert_allclose(points_of(stage), points_of("points.usda"), atol=2e-6)


def test_the_level_for_heroes_is_refined(there, capsys):
    assert main([*BAKE, "-o", "hero.usda", "--quality", "hero", "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1]["detail"]["refined: iterations"] > 0 and not Shot("hero.usda").is_skinned


def test_samples_within_frames_are_refined_too(there):
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="brief.usda")
    bake(replace(request, refine=1, feedback=True, samples_per_frame=2), "blurred.usda")
    stage = Usd.Stage.Open("blurred.usda")
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Skirt")).GetPointsAttr().GetTimeSamples()[:3] == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--refine", "-1"], "a whole number from 0 to 10000"),
        (["--refine", "2", "--lbs", "--refined-output", "joints"], "use --refined-output points"),
        (["--refine", "2", "--budget", "1MB"], "a budget for points"),
    ],
)
def test_what_cannot_be_done_is_refused(there, capsys, words, complaint):
    assert main([*BAKE, "-o", "refused.usda", *words]) == 2
    assert complaint in capsys.readouterr().err and not (there / "refused.usda").exists()
