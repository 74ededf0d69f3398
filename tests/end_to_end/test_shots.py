# SPDX-License-Identifier: Apache-2.0
"""What becomes of a shot that several commands bake for, and of names that several inputs would have."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from ssilk_usd.shots import layers_stage
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, LayerFolder, plan_layers
from ssilk_core.delivery.bake import shots as gathering
from ssilk_core.delivery.bake.record import portable
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, save_model


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """The toy world with a model of two names, and one baked over a clip of 6 frames into `layers`."""
    folder = tmp_path_factory.mktemp("shots")
    toy.copy(folder)
    shutil.move(folder / "model.safetensors", folder / "overalls.safetensors")
    shutil.copy(folder / "overalls.safetensors", folder / "shirt.safetensors")
    for name in ("walk", "run"):
        toy.write_clip(folder / f"{name}.usda", frames=6)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert bake("overalls.safetensors", "--motion walk.usda -o layers") == 0
    return folder


def bake(models: str, words: str) -> int:
    return main(shlex.split(f"bake {models} --stage rigged.usda --no-verify {words}"))


def garments(shot: str = "walk") -> list[str]:
    stage = Usd.Stage.Open(f"layers/shots/{shot}/shot.usda")
    return [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()]


def test_a_second_bake_joins_the_first_and_the_character_keeps_one_body(copy):
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
    shot = Shot("layers/shots/walk/shot.usda")
    assert [mesh.path for mesh in shot.meshes if mesh.is_garment] == ["/Shot/overalls/Skirt", "/Shot/shirt/Skirt"]
    assert [mesh.path for mesh in shot.meshes if not mesh.is_garment] == ["/Shot/overalls/Body"]
    together = Path("layers/shots/walk/shot.usda").read_bytes()
    shutil.rmtree("layers")
    for model in ("shirt", "overalls"):
        assert bake(f"{model}.safetensors", "--motion walk.usda -o layers") == 0
    assert Path("layers/shots/walk/shot.usda").read_bytes() == together  # in any order


def test_levels_of_quality_are_variants_of_one_garment(copy, capsys):
    words = "--motion walk.usda --level-of overalls -o layers"
    assert bake("shirt.safetensors", f"--lbs --garment-name overalls_crowd {words}") == 0
    assert bake("overalls.safetensors", f"--refine 1 --garment-name hero {words}") == 0
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().subLayerPaths.append(str(copy / "layers/shots/walk/shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(30.0)
    prim = stage.GetPrimAtPath("/Shot/overalls")
    assert garments() == ["overalls"] and stage.GetPrimAtPath("/Shot/overalls/Skirt")
    levels = prim.GetVariantSet("level")
    assert sorted(levels.GetVariantNames()) == ["crowd", "default", "hero"]
    assert levels.GetVariantSelection() == "default"
    for level, garment in (("default", "overalls"), ("crowd", "overalls_crowd"), ("hero", "hero")):
        assert levels.SetVariantSelection(level)
        shown, own = Shot(stage), Shot(f"layers/shots/walk/{garment}/anim.usdc")
        assert [mesh.name for mesh in shown.meshes] == ["Skirt", "Body"]
        for time in own.frame_times:
            np.testing.assert_allclose(shown.garment_points(time), own.garment_points(time), atol=1e-7)
    del stage, prim, levels, shown
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0  # whose body is hidden in no level
    assert [mesh.path for mesh in Shot("layers/shots/walk/shot.usda").meshes] == [
        "/Shot/overalls/Skirt", "/Shot/overalls/Body", "/Shot/shirt/Skirt",
    ]  # fmt: skip
    for name in ("hero", "overalls_crowd", "shirt"):
        assert main(["remove", "layers", f"walk/{name}"]) == 0
    alone = Usd.Stage.Open("layers/shots/walk/shot.usda")
    assert not alone.GetPrimAtPath("/Shot/overalls").GetVariantSets().HasVariantSet("level")
    capsys.readouterr()
    assert bake("overalls.safetensors", words) == 2
    assert "a level of 'overalls', and of the same name" in capsys.readouterr().err
    assert bake("overalls.safetensors", "--motion walk.usda --level-of shirt -o new.usdc") == 2
    assert "levels are variants of a shot in a folder of layers" in capsys.readouterr().err


def test_levels_are_of_a_garment_that_is_there_and_no_level(copy, capsys):
    shirt = "--motion walk.usda --lbs -o layers --garment-name"
    assert bake("shirt.safetensors", f"{shirt} hero --level-of overalls") == 0
    for words, says in (
        ("crowd --level-of cape", "--level-of cape: no garment 'cape' is baked in this shot"),
        ("crowd --level-of hero", "--level-of hero: 'hero' is a level of 'overalls' itself; .*; name 'overalls'"),
        ("overalls_hero --level-of overalls", "'overalls_hero' and 'hero' would both be its level 'hero'"),
    ):
        assert bake("shirt.safetensors", f"{shirt} {words}") == 2
        assert re.search(says, capsys.readouterr().err)
    assert bake("overalls.safetensors", "--motion walk.usda -o layers --garment-name overalls --level-of hat") == 2
    assert "no garment 'hat'" in capsys.readouterr().err
    assert not Path("layers/assets/crowd").exists() and garments() == ["overalls"]
    request = BakeRequest(model="overalls.safetensors", stage="rigged.usda", motion="walk.usda")
    late, base = replace(request, garment="crowd", level_of="overalls"), replace(request, garment="hat")
    LayerFolder("new").need_names(plan_layers([late, request]))  # a command may bake both
    LayerFolder("new").need_names(plan_layers([late]), complete=False)  # and a farm the other one with another job
    with pytest.raises(SsilkError, match=r"'overalls' has a level itself, 'hero'; .*; name this garment with"):
        LayerFolder("layers").need_names(plan_layers([base, replace(request, level_of="hat")]))
    capsys.readouterr()
    assert main(shlex.split("remove layers walk/overalls")) == 0
    assert "'hero' is a level of 'overalls', which is not in this shot" in capsys.readouterr().err


def test_a_body_is_shown_whichever_levels_are_selected(copy, capsys):
    words = "--motion walk.usda --lbs -o layers"
    assert bake("shirt.safetensors", f"{words} --no-body --garment-name overalls_crowd --level-of overalls") == 0
    assert "the level 'overalls_crowd' of 'overalls' has no body, as others have" in capsys.readouterr().err
    assert bake("shirt.safetensors", words) == 0
    assert "has no body" not in capsys.readouterr().err
    stage = Usd.Stage.Open("layers/shots/walk/shot.usda")
    for level in ("default", "crowd"):
        assert stage.GetPrimAtPath("/Shot/overalls").GetVariantSet("level").SetVariantSelection(level)
        assert [mesh.path for mesh in Shot(stage).meshes if not mesh.is_garment] == ["/Shot/shirt/Body"]


def test_what_another_process_finishes_while_a_stage_is_written_is_not_lost(copy, monkeypatch):
    """The other one finishes, stage and all, between our look at the folder and the rename of our stage."""
    write, other = layers_stage.write_stage, []

    def late(garments, *rest):
        if not other:
            other.append(garments)
            assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
        return write(garments, *rest)

    monkeypatch.setattr(layers_stage, "write_stage", late)
    gathering.write_shot_stage(Path("layers"), "walk")
    assert len(other) == 1 and garments() == ["overalls", "shirt"]


def test_garments_are_taken_out(copy, capsys):
    assert bake("shirt.safetensors overalls.safetensors", "--motion walk.usda run.usda -o layers") == 0
    assert main(shlex.split("remove layers walk/overalls")) == 0
    assert garments("walk") == ["shirt"] and garments("run") == ["overalls", "shirt"]
    paths = [mesh.path for mesh in Shot("layers/shots/walk/shot.usda").meshes]
    assert paths == ["/Shot/shirt/Skirt", "/Shot/shirt/Body"]  # the body does not go with the overalls
    assert not Path("layers/shots/walk/overalls").exists() and Path("layers/assets/overalls/asset.usda").is_file()
    assert main(shlex.split("remove layers walk/overalls")) == 2
    assert "no garment is baked as 'walk/overalls'; there are run/overalls" in capsys.readouterr().err
    assert main(shlex.split("remove layers '*/shirt' run/overalls")) == 0
    assert not list(Path("layers/shots").iterdir())


def test_a_name_is_free_once_its_garment_is_in_no_shot(copy, capsys):
    assert bake("overalls.safetensors", "--motion run.usda -o layers") == 0
    other = "--motion run.usda --garment-name overalls -o layers"
    save_model("shirt.safetensors", replace(load_model("shirt.safetensors"), provenance={}))
    assert main(shlex.split("remove layers walk/overalls")) == 0
    assert bake("shirt.safetensors", other) == 2 and "was baked from" in capsys.readouterr().err
    assert main(shlex.split("remove layers run/overalls")) == 0
    assert bake("shirt.safetensors", other) == 0


def test_a_garment_that_cannot_be_read_is_left_out_and_told(copy, capsys):
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
    Path("layers/shots/walk/overalls/anim.usdc").write_bytes(b"half")
    capsys.readouterr()
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
    assert garments() == ["shirt"] and "walk/overalls/anim.usdc" in capsys.readouterr().err


RECORD_OF_OVERALLS = Path("layers/shots/walk/overalls/bake.json")


def test_a_garment_with_a_damaged_record_stays_in_its_shot(copy, capsys):
    RECORD_OF_OVERALLS.write_text("{")
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
    assert "bake.json: it is damaged; the garment stays" in capsys.readouterr().err
    paths = [mesh.path for mesh in Shot("layers/shots/walk/shot.usda").meshes]
    assert paths == ["/Shot/overalls/Skirt", "/Shot/overalls/Body", "/Shot/shirt/Skirt"]  # one body


def test_a_stage_is_not_written_without_what_was_just_baked(copy):
    request = BakeRequest(model="overalls.safetensors", stage="rigged.usda", motion="walk.usda")
    before = Path("layers/shots/walk/shot.usda").read_bytes()
    Path("layers/shots/walk/overalls/anim.usdc").write_bytes(b"half")
    with pytest.raises(SsilkError, match=r"overalls/anim\.usdc"):
        LayerFolder("layers").write_stages(plan_layers([request]))
    assert Path("layers/shots/walk/shot.usda").read_bytes() == before


def test_a_record_does_not_say_where_a_studio_keeps_what_lies_apart():
    near, far = Path("/show/a/layers"), "/studio/s010/anim.usd:/Clip"
    assert portable("/show/s010/anim.usd:/Clip", near) == "../../s010/anim.usd:/Clip"
    assert re.fullmatch(r"[0-9a-f]{8}/anim\.usd:/Clip", portable(far, near))
    assert portable(far, near) != portable(far.replace("s010", "s020"), near)


def test_a_shot_of_several_rates_spans_them_all(copy, toy):
    toy.write_clip(copy / "walk.usda", frames=21, fps=60.0)
    assert bake("shirt.safetensors", "--motion walk.usda -o layers") == 0
    stage = Usd.Stage.Open("layers/shots/walk/shot.usda")
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (30.0, 10.0)
    samples = stage.GetPrimAtPath("/Shot/shirt/Animation").GetAttribute("rotations").GetTimeSamples()
    assert samples[-1] == pytest.approx(10.0)


def test_garments_of_several_units_are_refused(copy, capsys):
    before = Path("layers/shots/walk/shot.usda").read_bytes()
    assert bake("shirt.safetensors", "--motion walk.usda -o layers --target blender") == 2
    assert "'overalls' is in units of 1 m with Y up, 'shirt' in units of 1 m with Z up" in capsys.readouterr().err
    assert Path("layers/shots/walk/shot.usda").read_bytes() == before


def test_a_shot_that_cannot_be_written_stops_no_other_and_hides_no_error(copy, capsys):
    assert bake("shirt.safetensors", "--motion walk.usda run.usda -o layers --target blender") == 2
    assert "'overalls' is in units of 1 m with Y up" in capsys.readouterr().err
    assert garments("run") == ["shirt"]
    shutil.rmtree("layers/shots/run")
    Path("run.usda").write_text("#usda 1.0")
    assert bake("shirt.safetensors", "--motion walk.usda run.usda -o layers --target blender") == 2
    said = capsys.readouterr().err.splitlines()
    assert "run.usda" in said[-1] and [line for line in said[:-1] if "with Y up" in line]


def test_a_check_tells_a_shot_that_cannot_be_written_after_all_others_are(copy, capsys):
    assert main(shlex.split("farm shirt.safetensors --stage rigged.usda --no-verify --target blender "
                            "--motion walk.usda run.usda --bundle job")) == 0  # fmt: skip
    assert main(shlex.split("task job/job.json -o layers --tasks 0-1")) == 0
    assert main(shlex.split("task job/job.json -o layers --check")) == 3
    assert "with Y up" in capsys.readouterr().err and garments("run") == ["shirt"]


def test_a_record_names_inputs_without_saying_where_the_studio_keeps_them(copy):
    text = Path("layers/shots/walk/overalls/bake.json").read_text()
    inputs = json.loads(text)["detail"]["inputs"]
    assert {name: each["path"] for name, each in inputs.items()} == {
        "model": "../overalls.safetensors", "stage": "../rigged.usda", "motion": "../walk.usda",
    }  # fmt: skip
    assert str(copy) not in text


def two_sequences(toy) -> None:
    """Two shots whose files have one name."""
    for name, frames in (("s010", 5), ("s020", 4)):
        Path(name).mkdir()
        toy.write_clip(Path(name, "anim.usda"), frames=frames)


def test_shots_whose_files_have_one_name_are_refused_in_one_command_and_in_two(copy, toy, capsys):
    two_sequences(toy)
    assert bake("shirt.safetensors", "--motion s010/anim.usda s020/anim.usda -o new") == 2
    said = capsys.readouterr().err
    assert "'s010/anim.usda' and 's020/anim.usda' would both be the shot 'anim'" in said and "--shot-name" in said
    assert bake("shirt.safetensors", "--motion s010/anim.usda -o new") == 0
    before = Path("new/shots/anim/shirt/anim.usdc").read_bytes()
    for model in ("shirt", "overalls"):  # beside what is there, too, it would be another shot's
        assert bake(f"{model}.safetensors", "--motion s020/anim.usda -o new") == 2
        said = capsys.readouterr().err
        assert "the shot 'anim' was baked from '../s010/anim.usda', not from 's020/anim.usda'" in said
        assert "--replace" in said and Path("new/shots/anim/shirt/anim.usdc").read_bytes() == before
    toy.write_clip(Path("s010/anim.usda"), frames=6)  # the same input, changed
    assert bake("shirt.safetensors", "--motion s010/anim.usda -o new") == 0
    assert Path("new/shots/anim/shirt/anim.usdc").read_bytes() != before
    assert bake("shirt.safetensors", "--motion s020/anim.usda -o new --replace") == 0
    assert Usd.Stage.Open("new/shots/anim/shot.usda").GetEndTimeCode() == 3


@pytest.mark.parametrize("words", [
    "--motion s010/anim.usda s020/anim.usda --shot-name '{parent}_{stem}'", "--shots lists/shots.json",
])  # fmt: skip
def test_shots_are_named_by_a_pattern_or_in_a_list(copy, toy, words):
    two_sequences(toy)
    Path("lists").mkdir()
    named = {f"{name}_anim": f"../{name}/anim.usda" for name in ("s010", "s020")}
    Path("lists/shots.json").write_text(json.dumps(named))
    assert bake("shirt.safetensors", f"{words} --garment-name worn -o new") == 0
    assert {path.parent.name for path in Path("new/shots").glob("*/shot.usda")} == {"s010_anim", "s020_anim"}
    assert Usd.Stage.Open("new/shots/s020_anim/worn/anim.usdc").GetDefaultPrim().GetName() == "worn"


def test_another_model_of_one_name_is_refused(copy, capsys):
    Path("other").mkdir()
    reduced = "reduce overalls.safetensors --shapes 2 --motions walk.usda -o other/overalls.safetensors"
    assert main(shlex.split(reduced)) == 0
    assert bake("overalls.safetensors other/overalls.safetensors", "--motion run.usda -o layers") == 2
    assert "would both be the garment 'overalls'" in capsys.readouterr().err
    assert bake("other/overalls.safetensors", "--motion run.usda -o layers") == 2  # its asset is that of all shots
    said = capsys.readouterr().err
    assert "the garment 'overalls' was baked from '../overalls.safetensors', not from 'other/overalls" in said
    assert bake("other/overalls.safetensors", "--motion walk.usda -o layers --garment-name '{parent}'") == 0
    assert garments() == ["other", "overalls"]
    shutil.copy("overalls.safetensors", "other/overalls.safetensors")
    assert bake("other/overalls.safetensors", "--motion run.usda -o layers") == 0  # it has only moved


def test_garments_that_a_replaced_motion_leaves_behind_are_named(copy, toy, capsys):
    two_sequences(toy)
    assert bake("shirt.safetensors", "--motion s010/anim.usda --shot-name walk -o layers --replace") == 0
    assert "overalls follow another motion than shirt" in capsys.readouterr().err
    assert bake("overalls.safetensors", "--motion s010/anim.usda --shot-name walk -o layers --replace") == 0
    assert "another motion" not in capsys.readouterr().err


@pytest.mark.parametrize(("words", "kind"), [
    ("--motion walk.usda --shot-name WALK", "shot 'walk'"),
    ("--motion run.usda --garment-name Overalls", "garment 'overalls'"),
])  # fmt: skip
def test_names_that_differ_from_those_on_disk_by_case_alone_are_refused(copy, capsys, words, kind):
    assert bake("overalls.safetensors", f"{words} -o layers --replace") == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"there is a {kind}, one with" in said and len(list(Path("layers/shots").iterdir())) == 1


def test_a_name_whose_records_do_not_tell_its_input_is_not_replaced_unasked(copy, capsys):
    """Neither a layer whose own record is damaged, nor the asset that other shots share."""
    RECORD_OF_OVERALLS.write_text("{")
    for motion, place, text in (("walk", "shots/walk/overalls/bake.json", None),
                                ("run", "assets/overalls/used.json", "{"),
                                ("run", "assets/overalls/used.json", '{"root": null}')):  # fmt: skip
        if text:
            Path("layers", place).write_text(text)
        assert bake("overalls.safetensors", f"--motion {motion}.usda --points -o layers") == 2
        (said,) = capsys.readouterr().err.splitlines()
        assert f"layers/{place}: it does not tell what" in said and "--replace" in said
    assert bake("overalls.safetensors", "--motion walk.usda --points -o layers --replace") == 0
    assert bake("overalls.safetensors", "--motion run.usda -o layers") == 0


def test_a_task_does_not_look_for_its_garment_in_all_shots(copy, monkeypatch):
    searched, glob = [], Path.glob

    def noted(path, pattern):
        searched.append(pattern)
        return glob(path, pattern)

    monkeypatch.setattr(Path, "glob", noted)
    for model in ("overalls", "shirt"):
        request = BakeRequest(model=f"{model}.safetensors", stage="rigged.usda", motion="run.usda")
        LayerFolder("layers").bake(*plan_layers([request], verify=False))
    assert searched and not [pattern for pattern in searched if pattern.startswith("shots/*")]
    shutil.rmtree("layers/shots/run/overalls")
    Path("other.safetensors").write_bytes(b"other")
    other = replace(request, model="other.safetensors", garment="overalls")
    with pytest.raises(SsilkError, match=r"was baked from '\.\./overalls\.safetensors'"):
        LayerFolder("layers").need_names(plan_layers([other]))


@pytest.mark.parametrize(("text", "says"), [
    ("[]", "it names no shots"), ("{", "it cannot be read"), ('{"a": 3}', "in the shot 'a', '3' has no fields"),
    ('{"a": "walk.usda", "a": "run.usda"}', "'a' is there twice"),
    ('{"a.b": "walk.usda", "a b": "run.usda"}', "would both be the shot 'a_b'"),
])  # fmt: skip
def test_a_list_of_shots_that_names_none_is_refused(copy, capsys, text, says):
    Path("shots.json").write_text(text)
    assert bake("shirt.safetensors", "--shots shots.json -o new") == 2
    assert says in capsys.readouterr().err and not Path("new").exists()
