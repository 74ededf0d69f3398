# SPDX-License-Identifier: Apache-2.0
"""Bakes as layers: what docs/pipeline.md promises to those who compose, override, retime, switch and bake again."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, UsdValidation
from ssilk_usd.opening.garment_api import SCHEMA, read_garment_record
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, LayerFolder, load_rollout, plan_layers, shot_bytes
from ssilk_core.delivery.targets import GLB, TARGETS, Target, cap_influences
from ssilk_core.errors import SsilkError
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model
from ssilk_core.scene.kinematics import deform

STAGES = [name for name, target in TARGETS.items() if GLB not in target.suffixes]
SHOT_FILES = ("anim.usdc", "points.usdc", "bake.json")
GARMENT, BAKE = "skirt", "bake skirt.safetensors --stage rigged.usda"


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """The toy world with two clips of 12 frames, and their layers in `layers`."""
    folder = tmp_path_factory.mktemp("layers")
    toy.copy(folder)
    shutil.move(folder / "model.safetensors", folder / "skirt.safetensors")
    for name in ("walk", "run"):
        toy.write_clip(folder / f"{name}.usda", frames=12 if name == "walk" else 9)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert bake("--motion walk.usda run.usda --points -o layers") == 0
    return folder


def bake(words: str) -> int:
    return main(shlex.split(f"{BAKE} {words}"))


def said(capsys: pytest.CaptureFixture[str], words: str) -> list[dict]:
    capsys.readouterr()
    bake(f"{words} --json")
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def anim(shot: str = "walk", garment: str = GARMENT) -> Path:
    return Path("layers/shots") / shot / garment / "anim.usdc"


def hashes(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def changes() -> dict[Path, int]:
    """Return when each file of the layers was written."""
    return {path: path.stat().st_mtime_ns for path in Path("layers").rglob("*") if path.is_file()}


def garment_points(path: Path | Usd.Stage, times: list[float] | None = None) -> np.ndarray:
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in times or shot.frame_times])


def test_an_asset_that_stays_and_a_small_layer_for_each_shot(world):
    folder = world / "layers"
    assert set(hashes(folder)) == {
        *(f"assets/skirt/{name}" for name in ("asset.usda", "geometry.usdc", "info.usda", "used.json")),
        *(f"shots/{shot}/shot.usda" for shot in ("walk", "run")),
        *(f"shots/{shot}/skirt/{name}" for shot in ("walk", "run") for name in SHOT_FILES),
    }  # fmt: skip
    layer = Sdf.Layer.FindOrOpen(str(folder / "shots/walk/skirt/anim.usdc"))
    specs: list[str] = []
    layer.Traverse("/", lambda path: specs.append(str(path)))
    assert not [path for path in specs if path.endswith((".points", "offsets", "bindTransforms", "jointIndices"))]


def test_the_asset_is_a_component_with_bounds_and_variants_before_its_payload_is_loaded(world):
    stage = Usd.Stage.Open(str(world / "layers/assets/skirt/asset.usda"), Usd.Stage.LoadNone)
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "SkelRoot" and Usd.ModelAPI(prim).GetKind() == "component" and prim.HasPayload()
    assert not prim.GetChildren() and len(UsdGeom.Boundable(prim).GetExtentAttr().Get()) == 2
    sets = prim.GetVariantSets()
    assert {name: sorted(sets.GetVariantSet(name).GetVariantNames()) for name in sets.GetNames()} == {
        "deformation": ["rest", "skel"], "quality": ["full", "skin"],
    }  # fmt: skip


@pytest.mark.parametrize("shot", ["walk", "run"])
def test_each_layer_is_verified_by_itself(world, shot, monkeypatch):
    monkeypatch.chdir(world)
    assert main(["verify", str(anim(shot))]) == 0


def test_stock_usd_bakes_the_composed_shot_to_the_same_points(copy):
    expected = garment_points(anim())
    stage = Usd.Stage.Open("layers/shots/walk/shot.usda")
    assert UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Shot/skirt/Skirt"))
    for frame, points in enumerate(expected):
        space = np.array(mesh.ComputeLocalToWorldTransform(frame))
        baked = np.array(mesh.GetPointsAttr().Get(frame)) @ space[:3, :3] + space[3, :3]
        np.testing.assert_allclose(baked, points, atol=2e-6)


def test_variants_switch_what_deforms_the_garment(copy):
    full = garment_points(anim())

    def switched(name: str, choice: str) -> np.ndarray:
        stage = Usd.Stage.Open(str(anim()))
        stage.GetDefaultPrim().GetVariantSet(name).SetVariantSelection(choice)
        return garment_points(stage)

    np.testing.assert_allclose(switched("deformation", "points"), full, atol=2e-6)
    stage = Usd.Stage.Open(str(anim()))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/skirt/Animation"))
    for time in animation.GetBlendShapeWeightsAttr().GetTimeSamples():
        animation.GetBlendShapeWeightsAttr().Set([0.0] * len(animation.GetBlendShapesAttr().Get()), time)
    np.testing.assert_allclose(switched("quality", "skin"), garment_points(stage), atol=1e-7)
    rest = switched("deformation", "rest")
    centred = rest - rest.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(centred, np.broadcast_to(centred[0], centred.shape), atol=1e-6)
    assert np.abs(full - full.mean(axis=1, keepdims=True) - centred).max() > 1e-3


def test_shots_of_one_model_are_value_clips_of_its_asset(copy, toy):
    """UsdClipsAPI plays samples alone: whatever is constant has to be the asset's, and alike in all shots."""
    bend = Usd.Stage.Open(str(toy.write_clip(copy / "bend.usda", frames=10)))
    rotations = UsdSkel.Animation(bend.GetPrimAtPath("/Clip")).GetRotationsAttr()
    for frame in range(10):  # another joint than in the other shots
        turned = Gf.Quatf(float(np.cos(frame / 20)), float(np.sin(frame / 20)), 0, 0)
        rotations.Set([rotations.Get(frame)[0], turned, *rotations.Get(frame)[2:]], frame)
    bend.Save()
    del bend, rotations
    assert bake("--motion bend.usda -o layers") == 0
    shots, starts = ("walk", "bend"), (0.0, 20.0)
    stage = Usd.Stage.CreateNew("edit.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    prim = stage.DefinePrim("/World/Cape")
    prim.GetReferences().AddReference("layers/assets/skirt/asset.usda")
    clips = Usd.ClipsAPI(prim)
    clips.SetClipAssetPaths([Sdf.AssetPath(str(anim(shot))) for shot in shots])
    clips.SetClipPrimPath("/skirt")
    clips.SetClipActive([(start, number) for number, start in enumerate(starts)])
    clips.SetClipTimes([(start + time, time) for start in starts for time in (0.0, 15.0)])
    stage.SetTimeCodesPerSecond(30.0)
    stage.Save()
    for shot, start in zip(shots, starts):
        expected = garment_points(anim(shot))
        found = garment_points(stage, [start + time for time in range(len(expected))])
        assert np.abs(found - expected).max() < 1e-5, shot
    assert len(garment_points(anim("bend"))) == 10 and np.ptp(garment_points(anim("bend")), axis=0).max() > 0.05


@pytest.mark.parametrize("choice", ["skel", "rest", "points"])
def test_each_variant_is_valid(copy, choice):
    stage = Usd.Stage.Open(str(anim()))
    stage.GetDefaultPrim().GetVariantSet("deformation").SetVariantSelection(choice)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in found if error.GetType() == UsdValidation.ValidationErrorType.Error] == []


def test_a_new_bake_replaces_the_animation_alone_and_artists_layers_hold(copy, toy):
    artist = Usd.Stage.CreateNew("artist.usda")
    artist.GetRootLayer().subLayerPaths.append("layers/shots/walk/shot.usda")
    colour = UsdGeom.Gprim(artist.OverridePrim("/Shot/skirt/Skirt")).CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0)])
    weights = artist.OverridePrim("/Shot/skirt/Animation").CreateAttribute(
        "blendShapeWeights", Sdf.ValueTypeNames.FloatArray
    )
    weights.Set([0.25] * 5, 3.0)
    artist.Save()
    del colour, weights, artist
    before = {**hashes(copy / "layers"), "artist": sha256("artist.usda")}
    toy.write_clip(copy / "walk.usda", frames=12, fps=60.0)
    assert bake("--motion walk.usda --points -o layers") == 0
    after = {**hashes(copy / "layers"), "artist": sha256("artist.usda")}
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {f"shots/walk/skirt/{name}" for name in SHOT_FILES} | {
        "shots/walk/shot.usda"  # its rate is another
    }
    stage = Usd.Stage.Open("artist.usda")
    assert UsdGeom.Gprim(stage.GetPrimAtPath("/Shot/skirt/Skirt")).GetDisplayColorAttr().Get()[0] == Gf.Vec3f(1, 0, 0)
    shapes = UsdSkel.Animation(stage.GetPrimAtPath("/Shot/skirt/Animation")).GetBlendShapeWeightsAttr()
    assert list(shapes.Get(3.0)) == [0.25] * 5


def test_what_is_current_is_not_touched(copy, capsys):
    before = changes()
    events = said(capsys, "--motion walk.usda run.usda --points -o layers")
    assert [event["detail"].get("current") for event in events if event["event"] == "result"] == [True, True]
    assert changes() == before
    anim().write_bytes(anim().read_bytes()[:-1])  # a file that somebody damaged is baked again
    assert bake("--motion walk.usda run.usda --points -o layers") == 0
    assert (
        hashes(copy / "layers")["shots/walk/skirt/anim.usdc"]
        == json.loads(Path("layers/shots/walk/skirt/bake.json").read_text())["files"]["anim.usdc"]
    )


def test_changed_joints_and_topology_are_warned_of_with_the_shots_that_they_outdate(copy, capsys):
    geometry = Usd.Stage.Open("layers/assets/skirt/geometry.usdc")
    skeleton = UsdSkel.Skeleton(geometry.GetPrimAtPath("/skirt/Skeleton"))
    for attribute in (skeleton.GetJointsAttr(), skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        attribute.Set(list(attribute.Get())[:-1])
    mesh = UsdGeom.Mesh(geometry.GetPrimAtPath("/skirt/Skirt"))
    mesh.GetFaceVertexIndicesAttr().Set(list(mesh.GetFaceVertexIndicesAttr().Get())[::-1])
    geometry.Save()
    outdated = json.loads(Path("layers/shots/run/skirt/bake.json").read_text())
    outdated["files"]["../../../assets/skirt/geometry.usdc"] = "of before"
    Path("layers/shots/run/skirt/bake.json").write_text(json.dumps(outdated))
    del geometry, skeleton, mesh
    texts = [event["text"] for event in said(capsys, "--motion walk.usda --points -o layers") if "text" in event]
    assert any("skeleton had 6 joints and has 7" in text for text in texts), texts
    assert any("topology of /skirt/Skirt changed" in text for text in texts), texts
    assert any("1 shots" in text and "(run)" in text for text in texts), texts


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(copy):
    outputs, found = ("layers", "shot.usdc", "shot.usda", "shot.usdz"), []
    code = "import sys; from ssilk_core.cli import main; written, *words = sys.argv[1:];"
    code += "sys.exit(any(main([*words, '-o', output]) for output in written.split()))"
    for name in ("one", "two"):
        Path(name).mkdir()
        written = " ".join(f"{name}/{output}" for output in outputs)
        words = [sys.executable, "-c", code, written, *shlex.split(BAKE), "--motion", "walk.usda", "--no-verify"]
        environment = {**os.environ, "PYTHONHASHSEED": str(len(name) + ord(name[0]))}
        subprocess.run(words, check=True, capture_output=True, env=environment)
        found.append(hashes(Path(name)))
    assert found[0] == found[1] and {Path(path).parts[0] for path in found[0]} == {*outputs}


@pytest.mark.parametrize("name", [*STAGES, "target-of-the-test"])
def test_targets_get_what_they_take_and_their_error_is_measured(copy, capsys, monkeypatch, name):
    """Each target, and one that somebody adds by one entry."""
    added = Target(influences=3, meters_per_unit=0.01, up_axis="Z", suffixes=(".usda",), about="centimetres, z up")
    monkeypatch.setitem(TARGETS, "target-of-the-test", added)
    target = TARGETS[name]
    output = f"new{target.suffixes[0]}"
    _, *events = said(capsys, f"--motion walk.usda --target {name} -o {output}")
    (result,) = [event for event in events if event["event"] == "result"]
    assert main(["verify", output]) == 0
    stage = Usd.Stage.Open(output)
    assert UsdGeom.GetStageUpAxis(stage) == (target.up_axis or "Y")
    assert UsdGeom.GetStageMetersPerUnit(stage) == (target.meters_per_unit or 1)
    trained = load_model("skirt.safetensors").scene.rig.skin.indices.shape[1]
    most = target.influences or trained
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            weights = UsdSkel.BindingAPI(prim).GetJointWeightsPrimvar()
            assert weights.GetElementSize() <= most
            rows = np.array(weights.Get()).reshape(-1, weights.GetElementSize())
            np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-6)
    reported = result["detail"].get("loses at most [mm]")
    away = np.linalg.norm(garment_points(Path(output)) - garment_points(anim()), axis=-1).max()
    assert (reported is None) == (most >= trained) and abs((reported or 0) / 1000 - away) < 1e-5


def test_four_influences_are_learned_and_not_just_the_heaviest(copy, capsys):
    _, *events = said(capsys, "--motion walk.usda --target game4 -o new.usdc")
    whole = load_rollout(BakeRequest(model="skirt.safetensors", stage="rigged.usda", motion="walk.usda"))
    heaviest = cap_influences(whole.deformer, TARGETS["game4"])
    (pose,) = whole.poses()
    away = deform(heaviest, whole.motion, pose) - deform(whole.deformer, whole.motion, pose)
    assert events[-1]["detail"]["loses at most [mm]"] < 0.2 * 1000 * np.linalg.norm(away, axis=-1).max()


def test_a_model_of_more_influences_than_layers_of_a_target_share_is_refused_before_anything_is_baked(copy, capsys):
    assert bake("--motion walk.usda --target game4 -o new") == 2 and not Path("new").exists()
    assert "joints move a vertex; --target game4 takes 4; reduce them with 'ssilk reduce" in capsys.readouterr().err
    assert main(shlex.split("reduce skirt.safetensors --influences 4 --motions walk.usda -o few.safetensors")) == 0
    words = "bake few.safetensors --stage rigged.usda --motion walk.usda --target game4 -o new"
    assert main(shlex.split(words)) == 0


def test_assets_say_who_they_are_and_of_which_version(copy, capsys):
    model = sha256("skirt.safetensors")
    stage = Usd.Stage.Open(str(anim()))
    info = Usd.ModelAPI(stage.GetDefaultPrim())
    assert (info.GetAssetName(), info.GetAssetVersion()) == ("skirt", model[:12])
    found = Path(info.GetAssetIdentifier().resolvedPath)  # of the asset, through the reference of the shot
    assert found == copy / "layers/assets/skirt/asset.usda"
    named = "--motion walk.usda --asset-version v012 --asset-identifier 'studio:/cloth/{stem}'"
    assert bake(f"{named} -o layers") == 0 and bake(f"{named} -o new.usdc") == 0
    for path, name in ((Path("layers/shots/walk/shot.usda"), "skirt"), (Path("new.usdc"), "Hero")):
        stage = Usd.Stage.Open(str(path))
        prim = stage.GetPrimAtPath("/Shot/skirt") or stage.GetDefaultPrim()
        info = Usd.ModelAPI(prim)
        assert (info.GetAssetName(), info.GetAssetVersion()) == (name, "v012")
        assert info.GetAssetIdentifier().path == "studio:/cloth/skirt"
    capsys.readouterr()
    assert bake("--motion walk.usda --asset-version 'v\x1b[1m' -o odd.usdc") == 2
    assert "1 to 1000 printable characters are allowed" in capsys.readouterr().err


def test_a_version_is_of_the_asset_and_bakes_no_other_shot_again(copy, capsys):
    before = hashes(Path("layers"))
    assert bake("--motion walk.usda --points -o layers --asset-version v012") == 0
    after = hashes(Path("layers"))
    changed = {name for name in after if before.get(name) != after[name]}
    own = {f"shots/walk/skirt/{name}" for name in SHOT_FILES}
    assert {"assets/skirt/info.usda", "assets/skirt/used.json"} == changed - own
    for words in ("", "--asset-version v012"):  # nothing is to be done, and nothing is taken back
        events = said(capsys, f"--motion walk.usda run.usda --points -o layers {words}")
        assert [event["detail"].get("current") for event in events if event["event"] == "result"] == [True, True]
        assert hashes(Path("layers")) == after
    for words in ("bake {} -o layers", "farm {} -o layers --bundle job"):
        command = words.format("skirt.safetensors --stage rigged.usda --motion run.usda --asset-version v013")
        assert main(shlex.split(command)) == 2
        told = "the garment 'skirt' was baked with --asset-version 'v012', not 'v013'; all its shots share one asset"
        assert told in capsys.readouterr().err and hashes(Path("layers")) == after
    request = BakeRequest(model="skirt.safetensors", stage="rigged.usda", motion="run.usda", asset_version="v014")
    with pytest.raises(SsilkError, match="'v012', not 'v014'"):  # as a worker of another job finds it
        LayerFolder("layers").bake(*plan_layers([request], points=True))
    assert bake("--motion run.usda --points -o layers --asset-version v013 --replace") == 0
    stage = Usd.Stage.Open("layers/shots/run/shot.usda")
    assert Usd.ModelAPI(stage.GetPrimAtPath("/Shot/skirt")).GetAssetVersion() == "v013"


def test_a_package_is_what_arkit_takes(copy, capsys):
    capsys.readouterr()
    assert bake("--motion walk.usda --target arkit -o new.usdc") == 2
    assert "arkit takes .usdz" in capsys.readouterr().err
    assert bake("--motion walk.usda --target arkit -o new") == 2 and not Path("new").exists()
    assert "it takes .usdz" in capsys.readouterr().err


def test_several_characters_wear_several_garments_in_one_stage(copy, toy):
    stage = Usd.Stage.CreateNew("crowd.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    for name, away in (("Anna", 0.0), ("Bert", 3.0)):
        prim = UsdSkel.Root.Define(stage, f"/World/{name}").GetPrim()
        prim.GetReferences().AddReference("rigged.usda", "/Hero")
        UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(away, 0, 0))
        clip = stage.DefinePrim(f"/World/{name}/Clip")
        clip.GetReferences().AddReference("walk.usda", "/Clip", Sdf.LayerOffset(0, 1 if name == "Anna" else 0.5))
        UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets([clip.GetPath()])
    stage.SetTimeCodesPerSecond(30.0)
    stage.Save()
    del stage, prim, clip
    shutil.copy("skirt.safetensors", "second.safetensors")
    models = "skirt.safetensors:/World/Anna second.safetensors:/World/Anna skirt.safetensors:/World/Bert"
    words = f"bake {models} --stage crowd.usda --motion crowd.usda -o dressed"
    assert main(shlex.split(words)) == 0
    shot = Shot("dressed/shots/crowd/shot.usda")
    garments = {mesh.path: points for mesh, points in zip(shot.meshes, shot.points(4.0)) if mesh.is_garment}
    assert set(garments) == {f"/Shot/{name}/Skirt" for name in ("Anna_skirt", "Anna_second", "Bert_skirt")}
    bodies = [mesh.path for mesh in shot.meshes if not mesh.is_garment]
    assert bodies == ["/Shot/Anna_second/Body", "/Shot/Bert_skirt/Body"]  # each character has one
    np.testing.assert_array_equal(garments["/Shot/Anna_skirt/Skirt"], garments["/Shot/Anna_second/Skirt"])
    assert 2 < (garments["/Shot/Bert_skirt/Skirt"] - garments["/Shot/Anna_skirt/Skirt"]).mean(axis=0)[0] < 4
    for garment in ("Anna_skirt", "Bert_skirt"):
        assert main(["verify", f"dressed/shots/crowd/{garment}/anim.usdc"]) == 0
    bert = Sdf.Layer.FindOrOpen("dressed/shots/crowd/Bert_skirt/anim.usdc")
    assert bert.endTimeCode == pytest.approx(5.0)  # his clip plays twice as fast


def test_names_that_would_collide_are_refused(copy, capsys):
    Path("more").mkdir()
    shutil.copy("walk.usda", "more/walk.usda")
    capsys.readouterr()
    assert bake("--motion walk.usda more/walk.usda -o other") == 2
    assert "would both be the shot 'walk'" in capsys.readouterr().err and not Path("other").exists()


def test_hidden_spans_are_kept(copy):
    stage = Usd.Stage.CreateNew("acted.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    prim = UsdSkel.Root.Define(stage, "/Hero").GetPrim()
    prim.GetReferences().AddReference("rigged.usda", "/Hero")
    stage.DefinePrim("/Hero/Clip").GetReferences().AddReference("walk.usda", "/Clip")
    UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets(["/Hero/Clip"])
    visibility = UsdGeom.Imageable(prim).CreateVisibilityAttr()
    for time, token in ((0, "inherited"), (4, "invisible"), (8, "inherited")):
        visibility.Set(token, time)
    stage.SetTimeCodesPerSecond(30.0)
    stage.Save()
    del stage, prim, visibility
    assert bake("--motion acted.usda -o hidden") == 0
    stage = Usd.Stage.Open("hidden/shots/acted/skirt/anim.usdc")
    root = UsdGeom.Imageable(stage.GetDefaultPrim())
    seen = [root.ComputeVisibility(float(frame)) != "invisible" for frame in range(12)]
    assert seen == [frame < 4 or frame >= 8 for frame in range(12)]


def test_samples_between_frames_are_the_motion_there(copy):
    assert bake("--motion walk.usda --samples-per-frame 4 -o blurred") == 0
    layer = Sdf.Layer.FindOrOpen("blurred/shots/walk/skirt/anim.usdc")
    times = layer.ListTimeSamplesForPath("/skirt/Animation.rotations")
    np.testing.assert_allclose(times, np.arange(45) / 4)
    assert (layer.timeCodesPerSecond, layer.endTimeCode) == (30.0, 11.0)
    assert main(["verify", "blurred/shots/walk/skirt/anim.usdc"]) == 0
    np.testing.assert_allclose(
        garment_points(Path("blurred/shots/walk/skirt/anim.usdc")), garment_points(anim()), atol=1e-4
    )


def test_a_retimed_motion_is_baked_as_it_plays(copy):
    """A speed ramp ahead of the bake: the cloth feels the speed that is seen."""
    stage = Usd.Stage.CreateNew("slow.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(30.0)
    stage.DefinePrim("/Clip").GetReferences().AddReference("walk.usda", "/Clip", Sdf.LayerOffset(5, 2))
    stage.Save()
    del stage
    assert bake("--motion slow.usda -o retimed") == 0
    layer = Sdf.Layer.FindOrOpen("retimed/shots/slow/skirt/anim.usdc")
    assert (layer.startTimeCode, layer.endTimeCode) == (5.0, 27.0)
    slow = garment_points(Path("retimed/shots/slow/skirt/anim.usdc"), [5.0 + 2 * frame for frame in range(12)])
    assert 1e-5 < np.abs(slow - garment_points(anim())).max() < 0.2


def test_value_clips_are_read_as_they_play_and_count_as_inputs(copy, toy, capsys):
    stage = Usd.Stage.CreateNew("edit.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(30.0)
    prim = UsdSkel.Animation.Define(stage, "/Clip").GetPrim()
    UsdSkel.Animation(prim).CreateJointsAttr(["Hips", "Hips/Spine", "Hips/Spine/Head"])
    clips = Usd.ClipsAPI(prim)
    clips.SetClipAssetPaths([Sdf.AssetPath("./run.usda"), Sdf.AssetPath("./walk.usda")])
    clips.SetClipPrimPath("/Clip")
    clips.SetClipActive([(0, 0), (5, 1)])
    clips.SetClipTimes([(0, 0), (5, 5), (16, 11)])  # the second at half its speed
    clips.SetClipManifestAssetPath("./walk.usda")
    stage.Save()
    del stage, prim, clips
    assert bake("--motion edit.usda -o edited") == 0
    layer = Sdf.Layer.FindOrOpen("edited/shots/edit/skirt/anim.usdc")
    assert layer.endTimeCode >= 16
    toy.write_clip(copy / "run.usda", frames=7, fps=25.0)
    events = said(capsys, "--motion edit.usda -o edited")
    assert [event["detail"].get("current") for event in events if event["event"] == "result"] == [None]


@pytest.mark.parametrize("instanced", [False, True])
def test_a_finished_shot_can_be_referenced_offset_and_instanced(copy, instanced):
    """A speed change behind the bake: the samples are spread in time, nothing is baked again."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(30.0)
    prim = stage.DefinePrim("/Sequence/Hero")
    prim.GetReferences().AddReference(str(anim().absolute()), Sdf.LayerOffset(100, 2))
    prim.SetInstanceable(instanced)
    stage.SetStartTimeCode(100)
    stage.SetEndTimeCode(122)
    played = garment_points(stage, [100.0 + 2 * frame for frame in range(12)])
    np.testing.assert_array_equal(played, garment_points(anim()))


def test_a_garment_says_how_it_was_made_with_and_without_the_schema(copy):
    stage = Usd.Stage.Open(str(anim()))
    mesh = stage.GetPrimAtPath("/skirt/Skirt")
    record = read_garment_record(mesh)
    assert mesh.HasAPI(SCHEMA) and record.model_hash == sha256("skirt.safetensors")
    assert record.fabric == "default" and record.parameters["density"] == pytest.approx(0.15)
    code = (
        "import sys; from pxr import Usd; stage = Usd.Stage.Open(sys.argv[1]);"
        "prim = stage.GetPrimAtPath('/skirt/Skirt');"
        "assert not Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('SsilkGarmentAPI');"
        "print(prim.GetMetadata('apiSchemas'), prim.GetAttribute('ssilk:modelHash').Get(),"
        "len(prim.GetAttribute('primvars:ssilk:class').Get()))"
    )
    alone = subprocess.run([sys.executable, "-c", code, str(anim())], capture_output=True, text=True, check=True)
    assert record.model_hash in alone.stdout and SCHEMA in alone.stdout and not alone.stderr
    plugin = Path(sys.modules["ssilk_usd.opening.garment_api"].__file__).parents[1] / "schema"
    known = code.replace("assert not", "assert")
    environment = {**os.environ, "PXR_PLUGINPATH_NAME": str(plugin)}
    subprocess.run([sys.executable, "-c", known, str(anim())], check=True, capture_output=True, env=environment)


def test_the_manifest_is_of_the_inputs_contents_not_of_their_places(copy):
    record = json.loads(Path("layers/shots/walk/skirt/bake.json").read_text())
    Path("elsewhere").mkdir()
    for name in ("skirt.safetensors", "rigged.usda", "walk.usda", "hero.usda"):
        shutil.copy(name, f"elsewhere/{name}")
    words = "bake elsewhere/skirt.safetensors --stage elsewhere/rigged.usda --motion elsewhere/walk.usda --points"
    assert main(shlex.split(f"{words} -o layers")) == 0
    assert json.loads(Path("layers/shots/walk/skirt/bake.json").read_text()) == record
    assert hashlib.sha256(anim().read_bytes()).hexdigest() == record["files"]["anim.usdc"]


def test_each_frame_of_a_short_shot_takes_bytes(copy):
    """Of 12 frames no two excerpts of 16 and 64 can be told apart."""
    rollout = load_rollout(BakeRequest(model="skirt.safetensors", stage="rigged.usda", motion="walk.usda"))
    taken = shot_bytes(rollout, ".usdc", include_body=False)
    assert taken.frame > 4 * 20 and taken.asset > 1000


@pytest.mark.usefixtures("copy")
def test_a_version_whose_asset_was_not_written_is_asked_for_again(monkeypatch):
    from ssilk_usd.shots import layers_asset

    def full(*words, **named):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(layers_asset, "write_asset", full)
        assert bake("--motion walk.usda --points -o layers --asset-version v015") != 0
    assert bake("--motion walk.usda --points -o layers --asset-version v015") == 0
    stage = Usd.Stage.Open("layers/shots/walk/shot.usda")
    assert Usd.ModelAPI(stage.GetPrimAtPath("/Shot/skirt")).GetAssetVersion() == "v015"
