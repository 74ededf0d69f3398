# SPDX-License-Identifier: Apache-2.0
"""Floors, wind and gravity in `ssilk simulate` and `ssilk bake`: who solves for them, and who says that not."""

from __future__ import annotations

import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdSkel
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, bake
from ssilk_core.delivery.bake.load import load_rollout
from ssilk_core.delivery.bake.met import props_of
from ssilk_core.delivery.bake.world import ShotSurroundings
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.parameters import seeing_more
from ssilk_core.network.proximity import proximity
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.sight import RestingPoints, seen_proximity
from ssilk_core.scene.kinematics import hub_places, motion_transforms

CLIPS = ("floored", "plain")
FLOOR = 0.75  # [m], above the hem of the skirt at 0.6 m


def with_floor(path, height: float = FLOOR) -> None:
    """Add a floor of one large quad, which USD's physics says collides, to a clip."""
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Xform.Define(stage, "/Set")
    mesh = UsdGeom.Mesh.Define(stage, "/Set/Floor")
    mesh.CreatePointsAttr([(-5, height, -5), (5, height, -5), (5, height, 5), (-5, height, 5)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    stage.GetRootLayer().Save()


@pytest.fixture
def stage(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "plain.usda", frames=5)
    with_floor(toy.write_clip(tmp_path / "floored.usda", frames=5))
    return tmp_path


def points_of(path) -> np.ndarray:
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in shot.frame_times])


SIMULATE = ["simulate", "rigged.usda", "--no-body", "--points", "--tolerance", "0.5", "--motion"]
BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--refined-output", "points", "--motion"]


def below(points: np.ndarray) -> float:
    return float((points[..., 1] < FLOOR - 5e-3).mean())


def test_a_simulated_skirt_stays_above_the_floor_of_its_shot(stage, capsys):
    assert main([*SIMULATE, "plain.usda", "-o", "plain_sim.usdc"]) == 0
    assert main([*SIMULATE, "floored.usda", "-o", "floored_sim.usdc"]) == 0
    assert "floored.usda: cloth meets /Set/Floor" in capsys.readouterr().err
    assert below(points_of("plain_sim.usdc")) > 0.1
    assert below(points_of("floored_sim.usdc")) == 0


def test_wind_and_gravity_move_a_simulated_skirt_to_where_they_point(stage):
    for name, more in (
        ("still", []),
        ("wind", ["--wind", "6,0,0"]),
        ("gusty", ["--gusts", "3"]),
        ("side", ["--gravity", "9.81,0,0"]),
    ):
        assert main([*SIMULATE, "plain.usda", "-o", f"{name}.usdc", *more]) == 0
    still, wind, gusty, side = (points_of(f"{name}.usdc")[-1] for name in ("still", "wind", "gusty", "side"))
    assert wind[:, 0].mean() > still[:, 0].mean() + 0.02
    assert side[:, 0].mean() > still[:, 0].mean() + 0.02
    assert np.abs(gusty - still).max() > 1e-3


def test_a_file_is_simulated_again_where_the_wind_is_another(stage, capsys):
    for more, is_current in ([], False), (["--wind", "3,0,0"], False), (["--wind", "3,0,0"], True):
        assert main([*SIMULATE, "plain.usda", "-o", "shots", *more]) == 0
        assert ("current: 1" in capsys.readouterr().err) is is_current


def test_the_network_alone_says_that_it_does_not_see_the_floor(stage, capsys):
    assert main([*BAKE, "floored.usda", "-o", "network.usdc"]) == 0
    told = capsys.readouterr().err
    assert "the network does not see colliders: it plays without; --refine N or" in told
    assert main([*BAKE, "plain.usda", "-o", "plain_network.usdc"]) == 0
    assert "does not see" not in capsys.readouterr().err
    np.testing.assert_array_equal(points_of("network.usdc"), points_of("plain_network.usdc"))
    clip = Usd.Stage.Open("floored.usda")
    clip.GetPrimAtPath("/Set/Floor").GetAttribute("faceVertexCounts").Set([4], 3)  # what the solver cannot meet
    clip.GetRootLayer().Save()
    assert main([*BAKE, "floored.usda", "-o", "refined.usdc", "--refine", "1"]) == 2
    assert "its faces change over time" in capsys.readouterr().err
    assert main([*BAKE, "floored.usda", "-o", "lbs.usdc", "--lbs"]) == 0
    assert "does not see" not in capsys.readouterr().err


def let_it_see(path: str) -> None:
    """Make a model's network see colliders, somehow."""
    file, dice = load_model(path), np.random.default_rng(3)
    config = replace(file.config, proximity_points=6)
    blind, parameters = file.parameters, seeing_more(file.parameters, file.scene, file.config, config)
    for name, value in parameters.items():
        if value.shape != blind[name].shape:
            parameters[name] = value + (value == 0) * dice.normal(0, 0.2, value.shape).astype(value.dtype)
    save_model(path, replace(file, config=config, parameters=parameters))


def test_a_network_that_sees_colliders_plays_with_the_floor_of_its_shot_and_says_so(stage, capsys):
    let_it_see("model.safetensors")
    told = {}
    for name, more in (("plain", []), ("floored", []), ("latent", ["--latent-iterations", "1"])):
        clip = "plain.usda" if name == "plain" else "floored.usda"
        assert main([*BAKE, clip, "-o", f"{name}.usdc", *more]) == 0
        told[name] = capsys.readouterr().err
    assert "colliders" not in told["plain"] and "the network sees" not in told["plain"]
    assert "floored.usda: the network sees /Set/Floor" in told["floored"]
    assert "know colliders" not in told["floored"] and "does not see" not in told["floored"]
    assert "the solver in latents does not see colliders" in told["latent"]
    player = Player.load("model.safetensors")
    motion, scene = (
        read_motion("floored.usda", player.skeleton),
        load_rollout(BakeRequest(model="model.safetensors", stage="rigged.usda", motion="plain.usda")).deformer.scene,
    )
    # Where each point of P's state for the pose alone is, and the floor beneath it.
    joints = motion_transforms(motion, player.skeleton.parents)
    points, reach = RestingPoints(player)(motion, joints), scene.garment.mesh.diagonal
    roots = joints[:, player.skeleton.hub, :3, 3]
    up, above = np.tile([0.0, 1.0, 0.0], (points.shape[1], 1)), points[..., 1] - FLOOR
    assert above.max() < reach
    seen = [proximity(own, high, up, root, reach) for own, high, root in zip(points, above, roots)]
    playback = player.play(replace(motion, proximity=np.stack(seen)))
    expected = np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])
    np.testing.assert_allclose(points_of("floored.usdc"), expected, atol=1e-5)
    assert np.abs(points_of("plain.usdc") - expected).max() > 1e-3


def test_bakes_count_the_cloth_in_the_colliders_of_their_shot(stage, capsys):
    clip = Usd.Stage.Open("floored.usda")
    box = UsdGeom.Cube.Define(clip, "/Set/Box")  # around the body, above the floor
    box.CreateSizeAttr(0.4)
    box.AddTranslateOp().Set((0, 0.95, 0))
    UsdPhysics.CollisionAPI.Apply(box.GetPrim())
    clip.GetRootLayer().Save()
    baked = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion"]
    for more in ([], ["--lbs"], ["--refine", "2", "--refined-output", "points"]):
        assert main([*baked, "floored.usda", "-o", "shot.usdc", *more]) == 0
        told, found = capsys.readouterr().err, points_of("shot.usdc")
        depths = FLOOR - found[..., 1], 0.2 - np.abs(found - [0, 0.95, 0]).max(axis=-1)
        under, boxed = (depth > 5e-3 for depth in depths)
        share = (under | boxed).mean(axis=1)
        said = read_provenance("shot.usdc")["sunk_cloth"]
        assert said["frames"] == 5 and said["mean"] == pytest.approx(share.mean(), rel=1e-3)
        assert said["worst"] == pytest.approx(share.max(), rel=1e-3) and said["frame"] == share.argmax()
        together = under.sum() + boxed.sum()
        assert boxed.any() and said["colliders"] == pytest.approx(
            {"/Set/Floor": under.sum() / together, "/Set/Box": boxed.sum() / together}, abs=1e-4
        )
        assert said["deepest"] == pytest.approx(max(depth.max() for depth in depths), rel=1e-3)
        assert f"cloth inside colliders: {share.mean():.3%}, the mean of 5 frames" in told
        assert f"{share.max():.2%}, floored at time code {share.argmax()}" in told and "/Set/Floor" in told
    layers = [*baked, "floored.usda", "plain.usda", "-o", "layers"]
    assert main(layers) == 0
    records = [json.loads(next((stage / f"layers/shots/{shot}").glob("*/bake.json")).read_text()) for shot in CLIPS]
    assert records[0]["detail"]["sunk"]["frames"] == 5 and "sunk" not in records[1]["detail"]
    capsys.readouterr()
    assert main(layers) == 0 and "current" in capsys.readouterr().err
    for shot, page in ("shot.usdc", "file"), ("layers/shots/floored/shot.usda", "layers"):
        assert main(["report", shot, "-o", f"{page}.html"]) == 0
        told = capsys.readouterr().err
        assert ": cloth in colliders: " in told and "its model is not where" not in told
        assert "it is inside colliders" in (text := (stage / f"{page}.html").read_text())
        assert "request.model" in text.partition("Provenance")[2]
        assert "of its vertices were more than 5 mm inside colliders on average" in text and "/Set/Floor" in text
    assert main(["report", "layers/shots/plain/shot.usda", "-o", "plain.html"]) == 0
    assert "colliders" not in capsys.readouterr().err and "inside colliders" not in (stage / "plain.html").read_text()
    assert main([*baked, "plain.usda", "-o", "plain.usdc"]) == 0
    assert "colliders" not in capsys.readouterr().err and "sunk_cloth" not in read_provenance("plain.usdc")
    assert main(["verify", "shot.usdc"]) == 0


def test_films_and_sheets_show_the_colliders_that_a_bake_met(toy, stage, capsys):
    clip = Usd.Stage.Open("floored.usda")
    clip.RemovePrim("/Set/Floor")
    box = UsdGeom.Cube.Define(clip, "/Set/Box")
    box.CreateSizeAttr(0.6)
    place = box.AddTranslateOp()
    for code in range(5):
        place.Set((-0.9 + 0.2 * code, 1.0, -0.6), code)
    UsdPhysics.CollisionAPI.Apply(box.GetPrim())
    clip.GetRootLayer().Save()
    baked = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "floored.usda", "plain.usda"]
    assert main([*baked, "-o", "layers"]) == 0
    assert main([*baked[:-1], "-o", "shot.usdc"]) == 0
    with_box, found = prop_pixels("shot.usdc"), prop_pixels("layers/shots/floored/shot.usda")
    np.testing.assert_array_equal(with_box, found)
    assert with_box[0].sum() > 200 and prop_pixels("layers/shots/plain/shot.usda").sum() == 0
    middles = [np.argwhere(each)[:, 1].mean() for each in with_box]
    assert middles[0] + 10 < middles[1]  # it moves
    capsys.readouterr()
    for gone in "model.safetensors", "rigged.usda":  # neither model nor character is needed for a picture
        Path(gone).unlink()
    np.testing.assert_array_equal(prop_pixels("shot.usdc"), with_box)
    assert "warning" not in capsys.readouterr().err
    for shot in "shot.usdc", "layers/shots/floored/shot.usda":
        assert main(["view", shot, "-o", "page.html"]) == 0
        assert [mesh["points"] for mesh in played_meshes("page.html")][-1] == 36
    assert "checked> /Set/Box<" in Path("page.html").read_text()
    clip.RemovePrim("/Set/Box")
    clip.GetRootLayer().Save()
    assert main(["view", "shot.usdc", "-o", "alone.png", *SHEET]) == 0
    gone = "warning: shot.usdc: the colliders that it met are not drawn: floored.usda: it has no /Set/Box any more"
    assert gone in capsys.readouterr().err
    Path("floored.usda").unlink()
    assert main(["view", "shot.usdc", "-o", "alone.png", *SHEET]) == 0
    told = capsys.readouterr().err
    assert "warning: shot.usdc: the colliders that it met are not drawn: the stage of its colliders is not" in told


def test_colliders_of_a_single_shot_of_any_name_and_of_several_garments_in_one_glb_are_shown(stage, capsys):
    """A file that is called as the stages of folders are is a shot of its own, and a glb says it of each garment."""
    shutil.copy("model.safetensors", "second.safetensors")
    bake = ["--stage", "rigged.usda", "--motion", "floored.usda"]
    assert main(["bake", "model.safetensors", *bake, "-o", "shot.usda"]) == 0
    assert main(["bake", "model.safetensors", "second.safetensors", *bake, "-o", "both.glb", "--target", "glb"]) == 0
    for shot in Path("shot.usda"), Path("both.glb"):
        met = props_of(shot, silent)
        assert met and [each.name for each in met.world.colliders] == ["/Set/Floor"], shot
    capsys.readouterr()
    assert main(["report", "shot.usda", "-o", "page.html"]) == 0
    assert ": cloth in colliders: " in capsys.readouterr().err


def played_meshes(page: str) -> list[dict[str, object]]:
    """What a page says of the meshes that it plays."""
    about = re.search(r'data-about="([^"]*)"', Path(page).read_text())
    return json.loads(html.unescape(about[1]))["meshes"]


@pytest.mark.slow
def test_pages_simulations_and_skinned_caches_count_and_show_colliders_as_bakes_do(stage, capsys):
    clip = Usd.Stage.Open("floored.usda")
    box = UsdGeom.Cube.Define(clip, "/Set/Box")
    box.CreateSizeAttr(0.4)
    box.AddTranslateOp().Set((0.5, 0.95, 0))
    UsdPhysics.CollisionAPI.Apply(box.GetPrim())
    clip.GetRootLayer().Save()
    # A cache that knows of no colliders goes through those of its motion.
    assert main([*SIMULATE, "plain.usda", "-o", "plain_sim.usdc"]) == 0
    skin = ["skin", "plain_sim.usdc", "--stage", "rigged.usda", "--motion", "floored.usda", "-o", "skinned.usdc"]
    capsys.readouterr()
    assert main(skin) == 0
    told, found = capsys.readouterr().err, points_of("skinned.usdc")
    under = found[..., 1] < FLOOR - 5e-3
    boxed = np.abs(found - [0.5, 0.95, 0]).max(axis=-1) < 0.2 - 5e-3
    share = (under | boxed).mean(axis=1)
    said = read_provenance("skinned.usdc")["sunk_cloth"]
    assert share.min() > 0.1 and said["mean"] == pytest.approx(share.mean(), rel=1e-3)
    assert f"cloth inside colliders: {share.mean():.3%}, the mean of 5 frames" in told
    for more in ["--points"], []:
        command = [each for each in SIMULATE if each != "--points"]
        assert main([*command, "floored.usda", "-o", "sim.usdc", *more]) == 0
        assert "cloth inside colliders: 0.000%, the mean of 5 frames" in capsys.readouterr().err
        said = read_provenance("sim.usdc")
        assert said["sunk_cloth"]["mean"] == 0 and list(said["colliders"]["prims"]) == ["/Set/Floor", "/Set/Box"]
    for shot in "skinned.usdc", "sim.usdc":
        assert main(["report", shot, "-o", "page.html"]) == 0
        assert ": cloth in colliders: " in capsys.readouterr().err
        assert "checked> /Set/Box<" in Path("page.html").read_text()
    model = ["report", "model.safetensors", "--stage", "rigged.usda", "--motion", "floored.usda", "-o", "model.html"]
    assert main(model) == 0
    told = capsys.readouterr().err
    assert "the network does not see colliders" in told and ": cloth in colliders: " in told
    assert "checked> /Set/Box<" in Path("model.html").read_text()
    assert main(["bake", *model[1:-2], "-o", "shot.usdc"]) == 0
    mean = read_provenance("shot.usdc")["sunk_cloth"]["mean"]
    assert f": cloth in colliders: {mean:.3%} of the vertices" in told


SHEET = ["--columns", "2", "--size", "200x200", "--azimuth", "0"]


def prop_pixels(shot: str) -> np.ndarray:
    """Which pixels of the first and the last frame of a shot have the colour of props, bluer than all else."""
    assert main(["view", shot, "-o", "sheet.png", *SHEET]) == 0
    picture = np.asarray(Image.open("sheet.png").convert("RGB")).astype(int)
    panels = np.stack([picture[:, :200], picture[:, -200:]])
    return (panels[..., 2] > panels[..., 0] + 12) & (panels.sum(axis=-1) < 3 * 175)


@pytest.mark.parametrize("sees", [True, False])
def test_a_network_goes_on_without_a_collider_that_cannot_be_read(stage, capsys, sees):
    if sees:
        let_it_see("model.safetensors")
    assert main([*BAKE, "floored.usda", "-o", "whole.usdc"]) == 0
    clip = Usd.Stage.Open("floored.usda")
    for path in "/Set/Bad", "/Set/Flat":
        mesh = UsdGeom.Mesh.Define(clip, path)
        mesh.CreatePointsAttr([(0, 0.9, 0), (1, 0.9, 0), (1, 0.9, 1) if path == "/Set/Bad" else (2, 0.9, 0)])
        mesh.CreateFaceVertexCountsAttr([3])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    clip.GetPrimAtPath("/Set/Bad").GetAttribute("faceVertexCounts").Set([3], 3)
    clip.GetRootLayer().Save()
    capsys.readouterr()
    assert main([*BAKE, "floored.usda", "-o", "network.usdc"]) == 0
    told = capsys.readouterr().err
    left_out = "warning: floored.usda:/Set/Bad: its faces change over time; the topology of a collider stays"
    assert told.count(left_out) == 1 and "Cloth does not meet it." in told
    assert told.count("floored.usda:/Set/Flat: no triangle of it has an area") == 1
    assert ("the network sees /Set/Floor\n" in told) is sees
    np.testing.assert_array_equal(points_of("network.usdc"), points_of("whole.usdc"))
    assert main(["verify", "network.usdc"]) == 0
    capsys.readouterr()
    assert main([*BAKE, "floored.usda", "-o", "lbs.usdc", "--lbs"]) == 0
    told = capsys.readouterr().err
    assert told.count(left_out) == 1 and "/Set/Flat: no triangle of it has an area" in told
    assert "does not see" not in told and "/Set/Bad" not in read_provenance("lbs.usdc")["sunk_cloth"]["colliders"]
    for command in ([*BAKE, "floored.usda", "--refine", "1"], [*SIMULATE, "floored.usda"]):
        assert main([*command, "-o", "solved.usdc"]) == 2
        assert "/Set/Bad: its faces change over time" in capsys.readouterr().err


def test_a_wrong_name_is_answered_with_the_stages_that_were_searched_and_what_is_there(stage, capsys):
    assert main([*BAKE, "floored.usda", "-o", "refused.usdc", "--collider", "Flor"]) == 2
    told = capsys.readouterr().err
    assert "--collider Flor: floored.usda and rigged.usda have no such prim; there are /Set/Floor in" in told
    assert "did you mean '/Set/Floor'?" not in told and "did you mean 'Floor'?" in told


def capsule_on(path: str, name: str, radius: float, height: float, at: tuple[float, float, float]) -> None:
    """Add a capsule that collides and goes with the hips of the toy's clip, as a ragdoll's do."""
    clip = Usd.Stage.Open(path)
    shape = UsdGeom.Capsule.Define(clip, f"/Ragdoll/{name}")
    for attribute, value in ((shape.CreateRadiusAttr(), radius), (shape.CreateHeightAttr(), height)):
        attribute.Set(value)
    shape.CreateAxisAttr("Y")
    place, hips = shape.AddTranslateOp(), UsdSkel.Animation(clip.GetPrimAtPath("/Clip")).GetTranslationsAttr()
    for code in hips.GetTimeSamples():
        sway = hips.Get(code)[0][0]
        place.Set(Gf.Vec3d(at[0] + sway, *at[1:]), code)
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    clip.GetRootLayer().Save()


def test_shapes_inside_the_body_are_its_own_unless_they_are_asked_for(stage, capsys):
    """The body is a pillar of a radius of 15 cm."""
    capsule_on("floored.usda", "Trunk", 0.13, 0.5, (0, 1.0, 0))
    capsule_on("floored.usda", "Beside", 0.13, 0.5, (0.3, 1.0, 0))
    command = [*SIMULATE, "floored.usda", "-o"]
    assert main([*command, "own.usdc"]) == 0
    told = capsys.readouterr().err
    own = "floored.usda: cloth does not meet /Ragdoll/Trunk, inside the character's body in each frame, as"
    assert told.count(own) == 1 and "cloth meets /Set/Floor, /Ragdoll/Beside\n" in told
    assert main([*command, "asked.usdc", "--collider", "Trunk"]) == 0
    told = capsys.readouterr().err
    assert own not in told and "cloth meets /Set/Floor, /Ragdoll/Trunk, /Ragdoll/Beside\n" in told
    let_it_see("model.safetensors")
    assert main([*BAKE, "floored.usda", "-o", "network.usdc"]) == 0
    told = capsys.readouterr().err
    assert told.count(own) == 1 and "the network sees /Set/Floor, /Ragdoll/Beside\n" in told


def test_gusts_are_the_same_in_whatever_range_of_a_shot(toy, stage):
    toy.write_clip(stage / "long.usda", frames=90)
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="long.usda", gusts="6,2,1")
    whole, part = (load_rollout(replace(request, range=each)).source for each in (None, "60-89"))
    assert part.start > 0 and np.ptp(part.gravity, axis=0).min() > 1
    follow = part.frame_count - 1  # the first has no frame before it, from which the root would come
    np.testing.assert_allclose(part.gravity[1:], whole.gravity[-follow:], atol=1e-9)


def test_the_network_feels_wind_and_gravity_as_the_player_does(stage, capsys):
    clip = Usd.Stage.Open("plain.usda")
    scene = UsdPhysics.Scene.Define(clip, "/Physics")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(1, -1, 0))
    clip.GetRootLayer().Save()
    assert main([*BAKE, "plain.usda", "-o", "blown.usdc", "--wind", "0,0,4"]) == 0
    told = capsys.readouterr().err
    assert "does not see" not in told and "was trained in still air" in told
    player = Player.load("model.safetensors")
    motion = read_motion("plain.usda", player.skeleton)
    fabric = player.file.fabric
    felt = 9.81 * np.array([1, -1, 0]) / np.sqrt(2) + fabric.drag / fabric.density * np.array([0, 0, 4.0])
    hub = hub_places(player.skeleton, motion.rotations, motion.translations)
    steps = np.diff(hub, axis=0) * motion.fps
    pulled = felt - fabric.drag / fabric.density * np.concatenate([steps[:1], steps])
    playback = player.play(replace(motion, gravity=pulled))
    expected = np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])
    np.testing.assert_allclose(points_of("blown.usdc"), expected, atol=1e-5)
    assert main(["verify", "blown.usdc"]) == 0


def test_wind_that_is_stronger_than_in_training_is_told(stage, capsys):
    assert main([*BAKE, "plain.usda", "-o", "storm.usdc", "--wind", "-40,0,0"]) == 0
    assert "gravity and wind pull with up to" in capsys.readouterr().err
    assert main([*BAKE, "plain.usda", "-o", "breeze.usdc", "--wind", "-4,0,0"]) == 0
    assert "pull with up to" not in capsys.readouterr().err


def test_a_network_that_was_trained_in_wind_says_nothing_of_it(stage, capsys):
    file = load_model("model.safetensors")
    train = {**file.provenance.get("train", {}), "wind_fraction": 0.25}
    save_model("model.safetensors", replace(file, provenance={**file.provenance, "train": train}))
    assert main([*BAKE, "plain.usda", "-o", "blown.usdc", "--wind", "0,0,4"]) == 0
    assert "network" not in capsys.readouterr().err


def test_a_network_that_sees_colliders_plays_as_the_player_does(stage, capsys):
    file = load_model("model.safetensors")
    config = replace(file.config, proximity_points=5)
    parameters = seeing_more(file.parameters, file.scene, file.config, config)
    for name in ("initialiser.0.weight", "stepper.0.weight"):
        empty = (parameters[name] == 0).all(axis=0)
        assert empty.sum() == 15
        parameters[name][:, empty] = np.random.default_rng(1).normal(size=(len(parameters[name]), 15))
    save_model("seeing.safetensors", replace(file, config=config, parameters=parameters))
    seeing = ["bake", "seeing.safetensors", *BAKE[2:]]
    assert main([*seeing, "floored.usda", "-o", "seen.usdc"]) == 0
    assert "does not see" not in capsys.readouterr().err
    assert main(["verify", "seen.usdc"]) == 0
    player, motion = Player.load("seeing.safetensors"), read_motion("floored.usda", file.scene.character.skeleton)
    scene = player.file.scene
    world = ShotSurroundings("floored.usda", "rigged.usda", scene, motion, None).seen
    near = seen_proximity(world, motion, player)
    assert len(world.colliders) == 1 and np.abs(near).max() > 0.5
    for name, felt in ("seen.usdc", near), ("blind.usdc", None):
        playback = player.play(replace(motion, proximity=felt))
        expected = np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])
        if felt is None:  # nothing is near where there is no collider
            assert main([*seeing, "plain.usda", "-o", name]) == 0
        np.testing.assert_allclose(points_of(name), expected, atol=1e-5)
    assert np.abs(points_of("seen.usdc") - points_of("blind.usdc")).max() > 1e-3
    capsys.readouterr()
    assert main([*seeing, "floored.usda", "-o", "latent.usdc", "--latent-iterations", "1"]) == 0
    assert "the solver in latents does not see colliders" in capsys.readouterr().err
    assert main([*seeing, "plain.usda", "-o", "latent_plain.usdc", "--latent-iterations", "1"]) == 0
    np.testing.assert_array_equal(points_of("latent.usdc"), points_of("latent_plain.usdc"))


@pytest.mark.slow
@pytest.mark.parametrize("more", [["--refine", "30"], ["--refine", "30", "--feedback"]], ids=["refine", "feedback"])
def test_a_refined_skirt_stays_above_the_floor_and_verifies(stage, capsys, more):
    assert main([*BAKE, "plain.usda", "-o", "plain_refined.usdc", *more]) == 0
    assert main([*BAKE, "floored.usda", "-o", "refined.usdc", *more]) == 0
    assert "does not see" not in capsys.readouterr().err
    assert below(points_of("plain_refined.usdc")) > 0.1
    assert below(points_of("refined.usdc")) < 0.01
    assert main(["verify", "refined.usdc"]) == 0


def test_a_refined_shot_remembers_what_was_asked_for(stage):
    request = BakeRequest(
        model="model.safetensors", stage="rigged.usda", motion="plain.usda", refine=2, wind="4,0,0", gusts="1,2,3",
        gravity="0,-5,0", colliders=("/Set/Floor", "Floor"), refined_output="points",
    )  # fmt: skip
    assert BakeRequest.from_metadata(request.to_metadata()) == request
    with_floor("plain.usda")
    bake(request, "asked.usdc")
    assert read_provenance("asked.usdc")["request"]["colliders"] == "/Set/Floor Floor"
    assert main(["verify", "asked.usdc"]) == 0


def test_a_floor_that_rises_lifts_the_hem(stage):
    clip = Usd.Stage.Open("floored.usda")
    lift = UsdGeom.Xformable(clip.GetPrimAtPath("/Set")).AddTranslateOp()
    for frame in range(5):
        lift.Set(Gf.Vec3d(0, 0.02 * frame, 0), frame)
    clip.GetRootLayer().Save()
    assert main([*SIMULATE, "floored.usda", "-o", "rising.usdc"]) == 0
    found = points_of("rising.usdc")
    lowest = found[..., 1].min(axis=1)
    assert (lowest > FLOOR + 0.02 * np.arange(5)).all() and lowest[-1] < FLOOR + 0.08 + 0.02


def test_gravity_of_the_physics_scene_is_simulated(stage):
    clip = Usd.Stage.Open("plain.usda")
    scene = UsdPhysics.Scene.Define(clip, "/Physics")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(1, 0, 0))
    clip.GetRootLayer().Save()
    assert main([*SIMULATE, "plain.usda", "-o", "said.usdc"]) == 0
    scene.GetPrim().GetAttribute("physics:gravityDirection").Clear()
    clip.GetRootLayer().Save()
    assert main([*SIMULATE, "plain.usda", "-o", "asked.usdc", "--gravity", "9.81,0,0"]) == 0
    np.testing.assert_allclose(points_of("said.usdc"), points_of("asked.usdc"), atol=1e-5)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--wind", "5"], "--wind: '5'; X,Y,Z is needed"),
        (["--wind", "north,0,0"], "--wind: 'north,0,0'; X,Y,Z is needed"),
        (["--wind", "0,0,1000"], "at most 100 m/s"),
        (["--gusts", "3,0"], "--gusts: '3,0'; RMS[,SIZE[,SEED]] is needed"),
        (["--gravity", "0,nan,0"], "--gravity: '0,nan,0'; X,Y,Z is needed"),
        (["--collider", "Chair"], "--collider Chair: "),
        (["--collider", "Skirt"], "is a garment"),
        (["--wind", "1,0,0", "--material", "drag=0"], "has no drag"),
    ],
)
def test_what_cannot_surround_a_character_is_refused_in_one_sentence(stage, capsys, words, complaint):
    before = sorted(stage.iterdir())
    assert main([*SIMULATE, "plain.usda", "-o", "refused.usdc", *words]) == 2
    assert complaint in capsys.readouterr().err
    assert sorted(stage.iterdir()) == before


def test_types_of_attributes_that_are_not_the_wind_are_refused_by_a_bake(stage, capsys):
    clip = Usd.Stage.Open("plain.usda")
    prim = UsdPhysics.Scene.Define(clip, "/Physics").GetPrim()
    prim.CreateAttribute("ssilk:wind", Sdf.ValueTypeNames.Float).Set(3.0)
    clip.GetRootLayer().Save()
    assert main([*BAKE, "plain.usda", "-o", "refused.usdc"]) == 2
    assert "ssilk:wind is 3.0; a vector of three numbers is needed" in capsys.readouterr().err
