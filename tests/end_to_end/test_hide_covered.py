# SPDX-License-Identifier: Apache-2.0
"""Covered skin that a shot hides: in one file and in layers, for every target, and shown again."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.shots.play import Shot
from ssilk_usd.writing.body_faces import BODY, COVERED_HIDDEN, FULL, open_with_full_bodies

from ssilk_core.cli import main
from ssilk_core.delivery.farm.job import read_job
from ssilk_core.delivery.gltf.play import GlbShot
from ssilk_core.delivery.targets import GLB, TARGETS

BAKE = "bake skirt.safetensors --stage rigged.usda --motion walk.usda --hide-covered"
MINE = f"""#usda 1.0
( subLayers = [@layers/shots/walk/shot.usda@] )
over "Shot"
{{
    over "skirt" ( variants = {{ string {BODY} = "{FULL}" }} )
    {{
    }}
}}
"""
LOW, HIGH = 0.9, 1.3  # of the skirt where it is within reach of the pillar; its upper border


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """The toy world, with a clip of 6 frames, and a pillar whose texture coordinates tell its corners apart."""
    folder = toy.copy(tmp_path_factory.mktemp("hidden"))
    shutil.move(folder / "model.safetensors", folder / "skirt.safetensors")
    toy.write_clip(folder / "walk.usda", frames=6)
    stage = Usd.Stage.Open(str(folder / "rigged.usda"))
    author_pillar(stage.GetPrimAtPath("/Hero/Body"))
    stage.Save()
    return folder


def author_pillar(prim: Usd.Prim, columns: int = 24, rows: int = 60) -> None:
    """Author a pillar of smaller triangles."""
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(0, 1.7, rows)[:, None]
    points = np.stack(np.broadcast_arrays(0.15 * np.sin(angle), y, 0.15 * np.cos(angle)), -1).reshape(-1, 3)
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    corners = np.concatenate([np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]]).reshape(-1)
    mesh, skin = UsdGeom.Mesh(prim), UsdSkel.BindingAPI(prim)
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray(len(corners) // 3, 3))
    mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(corners.astype(np.int32)))
    skin.CreateJointIndicesPrimvar(False, 1).Set(np.digitize(points[:, 1], [1.2, 1.5]).tolist())
    skin.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(points))
    coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.stack([corners, -corners], axis=1).astype(np.float32)))


def bake(words: str) -> int:
    return main(shlex.split(f"{BAKE} {words}"))


def body_of(stage: Usd.Stage) -> Usd.Prim:
    return next(prim for prim in stage.Traverse() if prim.GetName() == "Body")


def faces(stage: Usd.Stage) -> np.ndarray:
    """Return the body's triangles, whose texture coordinates still belong to their corners."""
    prim = body_of(stage)
    mesh = UsdGeom.Mesh(prim)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    coordinates = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
    assert np.array_equal(coordinates, np.stack([corners, -corners], axis=1))
    return corners.reshape(-1, 3)


def need_hidden_well_under_the_cloth(stage: Usd.Stage, whole: np.ndarray) -> None:
    """Check that the faces that a stage lacks lie under the skirt, away from its upper border."""
    left = faces(stage)
    hidden = np.array(sorted(set(map(tuple, whole)) - set(map(tuple, left))))
    assert len(left) + len(hidden) == len(whole) and len(hidden) > 50
    assert len(UsdGeom.Mesh(body_of(stage)).GetPointsAttr().Get()) == whole.max() + 1
    points = np.array(UsdGeom.Mesh(body_of(stage)).GetPointsAttr().Get()) * UsdGeom.GetStageMetersPerUnit(stage)
    heights = points[hidden][..., "XYZ".index(UsdGeom.GetStageUpAxis(stage))]
    assert heights.min() > LOW and heights.max() <= HIGH - 0.03


def whole_body() -> np.ndarray:
    return faces_in("rigged.usda")


def faces_in(path: str) -> np.ndarray:
    stage = Usd.Stage.Open(path)
    return faces(stage)


STAGES = [name for name, target in TARGETS.items() if GLB not in target.suffixes]


@pytest.mark.parametrize("name", STAGES)
def test_one_file_hides_covered_faces_and_shows_them_again_where_its_reader_takes_variants(copy, name):
    output = f"new{TARGETS[name].suffixes[0]}"
    assert bake(f"--target {name} -o {output}") == 0
    assert main(["verify", output]) == 0
    stage = Usd.Stage.Open(output)
    need_hidden_well_under_the_cloth(stage, whole_body())
    variants = stage.GetDefaultPrim().GetVariantSet(BODY)
    if not TARGETS[name].variants:
        assert not variants.GetVariantNames()  # the faces are plainly not there, for readers that compose nothing
        return
    assert variants.GetVariantNames() == [COVERED_HIDDEN, FULL] and variants.GetVariantSelection() == COVERED_HIDDEN
    variants.SetVariantSelection(FULL)
    assert np.array_equal(faces(stage), whole_body())


def test_a_glb_lacks_the_faces_that_a_stage_hides(copy):
    assert bake("--target glb -o new.glb") == 0 and bake("--target game8 -o new.usdc --no-verify") == 0
    counts = [{mesh.name: len(mesh.faces) for mesh in shot.meshes} for shot in (GlbShot("new.glb"), Shot("new.usdc"))]
    assert counts[0] == counts[1] and counts[0]["Body"] < len(whole_body())


def test_layers_hide_covered_faces_of_a_shot_and_leave_the_asset_whole(copy):
    assert bake("--points -o layers") == 0
    path = "layers/shots/walk/skirt/anim.usdc"
    assert main(["verify", path]) == 0
    for shot in (path, "layers/shots/walk/shot.usda"):
        stage, full = Usd.Stage.Open(shot), open_with_full_bodies(shot)
        need_hidden_well_under_the_cloth(stage, whole_body())
        assert np.array_equal(faces(full), whole_body())
    assert np.array_equal(faces_in("layers/assets/skirt/asset.usda"), whole_body())
    Path("mine.usda").write_text(MINE)
    assert np.array_equal(faces_in("mine.usda"), whole_body())
    assert len(Shot(path).meshes) == 2


def test_refined_points_and_the_network_hide_alike(copy):
    assert bake("--refine 1 -o points.usdc") == 0
    stage = Usd.Stage.Open("points.usdc")
    need_hidden_well_under_the_cloth(stage, whole_body())


def test_a_body_that_is_hidden_altogether_is_not_there(copy):
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.units import StageUnits
    from ssilk_usd.writing.author import define_mesh
    from ssilk_usd.writing.body_faces import HiddenPolygons, hide_polygons

    (body,) = read_character("rigged.usda", garment=None).bodies
    for variants in (False, True):
        stage = Usd.Stage.CreateInMemory()
        root = UsdGeom.Xform.Define(stage, "/Root").GetPath()
        path = define_mesh(stage, root.AppendChild("Body"), body.mesh, StageUnits(1.0, "Y")).GetPath()
        hidden = HiddenPolygons((np.ones(len(body.mesh.polygon_counts), dtype=bool),), variants)
        hide_polygons(stage, root, [path], [body.mesh], hidden)
        assert not stage.GetPrimAtPath(path).IsActive()
    stage.GetPrimAtPath(root).GetVariantSet(BODY).SetVariantSelection(FULL)
    assert np.array_equal(faces(stage), whole_body())


def test_cloth_that_covers_nothing_hides_nothing_and_no_body_is_refused(copy, capsys):
    stage = Usd.Stage.Open("rigged.usda")
    points = np.array(UsdGeom.Mesh(body_of(stage)).GetPointsAttr().Get()) * [0.3, 1, 0.3]
    UsdGeom.Mesh(body_of(stage)).GetPointsAttr().Set(points)
    stage.Save()
    capsys.readouterr()
    assert bake("-o new.usdc --json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert any("none is hidden" in event.get("text", "") for event in events)
    assert events[-1]["detail"]["hidden faces of the body"] == 0
    assert not Usd.Stage.Open("new.usdc").GetDefaultPrim().GetVariantSets().GetNames()
    for output in ("none.usdc", "none"):
        assert bake(f"--no-body -o {output}") == 2 and not Path(output).exists()
        assert "--hide-covered: no body in the shot" in capsys.readouterr().err


def test_farms_take_the_option_along(copy):
    words = BAKE.replace("bake ", "farm ", 1)
    assert main(shlex.split(f"{words} --bundle bundle")) == 0
    assert [task.request.hide_covered for task in read_job("bundle/job.json").tasks] == [True]


def test_the_body_of_a_shot_hides_what_any_of_its_garments_covers(toy, copy):
    """The body comes with the garment that is first by name; a collar above it covers skin that the skirt leaves."""
    assert bake("-o layers") == 0
    stage = Usd.Stage.Open("rigged.usda")
    cloth = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Skirt")).GetPointsAttr()
    cloth.Set(Vt.Vec3fArray([Gf.Vec3f(x, 0.5 + y, z) for x, y, z in cloth.Get()]))
    stage.Export("high.usda")
    moved = shlex.split("rig high.usda --garment /Hero/Skirt -o high_rigged.usda")
    assert main(moved) == 0
    train = shlex.split("train high_rigged.usda --motions clip.usda -o zhigh.safetensors")
    assert main([*train, *toy.training]) in (0, 5)
    other = BAKE.replace("skirt.safetensors", "zhigh.safetensors")
    assert main(shlex.split(f"{other} -o layers")) == 0
    shot = Usd.Stage.Open("layers/shots/walk/shot.usda")
    whole = set(map(tuple, whole_body()))
    hidden = [
        whole - set(map(tuple, faces_in(f"layers/shots/walk/{garment}/anim.usdc"))) for garment in ("skirt", "zhigh")
    ]
    assert hidden[0] and hidden[1] and hidden[1] - hidden[0]
    assert whole - set(map(tuple, faces(shot))) == hidden[0] | hidden[1]
    assert np.array_equal(faces(open_with_full_bodies("layers/shots/walk/shot.usda")), whole_body())
