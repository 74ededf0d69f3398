# SPDX-License-Identifier: Apache-2.0
"""Families of bodies as users meet them: compared, dressed before any training, trained for and baked."""

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.character import read_character

from ssilk_core.cli import main
from ssilk_core.cli.main import parser as command_line
from ssilk_core.delivery.bake import BakeRequest, load_garment, load_rollout, worn
from ssilk_core.delivery.bake.load import with_model
from ssilk_core.errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_WORSE
from ssilk_core.events import silent
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.physics.intersections.layers import ClothLayers
from ssilk_core.scene.kinematics import bind_pose, invert_rigid
from ssilk_core.training.wardrobe.listing import read_list

from .test_riders import add_rider, disc_on
from .test_shaped_bodies import add_shape
from .test_skeletons import JOINTS as OTHER_JOINTS
from .test_skeletons import put_on, stretch_in, write_clip, write_other

TRAIN = "train rigged.usda --motions clip.usda"


def run(command: str, *more: str) -> int:
    return main([*shlex.split(command), *more])


def write_member(path: Path, change: Callable[[np.ndarray], np.ndarray], source: str = "hero.usda") -> Path:
    """The hero with other proportions: points and joints (N, 3) moved by a function, without the skirt."""
    stage = Usd.Stage.Open(Usd.Stage.Open(source).Flatten())
    stage.RemovePrim("/Hero/Skirt")
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr()
    points.Set(Vt.Vec3fArray.FromNumpy(change(np.array(points.Get(), dtype=float)).astype(np.float32)))
    binds = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")).GetBindTransformsAttr()
    places = change(np.array([np.array(matrix)[3, :3] for matrix in binds.Get()]))
    binds.Set([Gf.Matrix4d().SetTranslate(Gf.Vec3d(*place)) for place in places.tolist()])
    stage.GetRootLayer().Export(str(path))
    return path


def taller(points: np.ndarray) -> np.ndarray:
    return points * [1, 1.15, 1]


def heavier(points: np.ndarray) -> np.ndarray:
    return points * [1.3, 1, 1.3]


@pytest.fixture(scope="module")
def family(toy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy with taller.usda and heavier.usda, and family.safetensors, trained for all three bodies."""
    folder = toy.copy(tmp_path_factory.mktemp("family"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        toy.write_clip(folder / "clip.usda", frames=24)
        write_member(folder / "taller.usda", taller)
        write_member(folder / "heavier.usda", heavier)
        train = f"{TRAIN} --family taller.usda heavier.usda -o family.safetensors"
        assert run(train, *toy.training) in (EXIT_OK, EXIT_WORSE)
    return folder


@pytest.fixture
def world(family: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, the current folder."""
    shutil.copytree(family, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def findings(capsys, command: str) -> tuple[int, dict[str, dict]]:
    capsys.readouterr()
    code = run(command, "--json")
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    return code, {finding["code"]: finding for finding in result["detail"]["findings"]}


def test_inspect_says_that_bodies_are_a_family_and_by_how_much_they_differ(world, capsys):
    code, found = findings(capsys, "inspect hero.usda --garment Skirt --family taller.usda heavier.usda")
    assert code == 0 and found["family"]["count"] == 3
    assert "points up to 25.5 cm from the first one's, along 2 directions" in found["family"]["found"]


def test_inspect_names_what_keeps_a_body_out_of_the_family(world, capsys):
    stage = Usd.Stage.Open("taller.usda")
    rig = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    rig.GetJointsAttr().Set(["Hips", "Hips/Spine", "Hips/Spine/Skull"])
    stage.Save()
    code, found = findings(capsys, "inspect hero.usda --garment Skirt --family taller.usda")
    assert code == 2 and "Hips/Spine/Head" in found["no-family"]["found"]
    assert run("rig hero.usda --garment Skirt --onto taller.usda -o out.usda") == 2
    told = capsys.readouterr().err
    assert "taller.usda" in told and "Hips/Spine/Skull" in told and not Path("out.usda").exists()


def test_what_a_member_has_not_to_leave_out_is_told(world, capsys):
    layer = Sdf.Layer.FindOrOpen("hero.usda")
    assert Sdf.CopySpec(layer, "/Hero/Body", layer, "/Hero/Hood") and layer.Save()
    assert run("inspect hero.usda --garment Skirt --family taller.usda --body ^Hood") == 0
    said = "taller.usda:/Hero: there is no Hood to leave out with --body; what counts as its body is Body"
    told = capsys.readouterr()
    assert said in told.out + told.err


def test_a_file_of_the_family_that_is_not_there_is_told(world, capsys):
    assert run("inspect hero.usda --garment Skirt --family tallest.usda") == 2
    assert "there is no such file" in capsys.readouterr().err


def skinned_rest(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Points of the skirt and of the body as UsdSkel skins them in the rest pose (V, 3)."""
    stage, cache = Usd.Stage.Open(path), UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetPrimAtPath("/Hero"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    joints = cache.GetSkelQuery(binding.GetSkeleton()).ComputeSkinningTransforms(Usd.TimeCode.Default())
    found = {}
    for query in binding.GetSkinningTargets():
        points = UsdGeom.Mesh(query.GetPrim()).GetPointsAttr().Get()
        assert query.ComputeSkinnedPoints(joints, points, Usd.TimeCode.Default())
        found[query.GetPrim().GetName()] = np.array(points)
    return found["Skirt"], found["Body"]


def test_a_garment_is_tried_on_another_body_before_any_training(world):
    assert run("rig hero.usda --garment Skirt --proxies 4 -o hero_skirt.usda") == 0
    assert run("rig hero.usda --garment Skirt --proxies 4 --onto heavier.usda -o heavier_skirt.usda") == 0
    assert run("rig hero_skirt.usda --onto heavier.usda -o again.usda") == 0
    own, its = skinned_rest("hero_skirt.usda")[0], skinned_rest("heavier_skirt.usda")
    np.testing.assert_allclose(its[1], heavier(skinned_rest("hero_skirt.usda")[1]), atol=1e-5)
    around = np.linalg.norm(its[0][:, [0, 2]], axis=1) / np.linalg.norm(own[:, [0, 2]], axis=1)
    high = own[:, 1] > 1.05
    assert (around[high] > 1.15).all()  # where the pillar grew by 1.3 it would be within the skin otherwise
    np.testing.assert_allclose(skinned_rest("again.usda")[0], its[0], atol=1e-5)


def test_a_family_is_learned_and_the_model_file_holds_it(world):
    family, alone = load_model("family.safetensors"), load_model("model.safetensors")
    assert alone.bodies is None and len(family.bodies.family.bodies.names) == 3
    assert all(np.abs(family.bodies.columns[name]).max() > 0 for name in ("initialiser.0", "output.0"))
    assert Path("family.safetensors").stat().st_size < 1.3 * Path("model.safetensors").stat().st_size


@pytest.mark.slow
def test_a_garment_is_graded_where_it_is_asked_for(world, toy, capsys):
    names = ("taller.usda", "heavier.usda")
    train = f"{TRAIN} --family {' '.join(names)} --graded -o graded.safetensors"
    assert run(train, *toy.training) in (EXIT_OK, EXIT_WORSE)
    told = capsys.readouterr()
    assert "along 2 directions, and graded to each" in told.out + told.err
    file, same = load_model("graded.safetensors"), load_model("family.safetensors")
    assert file.scene.garment.graded and not same.scene.garment.graded
    assert set(names) <= file.provenance["inputs"].keys()
    assert [name.partition(":")[0] for name in file.provenance["bodies"]] == ["rigged.usda", *names]
    assert run("bake graded.safetensors --motion clip.usda --stage heavier.usda --refine 2 -o heavy.usda") == 0
    assert run("verify heavy.usda") == 0
    assert run(f"{TRAIN} --graded -o new.safetensors", *toy.training) == 2
    assert "--graded: no --family" in capsys.readouterr().err
    onward = f"{TRAIN} --family {' '.join(names)} --start-from graded.safetensors -o onward.safetensors"
    steps = [word.replace("static_fraction=0.5", "static_fraction=0") for word in toy.training]
    assert run(onward, *steps) in (EXIT_OK, EXIT_WORSE)
    told = capsys.readouterr()
    assert "it was trained as graded to each, and goes on as one garment for all bodies" in told.out + told.err


def test_a_training_tells_the_figures_of_each_body_and_the_worst(world, toy, capsys):
    run(f"{TRAIN} --family taller.usda heavier.usda -o new.safetensors", *toy.training)
    told = capsys.readouterr()
    told = told.out + told.err
    assert "taller.usda:/Hero [J]" in told and "heavier.usda:/Hero [J]" in told and "worst body" in told


def test_a_family_needs_members(world, capsys, toy):
    stage = Usd.Stage.Open("taller.usda")
    stage.GetPrimAtPath("/Hero/Rig").GetAttribute("joints").Set(["Hips", "Hips/Spine", "Hips/Spine/Skull"])
    stage.Save()
    assert run(f"{TRAIN} --family taller.usda -o new.safetensors", *toy.training) == 2
    assert "Hips/Spine/Skull" in capsys.readouterr().err and not Path("new.safetensors").exists()
    assert run(f"{TRAIN} --family heavier.usda --stepper-of model.safetensors -o new.safetensors") == 2
    assert "a family of bodies" in capsys.readouterr().err


def test_a_family_goes_on_from_a_model_of_its_first_body_or_of_itself(world, toy, capsys):
    steps = [word.replace("static_fraction=0.5", "static_fraction=0") for word in toy.training]
    assert run(f"{TRAIN} --family heavier.usda --start-from model.safetensors -o new.safetensors", *steps) == 0
    own = load_model("new.safetensors")
    assert own.bodies is not None and own.provenance["whole"]
    assert run(f"{TRAIN} --family heavier.usda --start-from new.safetensors -o more.safetensors", *steps) == 0
    capsys.readouterr()
    assert run(f"{TRAIN} --family taller.usda --start-from new.safetensors -o odd.safetensors", *steps) == 2
    assert "another family of bodies" in capsys.readouterr().err and not Path("odd.safetensors").exists()


def test_a_training_of_a_family_goes_on_as_if_it_had_not_stopped(world, toy, monkeypatch):
    from ssilk_core.training import run as training

    whole = Path("family.safetensors").read_bytes()
    command = f"{TRAIN} --family taller.usda heavier.usda -o again.safetensors"
    steps = []

    def step(self) -> None:
        steps.append(self.state.iteration)
        if len(steps) == 5:
            raise KeyboardInterrupt
        original(self)

    original = training.TrainingRun.step
    monkeypatch.setattr(training.TrainingRun, "step", step)
    assert run(command, *toy.training) == EXIT_INTERRUPTED
    monkeypatch.setattr(training.TrainingRun, "step", original)
    assert run(f"{command} --resume", *toy.training) in (EXIT_OK, EXIT_WORSE)
    found = load_model("again.safetensors")
    for name, values in load_model("family.safetensors").parameters.items():
        np.testing.assert_allclose(found.parameters[name], values, atol=1e-6)
    assert whole


BAKE = "bake family.safetensors --motion clip.usda"


def test_on_its_first_body_a_family_bakes_what_a_model_of_that_body_alone_does(world):
    file = load_model("family.safetensors")
    save_model("base.safetensors", file.on_body(np.zeros(2)))
    assert run(f"{BAKE} --stage rigged.usda -o family.usda") == 0
    assert run("bake base.safetensors --motion clip.usda --stage rigged.usda -o base.usda") == 0
    family, base = (
        Path(shot).read_text().replace(sha256(model), "").replace(sha256(model)[:12], "").replace(shot, "")
        for shot, model in (("family.usda", "family.safetensors"), ("base.usda", "base.safetensors"))
    )
    differing = [one for one, other in zip(family.splitlines(), base.splitlines()) if one != other]
    assert len(family) > 10_000 and not [line for line in differing if "safetensors" not in line]


def shown(path: str, frame: float) -> dict[str, np.ndarray]:
    """Points (V, 3) in the world in a frame of a shot, as UsdSkel deforms meshes with their blendshapes."""
    stage, found = Usd.Stage.Open(path), {}
    assert UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            to_world = np.array(mesh.ComputeLocalToWorldTransform(frame))  # shots in layers move their SkelRoot
            points = np.array(mesh.GetPointsAttr().Get(frame))
            found[prim.GetName()] = points @ to_world[:3, :3] + to_world[3, :3]
    return found


def member_clip(path: str, ratio: float) -> None:
    """The toy's clip for a body whose joints are so much higher."""
    stage = Usd.Stage.Open(Usd.Stage.Open("clip.usda").Flatten())
    translations = UsdSkel.Animation(stage.GetPrimAtPath("/Clip")).GetTranslationsAttr()
    for time in translations.GetTimeSamples():
        translations.Set([Gf.Vec3f(at[0], at[1] * ratio, at[2]) for at in translations.Get(time)], time)
    stage.GetRootLayer().Export(path)


def test_a_member_is_baked_as_plain_usdskel_with_its_own_body_and_garment(world, capsys):
    assert run("bake family.safetensors --motion clip.usda --stage heavier.usda -o heavy.usda") == 0
    told = capsys.readouterr()
    assert "heavier.usda:/Hero: a body of the model's family, that of heavier.usda:/Hero" in told.out + told.err
    assert run(f"{BAKE} --stage rigged.usda -o base.usda") == 0
    own, its = shown("base.usda", 0), shown("heavy.usda", 0)
    np.testing.assert_allclose(its["Body"], heavier(own["Body"]), atol=1e-4)
    assert run("verify heavy.usda") == 0
    away = np.linalg.norm(its["Skirt"] - own["Skirt"], axis=1)
    assert 0.005 < away.mean() < 0.3


def test_a_look_that_no_member_has_is_told_with_what_brings_it(world, capsys):
    assert run("bake family.safetensors --motion clip.usda --stage heavier.usda -o bare.usda") == 0
    told = capsys.readouterr()
    assert "'ssilk rig STAGE --onto heavier.usda' writes a stage that has it" in told.out + told.err
    assert run("rig rigged.usda --onto heavier.usda -o heavier_skirt.usda") == 0
    capsys.readouterr()
    assert run("bake family.safetensors --motion clip.usda --stage heavier_skirt.usda -o dressed.usda") == 0
    told = capsys.readouterr()
    assert "loses its look" not in told.out + told.err and "that of heavier.usda:/Hero" in told.out + told.err


def test_a_taller_body_has_its_garment_higher(world):
    member_clip("tall_clip.usda", 1.15)
    assert run("bake family.safetensors --motion tall_clip.usda --stage taller.usda -o tall.usda") == 0
    assert run(f"{BAKE} --stage rigged.usda -o base.usda") == 0
    own, its = shown("base.usda", 10), shown("tall.usda", 10)
    assert its["Skirt"][:, 1].max() == pytest.approx(1.15 * own["Skirt"][:, 1].max(), rel=0.02)


def points_of(path: str) -> np.ndarray:
    stage = Usd.Stage.Open(path)
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get())


def test_a_body_that_training_never_saw_is_baked_and_one_too_far_off_is_refused(world, capsys):
    write_member(world / "between.usda", lambda points: points * [1.2, 1.05, 1.2])
    capsys.readouterr()
    assert run(f"{BAKE} --stage between.usda -o between_shot.usda") == 0
    told, member = capsys.readouterr(), points_of("heavier.usda")
    away = 1000 * np.linalg.norm(points_of("between.usda") - member, axis=1).mean()
    assert f"nearest to heavier.usda:/Hero, whose skin is {away:.0f} mm away on average" in told.out + told.err
    write_member(world / "large.usda", lambda points: points * [1.36, 1, 1.36])
    capsys.readouterr()
    assert run(f"{BAKE} --stage large.usda -o large_shot.usda") == 0
    told = capsys.readouterr()
    assert "beyond the bodies of the training" in told.out + told.err
    file = load_model("family.safetensors")
    large = worn(file, open_stage("large.usda"), None)
    seen = file.on_body(file.bodies.family.bodies.place_of(large.scene.character).coordinates)
    assert all(np.array_equal(value, seen.parameters[name]) for name, value in large.file.parameters.items())
    write_member(world / "huge.usda", lambda points: points * [2.2, 1, 2.2])
    assert run(f"{BAKE} --stage huge.usda -o huge_shot.usda") == 2
    told = capsys.readouterr().err
    assert "beyond the bodies that the model was trained for, nearest to heavier.usda:/Hero" in told
    write_member(world / "bent.usda", lambda points: points + [0.2, 0, 0] * np.sin(4 * points[:, 1:2]))
    assert run(f"{BAKE} --stage bent.usda -o bent_shot.usda") == 2
    assert "from all that the model's family of bodies adds up to" in capsys.readouterr().err
    assert not Path("huge_shot.usda").exists() and not Path("bent_shot.usda").exists()
    assert run(f"{BAKE} {BODIES} --stage huge.usda -o shots/") == 2  # before any is baked
    assert "beyond the bodies that the model was trained for" in capsys.readouterr().err
    assert not Path("shots").exists()


def test_a_model_of_one_body_still_refuses_others(world, capsys):
    assert run("bake model.safetensors --motion clip.usda --stage taller.usda -o out.usda") == 2
    told = capsys.readouterr().err
    assert "a model bakes on the character it was trained with" in told and "on both bodies with --family" in told


def test_evaluate_takes_a_member(world):
    (world / "clips").mkdir()
    shutil.copy("clip.usda", "clips")
    listed = "--motions clips --no-probes"
    assert run(f"evaluate family.safetensors --stage heavier.usda {listed} -o heavy.json") == 0
    assert run(f"evaluate family.safetensors --stage rigged.usda {listed} -o base.json") == 0
    assert Path("heavy.json").read_text() != Path("base.json").read_text()


def test_a_model_is_exported_for_a_member_and_reduced_for_all(world, capsys, graphs):
    assert run("export family.safetensors -o base.onnx") == 0
    told = capsys.readouterr()
    assert "for the first of them" in told.out + told.err
    assert run("export family.safetensors --stage heavier.usda -o heavy.onnx") == 0
    assert run("export model.safetensors --stage rigged.usda -o alone.onnx") == 0
    base, heavy = graphs["base.onnx"], graphs["heavy.onnx"]
    assert [value.shape for value in base.values()] == [value.shape for value in heavy.values()]
    changed = {name.rpartition(".")[2] for name in base if not torch.equal(base[name], heavy[name])}
    assert {"bias", "bind_rotations", "places"} & changed, changed
    assert run("reduce family.safetensors --motions clip.usda --joints 3 -o small.safetensors") == 0
    small = load_model("small.safetensors")
    assert small.scene.rig.proxy_count < 4 and small.bodies.family.proxy_moves.shape[1] == small.scene.rig.proxy_count
    assert run("bake small.safetensors --motion clip.usda --stage heavier.usda -o small.usda") == 0


def test_a_level_of_quality_of_a_member_is_fitted_to_it(world, monkeypatch):
    from ssilk_core.delivery.bake import sizing

    reduced, original = [], sizing.Reducer
    monkeypatch.setattr(
        sizing, "Reducer", lambda file, *given, **kept: reduced.append(file) or original(file, *given, **kept)
    )
    assert run(f"{BAKE} --stage heavier.usda --budget 1MB -o small.usda") == 0
    (file,) = reduced
    points = file.scene.garment.mesh.points
    base = load_model("family.safetensors").scene.garment.mesh.points
    assert np.abs(points - base).max() > 0.04


@pytest.mark.parametrize(
    "command",
    ["stress family.safetensors --quick --only 'rate: 60'", "trade family.safetensors --motions clips --frames 4"],
)
def test_what_there_is_to_say_of_a_body_is_said_by_all_that_measure_it(world, capsys, monkeypatch, command):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt  # all is said before anything is measured

    monkeypatch.setattr("ssilk_core.cli.trade.Bench.meter", interrupted)
    (world / "clips").mkdir()
    shutil.copy("clip.usda", "clips")
    write_member(world / "large.usda", lambda points: points * [1.36, 1, 1.36])
    run(f"{command} --stage large.usda")
    told = capsys.readouterr()
    assert "beyond the bodies of the training" in told.out + told.err


@pytest.mark.slow
def test_a_stress_on_several_bodies_has_cases_of_each_and_says_which_they_are(world, capsys):
    stages = "--stage rigged.usda --stage heavier.usda"
    assert run(f"stress family.safetensors {stages} --quick --only 'rate: 60' 'motion: NaN' -o out.json") == 0
    told = capsys.readouterr()
    told = told.out + told.err
    assert "rigged.usda:/Hero: the first body of the model's family" in told
    assert "heavier.usda:/Hero: a body of the model's family, that of heavier.usda:/Hero" in told
    found = json.loads(Path("out.json").read_text())["outcomes"]
    labels = [f"{each['group']}: {each['name'][:3]}" for each in found]
    assert labels == ["rigged/rate: 60 ", "rigged/motion: NaN", "heavier/rate: 60 ", "heavier/motion: NaN"]
    extents = [each["measured"]["extent"] for each in found if each["measured"]["extent"]]
    assert extents[0] != extents[1]
    assert run(f"stress family.safetensors {stages} --quick --only 'rate: 60' 'motion: NaN' -o out.json") == 0
    assert "4 rows were measured before" in capsys.readouterr().err
    shutil.copytree(".", "more", ignore=shutil.ignore_patterns("more"))
    assert run("stress family.safetensors --stage heavier.usda --stage more/heavier.usda --quick") == 2
    assert "a second body 'heavier'" in capsys.readouterr().err


def save_graded(model: str, output: str) -> None:
    """Write a model whose garment is graded to bodies, with the same networks."""
    file = load_model(model)
    garment = replace(file.scene.garment, graded=True)
    save_model(output, replace(file, scene=replace(file.scene, garment=garment)))


@pytest.mark.slow
def test_a_page_counts_stretch_from_the_rest_shape_of_the_garment_that_was_trained(world, capsys):
    from ssilk_core.physics.energy import GarmentEnergy

    assert run("bake family.safetensors --motion clip.usda --stage heavier.usda -o heavy.usda") == 0
    assert run("report heavy.usda -o heavy.html") == 0
    said = Path("heavy.html").read_text()
    assert "stretch counts from its shape on the first of them" in said
    file, found = load_model("family.safetensors"), []
    energy = GarmentEnergy(file.scene.garment.mesh, file.fabric)
    for frame in range(10):
        points = shown("heavy.usda", frame)["Skirt"]
        found.append(float(energy.stretch(torch.tensor(points[:, :, None], dtype=torch.float32))))
    assert stretch_in("heavy.html") == pytest.approx(np.mean(found), rel=0.02)
    Path("family.safetensors").rename("elsewhere.safetensors")
    assert run("report heavy.usda -o other.html") == 0
    assert "its model is not where it was baked from" in capsys.readouterr().err
    assert abs(stretch_in("other.html") - stretch_in("heavy.html")) > 0.1 * stretch_in("heavy.html")
    Path("elsewhere.safetensors").rename("family.safetensors")
    save_graded("family.safetensors", "graded.safetensors")
    assert run("bake graded.safetensors --motion clip.usda --stage heavier.usda -o graded.usda") == 0
    assert run("report graded.usda -o graded.html") == 0
    assert "graded to this body" in Path("graded.html").read_text()
    assert stretch_in("graded.html") == pytest.approx(stretch_in("other.html"), rel=1e-3)
    model = "report family.safetensors --stage heavier.usda --motion clip.usda -o model.html"
    assert run(model) == 0
    assert stretch_in("model.html") == pytest.approx(stretch_in("heavy.html"), rel=1e-3)
    page = Path("model.html").read_text()
    assert "The garment is one for all bodies." in page and "<td>taller.usda:/Hero</td>" in page


def test_a_character_without_a_stage_is_no_body_to_export_for(world, capsys):
    assert run("export family.safetensors --root /Hero -o hero.onnx") == 2
    assert "a SkelRoot without a stage" in capsys.readouterr().err and not Path("hero.onnx").exists()


def test_a_model_of_a_family_does_not_train_on_as_one_of_a_body(world, capsys):
    assert run(f"{TRAIN} --preset draft --start-from family.safetensors -o new.safetensors") == 2
    assert "name its bodies with --family" in capsys.readouterr().err


def with_hat(path: str) -> None:
    """Give a hero a second mesh, which one of its joints carries; it is no body unless it is named."""
    stage = Usd.Stage.Open(path)
    hat = UsdGeom.Mesh.Define(stage, "/Hero/Hat")
    hat.CreatePointsAttr([(0.1, 1.7, 0), (-0.1, 1.7, 0), (0, 1.8, 0.1)])
    hat.CreateFaceVertexCountsAttr([3])
    hat.CreateFaceVertexIndicesAttr([0, 1, 2])
    skin = UsdSkel.BindingAPI.Apply(hat.GetPrim())
    skin.CreateJointIndicesPrimvar(True, 1).Set([2])
    skin.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    stage.Save()


@pytest.mark.parametrize("named", ["--body Body", "--body Hat --body Body"])
def test_a_family_of_some_meshes_is_dressed_on_its_own_stages(world, toy, capsys, named):
    for path in ("rigged.usda", "taller.usda"):
        with_hat(path)
    train = f"{TRAIN} --family taller.usda {named} -o some.safetensors"
    assert run(train, *toy.training) in (EXIT_OK, EXIT_WORSE)
    shot = "bake some.safetensors --motion clip.usda"
    assert run(f"{shot} --stage rigged.usda -o own.usda") == 0
    capsys.readouterr()
    assert run(f"{shot} --stage taller.usda -o its.usda") == 0
    told = capsys.readouterr()
    assert "a body of the model's family" in told.out + told.err
    assert {"Body", "Hat", "Skirt"} <= shown("its.usda", 3).keys()


def test_a_family_is_not_dressed_where_its_mesh_has_other_points(world, capsys):
    stage = Usd.Stage.Open("taller.usda")
    body = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body"))
    body.GetPointsAttr().Set([*body.GetPointsAttr().Get(), (0, 2, 0)])
    for name, weight in (("jointIndices", 2), ("jointWeights", 1.0)):
        values = UsdGeom.PrimvarsAPI(body).GetPrimvar(f"skel:{name}")
        values.Set([*values.Get(), weight])
    stage.Save()
    assert run(f"{BAKE} --stage taller.usda -o out.usda") == 2
    told = capsys.readouterr().err
    assert "'Body' with" in told and "the model's family of bodies has 'Body' with" in told
    assert not Path("out.usda").exists()


def test_bodies_that_are_alike_in_three_digits_are_two(world, capsys):
    write_member(world / "one.usda", lambda points: points * [1.15, 1, 1.15])
    write_member(world / "other.usda", lambda points: points * [1.15003, 1, 1.15003])
    shot = "bake family.safetensors --motion clip.usda"
    assert run(f"{shot} --stage one.usda -o shots/") == 0
    capsys.readouterr()
    assert run(f"{shot} --stage other.usda --shot-name second -o shots/") == 2
    assert "another body of its model's family" in capsys.readouterr().err


def test_in_a_folder_of_layers_a_name_stays_with_its_body(world, capsys):
    shot = "bake family.safetensors --motion clip.usda"
    assert run(f"{shot} --stage heavier.usda -o shots/") == 0
    asset = next(Path("shots/assets").rglob("*.usd*")).read_bytes()
    capsys.readouterr()
    assert run(f"{shot} --stage rigged.usda --shot-name other -o shots/") == 2
    assert "another body of its model's family" in capsys.readouterr().err
    assert next(Path("shots/assets").rglob("*.usd*")).read_bytes() == asset
    assert run(f"{shot} --stage rigged.usda --shot-name other --garment-name slim -o shots/") == 0
    assert run(f"{shot} --stage heavier.usda --shot-name third -o shots/") == 0


def test_garments_of_a_family_in_one_glb_are_compared_where_they_lie_on_their_body(world, monkeypatch):
    """Not where they lie on the first one, which what lies over what is told by as well."""
    shutil.copy("family.safetensors", "other.safetensors")
    met, by_cover = [], ClothLayers.by_cover

    def watched(one, other, body):
        met.append((one[1].points, other[1].points, body))
        return by_cover(one, other, body)

    monkeypatch.setattr(ClothLayers, "by_cover", watched)
    bake = "bake family.safetensors other.safetensors --motion clip.usda --target glb"
    assert run(f"{bake} --stage taller.usda -o both.glb") == 0
    ((one, other, body),) = met
    assert body.points[:, 1].max() == pytest.approx(1.7 * 1.15, abs=1e-3)
    for points in one, other:
        assert points[:, 1].max() == pytest.approx(1.3 * 1.15, abs=0.02)
    stage = Usd.Stage.Open("rigged.usda")
    stage.RemovePrim("/Hero/Body")
    stage.Export("bare.usda")
    shutil.copy("model.safetensors", "second.safetensors")
    bare = "bake model.safetensors second.safetensors --motion clip.usda --target glb --stage bare.usda -o bare.glb"
    assert run(bare) == 0 and met[1][2] is None


def layer_files(folder: str) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path) for path in Path(folder).rglob("*") if path.is_file()}


BODIES = "--stage rigged.usda --stage heavier.usda"


@pytest.mark.parametrize("command", ["bake family.safetensors", "farm family.safetensors --bundle job"])
def test_two_stages_of_one_name_are_told_apart_by_a_pattern(world, capsys, command):
    (world / "cast").mkdir()
    shutil.copy("heavier.usda", "cast/rigged.usda")
    asked = f"{command} --motion clip.usda --stage rigged.usda --stage cast/rigged.usda -o shots/"
    assert run(asked) == 2
    told = capsys.readouterr().err
    assert "'rigged.usda' and 'cast/rigged.usda' would both be the body 'rigged'" in told and "--body-name" in told
    assert not Path("shots").exists() and not Path("job").exists()
    assert run(f"{asked} --body-name '{{parent}}'") == 0


def test_a_job_bakes_garments_in_shots_on_bodies_and_a_bad_body_fails_alone(world, capsys):
    shutil.copy("clip.usda", "walk.usda")
    write_member(world / "huge.usda", lambda points: points * [2.2, 1, 2.2])
    farm = f"farm family.safetensors --motion clip.usda walk.usda {BODIES} --stage huge.usda --bundle job"
    assert run(farm) == 0
    assert len(json.loads(Path("job/job.json").read_text())["tasks"]) == 6
    capsys.readouterr()
    assert run("task job/job.json -o shots") == 4
    told = capsys.readouterr()
    assert (told.out + told.err).count("beyond the bodies that the model was trained for") == 2
    assert run("task job/job.json -o shots --check") == 3
    names = {"clip", "walk"}
    assert {path.parent.name for path in Path("shots/shots").glob("*/shot.usda")} == {
        f"{body}_{name}" for body in ("rigged", "heavier") for name in names
    }
    for body in ("rigged", "heavier"):
        assert run(f"{BAKE} --stage {body}.usda -o {body}_alone.usdc") == 0
        found = shown(f"shots/shots/{body}_walk/shot.usda", 7)
        for name, points in shown(f"{body}_alone.usdc", 7).items():
            np.testing.assert_allclose(found[name], points, rtol=0, atol=1e-5)
    before = layer_files("shots")
    write_member(world / "huge.usda", lambda points: points * [1.2, 1, 1.2])
    assert run(farm) == 0
    assert run("task job/job.json -o shots") == 0 and run("task job/job.json -o shots --check") == 0
    after = layer_files("shots")
    assert before.items() <= after.items() and "assets/huge_family/asset.usda" in after


def test_one_stage_names_no_body_and_a_body_alone_joins_the_others(world, capsys):
    bake = "bake family.safetensors --motion clip.usda -o shots/"
    assert run(f"{bake} {BODIES}") == 0
    before = layer_files("shots")
    assert run(f"{bake} --stage taller.usda --body-name '{{stem}}'") == 0
    assert run(f"{bake} --stage taller.usda") == 0
    names = {name.split("/")[1] for name in layer_files("shots").keys() - before.keys()}
    assert names == {"taller_clip", "taller_family", "clip", "family"}
    assert before.items() <= layer_files("shots").items()
    capsys.readouterr()
    assert run(f"{bake} {BODIES} --json") == 0
    results = [json.loads(line)["detail"] for line in capsys.readouterr().out.splitlines() if '"result"' in line]
    assert results and all(detail.get("current") for detail in results), results


def test_levels_of_quality_are_of_the_garment_on_their_own_body(world):
    bake = f"bake family.safetensors --motion clip.usda -o shots/ {BODIES}"
    assert run(bake) == 0
    assert run(f"{bake} --level-of family --garment-name family_lbs --lbs") == 0
    for body in ("rigged", "heavier"):
        stage = Usd.Stage.Open(f"shots/shots/{body}_clip/shot.usda")
        levels = stage.GetPrimAtPath(f"/Shot/{body}_family").GetVariantSet("level")
        assert set(levels.GetVariantNames()) == {"default", "lbs"}


def test_several_bodies_go_into_no_file(world, capsys):
    assert run(f"bake family.safetensors --motion clip.usda {BODIES} -o shot.usdc") == 2
    assert "bodies in one file" in capsys.readouterr().err and not Path("shot.usdc").exists()


def test_an_evaluation_on_several_bodies_has_rows_of_each_and_tells_the_worst(world, toy, capsys):
    (world / "clips").mkdir()
    toy.write_clip(world / "clips" / "brief.usda", frames=6)
    stages = "--stage rigged.usda --stage taller.usda --stage heavier.usda"
    asked = "--motions clips --no-probes"
    assert run(f"evaluate family.safetensors {stages} {asked} -o figures.json") == EXIT_OK
    told = capsys.readouterr()
    document = json.loads(Path("figures.json").read_text())
    rows = {(row["garment"], row["method"]): row["figures"] for row in document["figures"]}
    bodies = ("rigged", "taller", "heavier")
    assert rows.keys() == {(f"{body}/Skirt", method) for body in bodies for method in ("LBS", "ssilk")}
    won = {b: 1 - rows[f"{b}/Skirt", "ssilk"]["total"] / rows[f"{b}/Skirt", "LBS"]["total"] for b in bodies}
    assert f"worst body, Skirt, ssilk, all: {min(won, key=won.get)}," in told.out + told.err
    assert "have the bones of the model's first body, and are played on its own" in told.err
    for body in bodies:  # as on that body alone
        assert run(f"evaluate family.safetensors --stage {body}.usda {asked} -o one.json") == EXIT_OK
        alone = {row["method"]: row["figures"] for row in json.loads(Path("one.json").read_text())["figures"]}
        assert alone == {method: rows[f"{body}/Skirt", method] for method in ("LBS", "ssilk")}
        Path("one.json").unlink()
    capsys.readouterr()
    assert run(f"evaluate family.safetensors {stages} {asked} -o figures.json") == EXIT_OK
    assert "it is complete" in capsys.readouterr().err
    assert run(f"evaluate family.safetensors --stage rigged.usda --stage ./rigged.usda {asked}") == 2
    assert "a second body 'rigged'" in capsys.readouterr().err
    assert run(f"evaluate model.safetensors {stages} {asked}") == 2


def test_two_ways_to_meet_a_body_are_each_compared_with_what_is_sewn_alike(world, toy, capsys):
    (world / "clips").mkdir()
    toy.write_clip(world / "clips" / "brief.usda", frames=6)
    save_graded("family.safetensors", "graded.safetensors")
    asked = "--stage rigged.usda --stage heavier.usda --motions clips --no-probes"
    assert run(f"evaluate family.safetensors graded.safetensors {asked} -o both.json") == EXIT_OK
    told = capsys.readouterr()
    found = json.loads(Path("both.json").read_text())["figures"]
    rows = [(row["garment"], row["method"]) for row in found]
    ways = [("heavier/Skirt", f"ssilk ({name})") for name in ("family", "graded")]
    assert rows[-4:] == [("heavier/Skirt", "LBS"), ways[0], ("heavier/Skirt", "LBS"), ways[1]]
    totals = [row["figures"]["total"] for row in found[-4:]]
    assert totals[0] > 2 * totals[2] > 0  # linear blend skinning is stretched, too
    on_base = [row["figures"]["total"] for row in found[:-4]]
    for own, lbs, name, base in zip(totals[1::2], totals[::2], ("family", "graded"), on_base[1:]):
        body, total, below = min(
            (("rigged", base, on_base[0]), ("heavier", own, lbs)), key=lambda each: 1 - each[1] / each[2]
        )
        assert f"worst body, Skirt, ssilk ({name}), all: {body}, {total:.4g} J, " in told.out + told.err
        side = "below" if total <= below else "above"
        words = f"{abs(1 - total / below):.1%} {side} linear blend skinning"
        assert words in told.out + told.err


def test_clips_that_were_made_for_a_body_are_played_as_they_are(world, toy, capsys):
    (world / "clips").mkdir()
    toy.write_clip(world / "clips" / "own.usda", frames=6)
    clip = Usd.Stage.Open("clips/own.usda")
    animation = next(prim for prim in clip.Traverse() if prim.IsA(UsdSkel.Animation))
    bones = bind_pose(read_character(Path("taller.usda")).skeleton)[1].tolist()
    own = UsdSkel.Animation(animation).GetTranslationsAttr()
    for time in own.GetTimeSamples() or [Usd.TimeCode.Default()]:
        values = list(own.Get(time))
        values[1:] = [Gf.Vec3f(*bone) for bone in bones[1:]]
        own.Set(values, time)
    clip.Save()
    assert run("evaluate family.safetensors --stage taller.usda --motions clips --no-probes") == EXIT_OK
    assert "played on its own" not in capsys.readouterr().err
    cases = (("clips/own.usda", "taller", 0), ("clip.usda", "taller", 1), ("clip.usda", "hero", 0))
    for motion, stage, warned in cases:
        assert run(f"bake family.safetensors --stage {stage}.usda --motion {motion} -o {stage}_shot.usda") == EXIT_OK
        assert capsys.readouterr().err.count("retarget it to the bones of this body") == warned


def test_a_family_is_measured_on_a_character_with_more_joints(world):
    """Its joints are no coordinates of the family, and its motions are none of the family's first body."""
    axes = write_other(world / "other.usda")
    write_clip(world / "other_clip.usda", axes)
    stage = Usd.Stage.Open("other.usda")
    rig = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    binds, rests = rig.GetBindTransformsAttr(), rig.GetRestTransformsAttr()
    rig.GetJointsAttr().Set([*OTHER_JOINTS, f"{OTHER_JOINTS[1]}/tail"])
    binds.Set([*binds.Get(), binds.Get()[1]])
    rests.Set([*rests.Get(), Gf.Matrix4d(1)])
    stage.Save()
    put_on()
    (world / "clips").mkdir()
    shutil.copy("other_clip.usda", "clips")
    asked = "family.safetensors --stage other_skirt.usda"
    assert run(f"evaluate {asked} --motions clips --no-probes -o figures.json") == EXIT_OK
    assert run(f"stress {asked} --motion other_clip.usda --quick --only 'rate: 60'") == EXIT_OK


@pytest.fixture
def shapes(world) -> Path:
    """The rigged toy with the bodies of the family as blendshapes, `slight` of which is marked, and the world."""
    stage = Usd.Stage.Open("rigged.usda")
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get(), dtype=float)
    for name, change in (("taller", taller), ("heavier", heavier), ("slight", lambda points: points * [0.9, 1, 0.9])):
        add_shape(stage, name, change(points) - points)
    shape = stage.GetPrimAtPath("/Hero/Body/Slight")
    shape.CreateAttribute("ssilk:weightRange", Sdf.ValueTypeNames.Float2, False).Set((-0.5, 1))
    stage.GetRootLayer().Export("shapes.usda")
    return world


@pytest.mark.parametrize("path", ["plain.usda", "link.usda"])
def test_a_stage_is_the_same_however_its_path_is_written(world, capsys, path):
    """Its garment, which is not marked as one, is none of the body by shapes."""
    stage = Usd.Stage.Open("rigged.usda")
    skirt = stage.GetPrimAtPath("/Hero/Skirt")
    for said in skirt.GetAuthoredProperties():
        if "ssilk:" in said.GetName():
            skirt.RemoveProperty(said.GetName())
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get(), dtype=float)
    add_shape(stage, "heavier", heavier(points) - points)
    stage.GetRootLayer().Export("plain.usda")
    Path("link.usda").symlink_to("plain.usda")
    code, found = findings(capsys, f"inspect plain.usda --garment Skirt --family {path}:heavier=1")
    assert "no-family" not in found and found["family"]["count"] == 2, (code, found)


def test_inspect_tells_bodies_by_shapes_with_their_millimetres(shapes, capsys):
    code, found = findings(capsys, "inspect shapes.usda --family taller=1 heavier=0.5,taller=0.2")
    assert code == 0 and found["family"]["count"] == 3
    assert found["body-shape"]["prim"] == "shapes.usda:heavier=0.5,taller=0.2:/Hero"
    far = 1000 * np.linalg.norm(0.5 * np.array([0.15 * 0.3, 0.4 * 0.15 * 1.7]))
    assert f" mm on average and {far:.1f} mm at most, and joints" in found["body-shape"]["found"]
    assert "45.0 mm at most, which is 'Head'" in found["body-shape"]["found"]
    code, found = findings(capsys, "inspect shapes.usda")
    assert code == 0 and "slight (-0.5 to 1)" in found["body-parameters"]["found"]
    code, found = findings(capsys, "inspect shapes.usda --family")
    assert code == 0 and found["family"]["count"] == 3
    stage = Usd.Stage.Open("shapes.usda")
    mark = stage.GetPrimAtPath("/Hero/Body/Taller").CreateAttribute("ssilk:weightRange", Sdf.ValueTypeNames.Float2)
    mark.Set((0, 1))
    stage.Save()
    code, found = findings(capsys, "inspect shapes.usda --family")
    assert code == 0 and found["family"]["count"] == 6
    assert run("inspect rigged.usda --family") == 2
    assert "it marks no body parameters with ssilk:weightRange" in capsys.readouterr().err


def test_a_training_takes_bodies_by_shapes_as_it_does_their_stages(shapes, toy):
    from ssilk_core.cli.train import training_job

    parser = command_line()
    stages, by_shapes, marked = (
        training_job(parser.parse_args(shlex.split(f"{TRAIN.replace('rigged', 'shapes')} {family} -o x.safetensors")
                     + [*toy.training]), "cpu", silent)
        for family in ("--family taller.usda heavier.usda", "--family taller=1 heavier=1", "--family")
    )  # fmt: skip
    for name in ("members", "joint_moves", "point_moves"):
        one, other = (getattr(job.family.bodies, name) for job in (stages, by_shapes))
        np.testing.assert_allclose(one, other, atol=1e-4)
    np.testing.assert_allclose(stages.family.cloth_moves, by_shapes.family.cloth_moves, atol=1e-3)
    assert [name.split(":")[1] for name in marked.family.bodies.names[1:]] == ["slight=-0.5", "slight=1"]
    assert by_shapes.inputs.keys() == marked.inputs.keys() == {"shapes.usda", "clip.usda"}


def test_a_garment_is_put_onto_a_body_by_shapes(shapes, capsys):
    assert run("rig shapes.usda --onto heavier=1 -o by_shapes.usda") == 0
    assert run("rig rigged.usda --onto heavier.usda -o by_stage.usda") == 0
    for mine, theirs in zip(skinned_rest("by_shapes.usda"), skinned_rest("by_stage.usda")):
        np.testing.assert_allclose(mine, theirs, atol=1e-4)
    stage = Usd.Stage.Open("by_shapes.usda")
    assert sum(prim.IsA(UsdGeom.Mesh) for prim in stage.Traverse()) == 2  # it is moved, not doubled
    capsys.readouterr()
    assert run("simulate shapes.usda:heavier=1 --motion clip.usda -o out.usda") == 2
    assert "'ssilk rig shapes.usda --onto heavier=1' puts it on that one" in capsys.readouterr().err
    assert run("rig shapes.usda --onto heavier=1.2 -o out.usda") == 2
    assert "shape 'heavier' weighs 1.2; 0 to 1 is allowed" in capsys.readouterr().err
    assert not Path("out.usda").exists()


def test_a_body_by_shapes_is_baked_as_its_stage_is_and_the_motion_is_played_between_its_bones(shapes, capsys):
    member_clip("tall_clip.usda", 1.15)
    stage = Usd.Stage.Open("shapes.usda")
    red = UsdShade.Material.Define(stage, "/Hero/Red")
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/Hero/Body")).Bind(red)
    stage.Save()
    assert run("bake family.safetensors --motion tall_clip.usda --stage taller.usda -o by_stage.usda") == 0
    capsys.readouterr()
    assert run("bake family.safetensors --motion clip.usda --stage shapes.usda:taller=1 -o by_shapes.usda") == 0
    told = capsys.readouterr()
    assert "are played between this one's bones" in told.out + told.err
    assert "a body of the model's family, that of taller.usda:/Hero" in told.out + told.err
    stage = Usd.Stage.Open("by_shapes.usda")
    (body,) = (prim for prim in stage.Traverse() if prim.GetName() == "Body")
    assert UsdShade.MaterialBindingAPI(body).ComputeBoundMaterial()[0].GetPath().name == "Red"
    found, farther = shown("by_shapes.usda", 12), 0.15 * 0.2 * np.sin(12 / 7)  # the hub's way grows with the legs
    for name, points in shown("by_stage.usda", 12).items():
        np.testing.assert_allclose(found[name], points + [farther, 0, 0], atol=1e-3)
    assert run("verify by_shapes.usda") == 0
    Path("moved").mkdir()
    shutil.move("shapes.usda", "moved/shapes.usda")
    assert run("verify by_shapes.usda --stage moved/shapes.usda") == 0


def test_a_hand_poses_proxies_of_a_body_by_shapes_about_where_these_are(shapes):
    """The shot has the proxies of the stage's own body: what these are moved by there, they are moved by here."""
    home, clip = Usd.Stage.Open("shapes.usda"), Usd.Stage.Open("clip.usda")
    proxy = home.GetPrimAtPath("/Hero/Skirt").GetAttribute("ssilk:proxyJoints").Get()[0]
    request = BakeRequest(model="family.safetensors", stage="shapes.usda:heavier=1", motion="clip.usda")
    scenes = [load_rollout(replace(request, stage=stage)).deformer.scene for stage in ("shapes.usda", request.stage)]
    number = scenes[0].joint_names.index(proxy)
    parent = int(scenes[0].parents[number])
    binds = [invert_rigid(each.bind_transforms[parent]) @ each.bind_transforms[number] for each in scenes]
    animation = UsdSkel.Animation(clip.GetPrimAtPath("/Clip"))
    animation.GetJointsAttr().Set([*animation.GetJointsAttr().Get(), proxy])
    animation.GetScalesAttr().Set([Gf.Vec3h(1)] * 4)
    at = binds[0][:3, 3] + [0.1, -0.2, 0.3]
    for attribute, value in (
        (animation.GetRotationsAttr(), Gf.Quatf(0.8, 0.6, 0, 0)), (animation.GetTranslationsAttr(), Gf.Vec3f(*at)),
    ):  # fmt: skip
        for code in attribute.GetTimeSamples():
            attribute.Set([*attribute.Get(code), value], code)
    over = clip.OverridePrim("/Hero/Skirt")
    over.CreateAttribute(f"ssilk:posed:{proxy.rpartition('/')[2]}", Sdf.ValueTypeNames.Float).Set(1.0)
    clip.Save()
    assert np.abs(binds[1] - binds[0])[:3, 3].max() > 0.02
    rollout = load_rollout(request)
    held = [rollout, with_model(rollout, load_garment(request).file)]  # a budget tries smaller models
    for parts in (each.direction.parts for each in held):
        hand = parts.hand[:, number - scenes[0].character.skeleton.joint_count, :3, 3]
        np.testing.assert_allclose(hand, np.tile(binds[1][:3, 3] + [0.1, -0.2, 0.3], (len(hand), 1)), atol=1e-5)


@pytest.mark.parametrize("soft", [False, True])
def test_what_rides_on_a_garment_goes_along_to_a_body_by_shapes(shapes, soft):
    """It lies in the stage as on the stage's own body: a button of 1 cm, beneath the cloth of the heavier one."""
    request = BakeRequest(model="family.safetensors", stage="shapes.usda:heavier=1", motion="clip.usda")
    own, its = (load_garment(replace(request, stage=stage)).deformer.scene.garment.mesh
                for stage in ("shapes.usda", request.stage))  # fmt: skip
    face = int(np.linalg.norm(its.points - own.points, axis=1)[own.faces].mean(axis=1).argmax())
    points, foot = disc_on(own, face, np.full(3, 1 / 3), 0.01)
    home = Usd.Stage.Open("shapes.usda")
    rider = add_rider(home, "/Hero/Button", points)
    if soft:
        rider.CreateAttribute("ssilk:rideSoft", Sdf.ValueTypeNames.Bool).Set(True)
    home.Save()
    ((mesh,),) = (each.meshes for each in load_garment(request).riders)
    there = its.points[its.faces[face]].mean(axis=0)
    assert np.linalg.norm(there - foot) > 0.02
    np.testing.assert_allclose(np.linalg.norm(mesh.points - there, axis=1).max(), 0.01, atol=4e-3)


def test_what_rides_on_a_garment_goes_along_in_simulations_of_a_body_by_shapes(shapes, capsys):
    """The copy that `rig --onto` writes has it where the stage has, which is told."""
    own = load_model("model.safetensors").scene.garment.mesh
    face = int(np.linalg.norm(own.points[own.faces].mean(axis=1) - own.points.mean(axis=0), axis=1).argmax())
    points, foot = disc_on(own, face, np.full(3, 1 / 3), 0.01)
    home = Usd.Stage.Open("shapes.usda")
    add_rider(home, "/Hero/Button", points)
    home.Save()
    assert run("rig shapes.usda --onto heavier=1 -o heavy.usda") == 0
    assert "heavy.usda: /Hero/Button lies as on the stage's own body" in capsys.readouterr().err
    simulate = "simulate shapes.usda:heavier=1 --garment heavy.usda --motion clip.usda --range 0-0 -o simulated.usda"
    assert run(simulate) == 0
    there = shown("simulated.usda", 0)
    button, cloth = there["Button"].mean(axis=0), there["Skirt"][own.faces[face]].mean(axis=0)
    assert np.linalg.norm(button - cloth) < 0.01 and np.linalg.norm(cloth - foot) > 0.02


def test_a_job_has_bodies_by_shapes_under_their_names(shapes, capsys):
    bodies = "--stage shapes.usda --stage shapes.usda:heavier=1 --stage shapes.usda:heavier=0.5,taller=0.2"
    assert run(f"farm family.safetensors --motion clip.usda {bodies} --bundle job") == 0
    files = json.loads(Path("job/asset_references.json").read_text())["assetReferences"]["inputs"]["filenames"]
    assert sorted(Path(file).name for file in files) == ["clip.usda", "family.safetensors", "shapes.usda"]
    assert run("task job/job.json -o shots") == 0 and run("task job/job.json -o shots --check") == 0
    names = {f"{body}_clip" for body in ("shapes", "heavier", "heavier0_5_taller0_2")}
    assert {path.parent.name for path in Path("shots/shots").glob("*/shot.usda")} == names
    bake = "bake family.safetensors --motion clip.usda -o shots/ --body-name heavier --stage shapes.usda:heavier"
    capsys.readouterr()
    assert run(f"{bake}=1.0 --json") == 0
    results = [json.loads(line)["detail"] for line in capsys.readouterr().out.splitlines() if '"result"' in line]
    assert results and all(detail.get("current") for detail in results), results
    assert run(f"{bake}=0.9") == 2 and "was baked on another body" in capsys.readouterr().err


def test_a_body_that_shapes_cannot_make_is_told_at_submission(shapes, capsys):
    farm = "farm family.safetensors --motion clip.usda --bundle job --stage shapes.usda:heavier=2"
    told = "shape 'heavier' weighs 2; 0 to 1 is allowed"
    assert run(f"{farm} --stage shapes.usda") == 0
    assert told in capsys.readouterr().err
    assert run(farm) == 2
    assert told in capsys.readouterr().err


def test_a_model_of_one_body_is_told_of_shapes_that_leave_joints_in_place(shapes, capsys):
    bake = "bake model.safetensors --motion clip.usda --range 0-2 -o out.usda --stage shapes.usda"
    told = "its shapes leave the joints in place, and the model was trained without them"
    assert run(f"{bake}:slight=1") == 0 and told in capsys.readouterr().err
    assert run(bake) == 0 and "its shapes" not in capsys.readouterr().err
    assert run(f"{bake}:taller=1") == 2 and "on both bodies with --family" in capsys.readouterr().err


def test_an_evaluation_has_bodies_by_shapes_under_their_names(shapes):
    (shapes / "clips").mkdir()
    shutil.copy("clip.usda", "clips")
    bodies = "--stage shapes.usda:heavier=1 --stage shapes.usda:heavier=0.5,taller=0.2"
    assert run(f"evaluate family.safetensors {bodies} --motions clips --no-probes -o by_shapes.json") == 0
    text = Path("by_shapes.json").read_text()
    assert '"heavier/Skirt' in text and '"heavier0.5_taller0.2/Skirt' in text


def test_a_list_keeps_shapes_and_finds_the_files_of_bodies(shapes):
    Path("lists").mkdir()
    table = 'stage = "../shapes.usda"\nmotions = "../clip.usda"\n'
    listed = {"named": '["taller=1", "../heavier.usda", "../shapes.usda:heavier=0.5"]', "marked": "true"}
    tables = [f"[{name}]\n{table}family = {family}\n" for name, family in listed.items()]
    Path("lists/list.toml").write_text("\n".join(tables))
    named, marked = read_list(Path("lists/list.toml"))
    assert named.words[-4:] == ("--family", "taller=1", "../heavier.usda", "../shapes.usda:heavier=0.5")
    assert marked.words[-1] == "--family" and marked.located(Path("lists"))["family"] is True
    family = named.located(Path("lists"))["family"]
    assert family == ["taller=1", "lists/../heavier.usda", "lists/../shapes.usda:heavier=0.5"]
    assert run("inspect lists/list.toml") == 0


def test_marks_that_nobody_uses_change_no_byte(shapes):
    bake = "bake family.safetensors --motion clip.usda -o"
    assert run(f"{bake} marked.usda --stage shapes.usda") == 0
    written = Path("marked.usda").read_bytes()
    stage = Usd.Stage.Open("shapes.usda")
    stage.GetPrimAtPath("/Hero/Body/Slight").RemoveProperty("ssilk:weightRange")
    stage.Save()
    assert run(f"{bake} marked.usda --stage shapes.usda") == 0
    assert Path("marked.usda").read_bytes() == written
