# SPDX-License-Identifier: Apache-2.0
"""A garment on a character with another skeleton, as users meet it: a map is proposed, edited, used, and refused."""

import json
import shlex
import shutil
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from scipy.spatial.transform import Rotation

from ssilk_core.cli import main
from ssilk_core.network.checkpoint import load_model
from ssilk_core.physics.energy import GarmentEnergy

JOINTS = ("root_x", "root_x/spine_01", "root_x/spine_01/skull")
NAMES = {"Hips": "root_x", "Spine": "spine_01", "Head": "skull"}
BAKE = "bake model.safetensors --motion clip.usda"


def run(command: str, *more: str) -> int:
    return main([*shlex.split(command), *more])


def rows(rotations: np.ndarray, places: np.ndarray) -> list[Gf.Matrix4d]:
    """USD matrices of rotations (N, 3, 3) and places (N, 3)."""
    found = np.tile(np.eye(4), (len(places), 1, 1))
    found[:, :3, :3], found[:, 3, :3] = np.swapaxes(rotations, -1, -2), places
    return [Gf.Matrix4d(matrix.tolist()) for matrix in found]


def write_other(path: Path, size: float = 1.0) -> np.ndarray:
    """The hero's body under other joint names, with axes of their own and points in another order.

    Returns:
        The joints' rotations in the bind pose, shape (3, 3, 3).
    """
    stage = Usd.Stage.Open(Usd.Stage.Open("hero.usda").Flatten())
    stage.RemovePrim("/Hero/Skirt")
    axes = Rotation.random(3, random_state=2).as_matrix()
    rig = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    places = np.array([np.array(matrix)[3, :3] for matrix in rig.GetBindTransformsAttr().Get()]) * size
    rig.GetJointsAttr().Set(JOINTS)
    rig.GetBindTransformsAttr().Set(rows(axes, places))
    local = [axes[0], *(before.T @ after for before, after in pairwise(axes))]
    steps = [places[0], *(axis.T @ (b - a) for axis, a, b in zip(axes, places, places[1:]))]
    rig.CreateRestTransformsAttr(rows(np.array(local), np.array(steps)))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body"))
    points = np.array(mesh.GetPointsAttr().Get(), dtype=float)
    order = np.random.default_rng(5).permutation(len(points))
    place = np.argsort(order)
    moved = (points[order] * size).astype(np.float32)
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(moved))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(place[faces].astype(np.int32)))
    indices = UsdSkel.BindingAPI(mesh.GetPrim()).GetJointIndicesPrimvar()
    indices.Set(Vt.IntArray.FromNumpy(np.array(indices.Get())[order].astype(np.int32)))
    stage.GetRootLayer().Export(str(path))
    return axes


def write_clip(path: Path, axes: np.ndarray) -> None:
    """The toy's clip as the other character moves it: joints turn alike in the world since the bind pose."""
    stage = Usd.Stage.Open(Usd.Stage.Open("clip.usda").Flatten())
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Clip"))
    animation.GetJointsAttr().Set(JOINTS)
    for time in animation.GetRotationsAttr().GetTimeSamples():
        turns = [Gf.Matrix3d(Gf.Quatd(each)) for each in animation.GetRotationsAttr().Get(time)]
        world, found = np.eye(3), []
        moved = [np.array(each, dtype=float) for each in animation.GetTranslationsAttr().Get(time)]
        above, at = np.eye(3), list[np.ndarray]()
        for joint, (own, step) in enumerate(zip(turns, moved)):
            at.append(above.T @ (world @ step) if joint else step)
            world = world @ np.array(own).T
            its = world @ axes[joint]
            found.append(above.T @ its)
            above = its
        quaternions = Rotation.from_matrix(np.array(found)).as_quat()
        animation.GetRotationsAttr().Set([Gf.Quatf(float(q[3]), *map(float, q[:3])) for q in quaternions], time)
        animation.GetTranslationsAttr().Set([Gf.Vec3f(*map(float, each)) for each in at], time)
    stage.GetRootLayer().Export(str(path))


@pytest.fixture
def world(toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The toy with other.usda and other_clip.usda, the current folder."""
    shutil.copytree(toy.folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "other_clip.usda", write_other(tmp_path / "other.usda"))
    return tmp_path


def put_on(stage: str = "other.usda", out: str = "other_skirt.usda") -> None:
    assert run(f"inspect rigged.usda --onto {stage} --joints map.toml") == 0
    assert run(f"rig rigged.usda --onto {stage} --joints map.toml -o {out}") == 0


def shown(path: str, frame: float) -> dict[str, np.ndarray]:
    """Points (V, 3) in the world in a frame of a shot, as UsdSkel deforms meshes."""
    stage, found = Usd.Stage.Open(path), {}
    assert UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            to_world = np.array(UsdGeom.Mesh(prim).ComputeLocalToWorldTransform(frame))
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(frame))
            found[prim.GetName()] = points @ to_world[:3, :3] + to_world[3, :3]
    return found


def stretch_in(page: str) -> float:
    """The mean of the energy of stretch on a page."""
    row = Path(page).read_text().partition("<td>stretch [J]</td>")[2]
    return float(row.partition(">")[2].partition("<")[0])


def test_a_map_is_proposed_to_be_edited_and_an_edited_one_is_kept_and_checked(world, capsys):
    assert run("inspect rigged.usda --onto other.usda --joints map.toml") == 0
    assert tomllib.loads(Path("map.toml").read_text())["joints"] == NAMES
    edited = Path("map.toml").read_text().replace('"skull"', '""')
    Path("map.toml").write_text(edited)
    capsys.readouterr()
    assert run("inspect rigged.usda --onto other.usda --joints map.toml --json") == 0
    findings = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]["findings"]
    found = {each["code"]: each["found"] for each in findings}
    assert "stand for 2 of 3; none stands for Head" in found["joint-map"]
    assert Path("map.toml").read_text() == edited
    Path("map.toml").write_text(edited.replace('"spine_01"', '"root_x"'))
    assert run("inspect rigged.usda --onto other.usda --joints map.toml") == 2
    assert "'root_x' stands for both 'Hips' and 'Spine'" in capsys.readouterr().out


def test_the_cloth_moves_on_the_other_joints_as_on_its_own(world):
    put_on()
    assert run(f"{BAKE} --stage rigged.usda -o own.usda") == 0
    assert run("bake model.safetensors --stage other_skirt.usda --motion other_clip.usda -o shot_other.usda") == 0
    for frame in (0, 7, 39):
        own, its = shown("own.usda", frame), shown("shot_other.usda", frame)
        np.testing.assert_allclose(np.sort(its["Body"][:, 1]), np.sort(own["Body"][:, 1]), atol=1e-4)
        np.testing.assert_allclose(its["Skirt"], own["Skirt"], atol=2e-4)
    stage = Usd.Stage.Open("shot_other.usda")
    (skeleton,) = [UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton)]
    joints = [str(joint) for joint in skeleton.GetJointsAttr().Get()]
    assert joints[:3] == list(JOINTS) and all("proxy" in joint for joint in joints[3:])
    assert run("verify shot_other.usda") == 0


def test_characters_that_name_their_joints_alike_may_be_bound_otherwise(world, toy, capsys):
    axes = write_other(world / "other.usda")
    stage = Usd.Stage.Open("other.usda")
    UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")).GetJointsAttr().Set(["Hips", "Hips/Spine", "Hips/Spine/Head"])
    stage.Save()
    write_clip(world / "other_clip.usda", axes)
    clip = Usd.Stage.Open("other_clip.usda")
    UsdSkel.Animation(clip.GetPrimAtPath("/Clip")).GetJointsAttr().Set(["Hips", "Hips/Spine", "Hips/Spine/Head"])
    clip.GetRootLayer().Save()
    assert run("rig rigged.usda --onto other.usda -o out.usda") == 2
    assert "the faces of " in (told := capsys.readouterr().err) and "--joints MAP.toml' proposes one" in told
    put_on()
    assert run(f"{BAKE} --stage rigged.usda -o own.usda") == 0
    assert run("bake model.safetensors --stage other_skirt.usda --motion other_clip.usda -o shot_other.usda") == 0
    np.testing.assert_allclose(shown("shot_other.usda", 7)["Skirt"], shown("own.usda", 7)["Skirt"], atol=2e-4)
    # A model that was trained there is the character's own.
    assert run("train other_skirt.usda --motions other_clip.usda -o other.safetensors", *toy.training) in (0, 5)
    capsys.readouterr()
    assert run("bake other.safetensors --stage other_skirt.usda --motion other_clip.usda -o anew.usda") == 0
    assert "stand for" not in capsys.readouterr().err


def test_what_is_refined_and_what_is_skinned_alone_is_the_other_characters(world, capsys):
    put_on()
    command = "bake model.safetensors --stage other_skirt.usda --motion other_clip.usda"
    assert run(f"{command} --lbs -o lbs.usda") == 0 and run(f"{command} --refine 1 --range 0-4 -o refined.usda") == 0
    assert run("bake model.safetensors --stage rigged.usda --motion clip.usda --lbs -o own.usda") == 0
    np.testing.assert_allclose(shown("lbs.usda", 9)["Skirt"], shown("own.usda", 9)["Skirt"], atol=2e-4)


def test_it_is_evaluated_where_it_was_put(world, capsys):
    put_on()
    Path("motions").mkdir()
    shutil.copy("other_clip.usda", "motions")
    assert run("evaluate model.safetensors --stage other_skirt.usda --motions motions --no-probes -o its.json") == 0
    shutil.copy("clip.usda", "motions/other_clip.usda")
    assert run("evaluate model.safetensors --stage rigged.usda --motions motions --no-probes -o own.json") == 0
    its, own = (
        {row["method"]: row["figures"]["total"] for row in json.loads(Path(name).read_text())["figures"]}
        for name in ("its.json", "own.json")
    )
    assert its == pytest.approx(own, rel=0.02) and its["ssilk"] != its["LBS"]


def test_it_is_trained_anew_on_the_stage_that_was_written(world, toy):
    put_on()
    code = run("train other_skirt.usda --motions other_clip.usda -o other.safetensors", *toy.training)
    assert code in (0, 5)
    assert run("bake other.safetensors --stage other_skirt.usda --motion other_clip.usda -o anew.usda") == 0


def test_without_a_map_the_verb_is_named_that_proposes_one(world, capsys):
    assert run("rig rigged.usda --onto other.usda -o out.usda") == 2
    told = capsys.readouterr().err
    assert "'ssilk inspect rigged.usda --onto other.usda --joints MAP.toml' proposes one" in told
    assert run("rig rigged.usda --joints map.toml -o out.usda") == 2
    assert "no --onto" in capsys.readouterr().err
    assert run("inspect rigged.usda --joints map.toml") == 2
    assert "no --onto" in capsys.readouterr().err
    assert run("bake model.safetensors --stage other.usda --motion other_clip.usda -o out.usda") == 2
    assert "put the garment onto its joints by 'ssilk rig --onto' with a map of joints" in capsys.readouterr().err
    assert not Path("out.usda").exists()


def test_one_of_several_characters_is_named_with_its_stage(world):
    stage = Usd.Stage.Open("other.usda")
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero", stage.GetRootLayer(), "/Twin")
    for prim in stage.GetPrimAtPath("/Twin").GetAllChildren():
        UsdSkel.BindingAPI.Apply(prim).CreateSkeletonRel().SetTargets(["/Twin/Rig"])
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/Twin")).CreateSkeletonRel().SetTargets(["/Twin/Rig"])
    stage.Save()
    assert run("inspect rigged.usda --onto other.usda --joints map.toml") == 2
    put_on("other.usda:/Twin")
    rigged = Usd.Stage.Open("other_skirt.usda")
    assert rigged.GetPrimAtPath("/Twin/Skirt") and not rigged.GetPrimAtPath("/Hero/Skirt")


def test_an_unsound_map_writes_nothing(world, capsys):
    Path("map.toml").write_text('[joints]\nHips = "spine_01"\nSpine = "root_x"\n')
    assert run("rig rigged.usda --onto other.usda --joints map.toml -o out.usda") == 2
    told = capsys.readouterr().err
    assert "'root_x' for 'Spine'" in told or "'spine_01' for 'Hips' hangs from 'root_x' for 'Spine'" in told
    assert not Path("out.usda").exists()


def test_another_garment_than_the_models_is_refused(world, capsys):
    put_on()
    stage = Usd.Stage.Open("other_skirt.usda")
    skirt = next(prim for prim in stage.Traverse() if prim.GetName() == "Skirt")
    faces = UsdGeom.Mesh(skirt).GetFaceVertexIndicesAttr()
    faces.Set(Vt.IntArray([*faces.Get()[3:], *faces.Get()[:3]]))
    stage.Save()
    assert run("bake model.safetensors --stage other_skirt.usda --motion other_clip.usda -o out.usda") == 2
    assert "one of the model's 312 points" in capsys.readouterr().err and not Path("out.usda").exists()


def test_a_larger_character_is_told(world, capsys):
    write_clip(world / "other_clip.usda", write_other(world / "other.usda", size=1.2))
    put_on()
    capsys.readouterr()
    run("bake model.safetensors --stage other_skirt.usda --motion other_clip.usda -o out.usda")
    assert "20% taller than the body of the training" in capsys.readouterr().err


def test_a_page_counts_stretch_from_the_body_of_the_training(world):
    """The cloth of a small model lies on a character that is a quarter larger: it is stretched there, at rest too."""
    write_clip(world / "large_clip.usda", write_other(world / "large.usda", 1.25))
    put_on("large.usda", "large_skirt.usda")
    assert run("bake model.safetensors --stage large_skirt.usda --motion large_clip.usda -o large_shot.usda") == 0
    assert run("report large_shot.usda -o page.html") == 0
    page = Path("page.html").read_text()
    assert "put onto another skeleton: stretch counts from its shape on the body of its training" in page
    file, found = load_model("model.safetensors"), []
    energy = GarmentEnergy(file.scene.garment.mesh, file.fabric)
    for frame in range(40):
        points = shown("large_shot.usda", frame)["Skirt"]
        found.append(float(energy.stretch(torch.tensor(points[:, :, None], dtype=torch.float32))))
    assert stretch_in("page.html") == pytest.approx(np.mean(found), rel=0.02)
