# SPDX-License-Identifier: Apache-2.0
"""`ssilk inspect` as its users run it: on files, with exit codes, as text and as JSON, and repairing."""

import json
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.cli import main
from ssilk_core.scene.assets import Motion

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason=f"{SHARED} is not here")


def define_mesh(stage: Usd.Stage, path: str, points: np.ndarray, faces: np.ndarray) -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    return mesh.GetPrim()


def write_hero(path: Path) -> Path:
    """A pillar 1.7 m high with two joints, in metres, y up."""
    side = [(0.15, height) for height in np.linspace(0, 1.7, 25)]  # long triangles are near much of the cloth
    body = trimesh.creation.revolve([(0, 0), *side, (0, 1.7)], sections=24)
    points = body.vertices[:, [0, 2, 1]] * [1, 1, -1]
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    root = UsdSkel.Root.Define(stage, "/Hero")
    rig = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    rig.CreateJointsAttr(["Hips", "Hips/Spine"])
    rig.CreateBindTransformsAttr(Vt.Matrix4dArray.FromNumpy(np.tile(np.eye(4), (2, 1, 1))))
    binding = UsdSkel.BindingAPI.Apply(root.GetPrim())
    binding.CreateSkeletonRel().SetTargets([rig.GetPath()])
    skin = UsdSkel.BindingAPI.Apply(define_mesh(stage, "/Hero/Body", points, body.faces))
    skin.CreateJointIndicesPrimvar(False, 1).Set((points[:, 1] > 0.8).astype(int).tolist())
    skin.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(points))
    stage.GetRootLayer().Save()
    return path


def tube(radius: float = 0.17, columns: int = 32, rows: int = 13) -> tuple[np.ndarray, np.ndarray]:
    """Cloth around the pillar, its normals outward."""
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(0.9, 1.4, rows)
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), y[:, None], radius * np.cos(angle)), -1).reshape(
        -1, 3
    )
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return points, np.concatenate([np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]])


def write_damaged(path: Path) -> Path:
    """The tube inside out, pressed 3 mm into the body at its lowest row, with a lone vertex and a doubled face.

    The file holds metres but states no units, so that it is read a hundred times too small.
    """
    points, faces = tube()
    points[:32, [0, 2]] *= 0.147 / 0.17
    faces = np.r_[faces, faces[:1]][:, ::-1]
    stage = Usd.Stage.CreateNew(str(path))
    prim = define_mesh(stage, "/Tube", np.r_[points, [[1, 1, 1]]], faces)
    classes = np.r_[np.where(points[:, 1] > 1.3, 1, 2), 2]
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("ssilk:class", Sdf.ValueTypeNames.IntArray, "vertex")
    primvar.Set(classes.astype(int).tolist())
    stage.GetRootLayer().Save()
    return path


def inspect(capsys: pytest.CaptureFixture, *arguments: object) -> tuple[int, dict]:
    """Exit code, and findings by code with what else the result event says."""
    code = main(["inspect", *map(str, arguments), "--preset", "draft", "--json"])
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (result,) = (event for event in events if event["event"] == "result")
    return code, {
        **result["detail"],
        "findings": {finding["code"]: finding for finding in result["detail"]["findings"]},
    }


def test_a_damaged_garment_is_repaired_and_then_passes(tmp_path, capsys):
    hero, cloth, out = (
        write_hero(tmp_path / "hero.usda"),
        write_damaged(tmp_path / "tube.usda"),
        tmp_path / "out.usdc",
    )
    code, before = inspect(capsys, hero, "--garment", cloth)
    assert code == 2
    assert {"alignment", "isolated-vertices", "duplicate-faces", "units"} <= set(before["findings"])
    assert before["findings"]["isolated-vertices"]["indices"] == [416]
    assert all(finding["fixable"] for finding in before["findings"].values() if finding["severity"] != "info")
    code, fixed = inspect(capsys, hero, "--garment", cloth, "--fix", out)
    assert fixed["fixed"] == {"output": str(out), "repaired": [
        "metersPerUnit 1 and upAxis Y stated", "1 isolated vertex removed", "1 face removed", "768 faces flipped",
        "moved 96 vertices, by 4.2 mm on average and 8.3 mm at most",
    ]}  # fmt: skip
    assert code == 0 and all(finding["severity"] == "info" for finding in fixed["findings"].values())
    code, again = inspect(capsys, hero, "--garment", out)
    for found in (fixed["findings"], again["findings"]):
        del found["memory"]  # it tells what is free at the moment
    assert code == 0 and again == {"findings": fixed["findings"]}
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["hero.usda", "out.usdc", "tube.usda"]


def test_a_repair_that_fails_halfway_leaves_the_older_copy(tmp_path, capsys):
    """The garment has an odd primvar, which only the second half of the repair meets."""
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")
    stage = Usd.Stage.Open(str(cloth))
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Tube"))
    primvars.CreatePrimvar("dye", Sdf.ValueTypeNames.FloatArray, "vertex").Set([1.0, 2.0])
    stage.GetRootLayer().Save()
    out = tmp_path / "out.usda"
    out.write_text("older")
    assert main(["inspect", str(hero), "--garment", str(cloth), "--fix", str(out)]) == 2
    assert "dye" in capsys.readouterr().err
    assert out.read_text() == "older" and len(list(tmp_path.iterdir())) == 3


def test_findings_are_printed_for_people(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")
    assert main(["inspect", str(hero), "--garment", f"{cloth}:/Tube"]) == 2
    text = capsys.readouterr().out
    assert "ERROR  isolated-vertices  (--fix repairs it)" in text and "fix: delete loose geometry" in text
    assert text.index("ERROR") < text.index("WARNING") < text.index("INFO")


def test_a_garment_in_the_stage_of_its_character_is_repaired_there(tmp_path, capsys):
    hero = write_hero(tmp_path / "hero.usda")
    stage = Usd.Stage.Open(str(hero))
    points, faces = tube()
    define_mesh(stage, "/Hero/Tube", np.r_[points, [[0, 1, 1]]], faces)
    stage.GetRootLayer().Save()
    out = tmp_path / "out.usda"
    code, fixed = inspect(capsys, hero, "--garment", "Tube", "--fix", out)
    assert code == 0 and fixed["fixed"]["repaired"] == ["1 isolated vertex removed"]
    written = Usd.Stage.Open(str(out))
    assert written.GetPrimAtPath("/Hero/Body") and written.GetPrimAtPath("/Hero/Rig")
    assert len(UsdGeom.Mesh(written.GetPrimAtPath("/Hero/Tube")).GetPointsAttr().Get()) == len(points)


def test_what_cannot_be_read_or_written_is_one_sentence(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")
    assert main(["inspect", str(tmp_path / "nobody.usda")]) == 2
    assert "there is no such file" in capsys.readouterr().err
    before = cloth.read_bytes()
    assert main(["inspect", str(hero), "--garment", str(cloth), "--fix", str(cloth)]) == 2
    assert "--fix writes a copy" in capsys.readouterr().err and cloth.read_bytes() == before


@needs_shared
@pytest.mark.parametrize("garment", ["tshirt", "long_sleeve", "pants"])
def test_clean_garments_raise_no_alarm(garment, capsys):
    code, found = inspect(capsys, SHARED / "character.usdc", "--garment", SHARED / "garments" / f"{garment}.usdc")
    assert code == 0 and all(finding["severity"] == "info" for finding in found["findings"].values())


def write_clip(path: Path, roots: np.ndarray) -> Path:
    """The pillar swaying from its root, which moves along `roots` (F,) [m]; its spine is still."""
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.writing.files import write_motion

    skeleton = read_character(write_hero(path.with_name(f"{path.stem}_hero.usda"))).skeleton
    half = 0.05 * np.sin(np.arange(len(roots)) / 5)
    rotations = np.zeros((len(roots), 2, 4))
    rotations[..., 0] = 1
    rotations[:, 0] = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    translations = np.zeros((len(roots), 2, 3))
    translations[:, 0, 0] = roots
    write_motion(path, Motion("/Animation", 30.0, rotations, translations), skeleton)
    return path


def test_jumping_roots_and_still_joints_are_found(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), tmp_path / "cloth.usda"
    stage = Usd.Stage.CreateNew(str(cloth))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    define_mesh(stage, "/Cloth", *tube())
    stage.GetRootLayer().Save()
    walked = np.linspace(0, 1, 40)
    clips = [
        write_clip(tmp_path / "walks.usda", walked),
        write_clip(tmp_path / "jumps.usda", walked + 3.0 * (np.arange(40) >= 20)),
    ]
    code, found = inspect(capsys, hero, "--garment", cloth, "--motion", *clips)
    assert code == 0
    assert found["findings"]["root-jumps"]["prim"].endswith("jumps.usda:/Animation")
    assert "Spine" in found["findings"]["still-joints"]["found"]


def write_lying_in_an_xform(path: Path) -> Path:
    """The pillar with z up in the space of its skeleton, stood up by an Xform."""
    stage = Usd.Stage.Open(str(write_hero(path)))
    over = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), 90))
    UsdGeom.Xformable(stage.GetPrimAtPath("/Hero")).AddRotateXOp().Set(-90.0)
    UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")).GetBindTransformsAttr().Set([over] * 2)
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr()
    points.Set([Gf.Vec3f(over.Transform(Gf.Vec3d(point))) for point in points.Get()])
    stage.Save()
    return path


def write_pose(path: Path, lean: float, *, meters: float = 1.0, up: str | None = "Y") -> Path:
    """A clip alone in which the hips lean back by so many degrees."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    if up:
        UsdGeom.SetStageUpAxis(stage, up)
    animation = UsdSkel.Animation.Define(stage, "/Clip")
    animation.CreateJointsAttr(["Hips", "Hips/Spine"])
    turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0, 0), lean).GetQuat())
    for frame in range(30):
        animation.CreateRotationsAttr().Set([turn, Gf.Quatf(1)], frame)
        animation.CreateTranslationsAttr().Set([Gf.Vec3f(0)] * 2, frame)
    stage.Save()
    return path


def test_a_clip_whose_axis_posture_alone_tells_is_named(tmp_path, capsys):
    """A character whose axis stands in an Xform, and a clip of the same unit: it may lie, and be read as standing."""
    hero, cloth = write_lying_in_an_xform(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")

    def told(clip: Path) -> dict | None:
        return inspect(capsys, hero, "--garment", cloth, "--motion", clip)[1]["findings"].get("axis-by-posture")

    by_file, by_xforms = told(write_pose(tmp_path / "a.usda", 0)), told(write_pose(tmp_path / "b.usda", 80))
    assert by_file and by_file["severity"] == "warning" and by_file["prim"].endswith("a.usda:/Clip")
    assert "in the axes of its file, by which the character leans by 0 degrees on average" in by_file["found"]
    assert "or in those of the character's Xforms, by which it leans by 90" in by_file["found"]
    assert by_xforms and by_xforms["severity"] == "info"
    assert "the axes of the character's Xforms, by which the character leans by 10" in by_xforms["found"]
    assert not told(write_pose(tmp_path / "c.usda", 0, up=None))  # nothing but the Xforms says an axis
    assert not told(write_pose(tmp_path / "d.usda", 90, up="Z"))  # both say the same one


def test_what_is_wrong_with_one_motion_does_not_hide_the_rest(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")
    good = write_clip(tmp_path / "walk.usda", np.zeros(40))
    other = tmp_path / "other.usda"
    other.write_text(good.read_text().replace("Hips", "Pelvis").replace("Spine", "Chest"))
    code, found = inspect(capsys, hero, "--garment", cloth, "--motion", other, good)
    told = found["findings"]["motion-unread"]
    assert code == 2 and told["severity"] == "error" and "another skeleton" in told["found"]
    assert "isolated-vertices" in found["findings"] and "still-joints" in found["findings"]
    assert main(["inspect", str(hero), "--garment", str(cloth), "--motion", str(tmp_path / "nowhere/")]) == 2
    assert "no such file or folder; motions are USD files or folders of them" in capsys.readouterr().err


def test_files_in_the_wrong_order_are_told_by_what_they_are(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_damaged(tmp_path / "tube.usda")
    assert main(["inspect", str(cloth), "--garment", str(hero)]) == 2
    assert "stage and garment may have been swapped" in capsys.readouterr().err
    model = tmp_path / "cape.safetensors"
    model.write_bytes(b"\0")
    words = ["bake", str(hero), "--stage", str(model), "--motion", str(cloth), "-o", str(tmp_path / "o.usda")]
    assert main(words) == 2
    assert "hero.usda: this is a USD stage; a model is a .safetensors file" in capsys.readouterr().err
    assert main(["inspect", str(model)]) == 2 and "this is a trained model" in capsys.readouterr().err


def write_textured(path: Path, radius: float) -> Path:
    """The tube pressed 3 mm into the body at its waist, in metres, with texture coordinates."""
    points, faces = tube(columns=24, rows=9)
    points[:24, [0, 2]] *= radius / 0.17
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    prim = define_mesh(stage, "/Tube", points, faces)
    uvs = np.random.default_rng(0).random((faces.size, 2)).astype(np.float32)
    primvars = UsdGeom.PrimvarsAPI(prim)
    primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying").Set(Vt.Vec2fArray.FromNumpy(uvs))
    stage.GetRootLayer().Save()
    return path


def attributes(path: Path, prim: str = "/Tube") -> dict[str, object]:
    stage = Usd.Stage.Open(str(path))  # prims live only as long as their stage
    found = stage.GetPrimAtPath(prim).GetAttributes()
    return {each.GetName(): each.Get() for each in found if each.HasAuthoredValue()}


def test_only_points_change_where_a_garment_is_settled(tmp_path, capsys):
    hero, cloth = write_hero(tmp_path / "hero.usda"), write_textured(tmp_path / "tube.usda", 0.147)
    out = tmp_path / "out.usdc"
    code, fixed = inspect(capsys, hero, "--garment", cloth, "--fix", out)
    before, after = attributes(cloth), attributes(out)
    assert code == 0 and before.pop("points") != after.pop("points") and before == after
    (said,) = fixed["fixed"]["repaired"]
    assert said.startswith("moved ") and "penetration" not in fixed["findings"]


def test_rig_settles_what_is_inside_and_nothing_else(tmp_path, capsys):
    hero = write_hero(tmp_path / "hero.usda")
    for name, radius, more, settles in (
        ("inside", 0.147, (), True), ("kept", 0.147, ("--keep-shape",), False), ("clear", 0.152, (), False),
    ):  # fmt: skip
        cloth, out = write_textured(tmp_path / f"{name}.usda", radius), tmp_path / f"{name}.usdc"
        assert main(["rig", str(hero), "--garment", str(cloth), "-o", str(out), "--proxies", "2", *more]) == 0
        told, made = capsys.readouterr(), attributes(out, "/Hero/Tube")
        own = attributes(cloth)
        moved = np.linalg.norm(np.array(made["points"]) - np.array(own["points"]), axis=1).max()
        assert (moved > 5e-3) == settles == ("moves" in told.out + told.err) and (settles or moved < 1e-6)
        assert np.array_equal(np.array(made["primvars:st"]), np.array(own["primvars:st"]))


@pytest.mark.parametrize("whole", [True, False])
def test_many_files_are_read_in_one_process_first(tmp_path, capsys, monkeypatch, whole):
    from ssilk_usd.opening import trial

    clips = [write_clip(tmp_path / f"{number}.usdc", np.zeros(30)) for number in range(3)]
    arguments = write_hero(tmp_path / "hero.usdc"), "--garment", write_damaged(tmp_path / "tube.usdc")
    wanted, asked, ending = inspect(capsys, *arguments, "--motion", *clips), [], trial.ending

    def noted(read, *given, **options):
        asked.append(read.__name__)
        return "it ends" if read.__name__ == "_read_inputs" and not whole else ending(read, *given, **options)

    monkeypatch.setattr(trial, "_within", ContextVar("_within", default=False))  # as for users (`read_at_once`)
    monkeypatch.setattr(trial, "ending", noted)
    assert inspect(capsys, *arguments, "--motion", *clips) == wanted
    assert asked == ["_read_inputs"] if whole else asked.count("read_motion") == len(clips)
