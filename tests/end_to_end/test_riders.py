# SPDX-License-Identifier: Apache-2.0
"""What rides on a garment, in every target: measured in the files, as UsdSkel and glTF skin them."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.shots.play import Shot
from ssilk_usd.shots.read import read_baked
from ssilk_usd.stages import demo_body_path
from ssilk_usd.writing.files import write_motion

from ssilk_core.cli import main
from ssilk_core.delivery.gltf.play import GlbShot
from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.scene.assets import LOOSE, Mesh

ALLOWED = 1e-3  # [m] of a rider from its cloth
ROUNDED = 2e-5  # [m] where nothing but float32 rounds
DISC = np.array([[np.cos(a), np.sin(a), height] for height in (0.1, 0.4) for a in np.arange(10) * np.pi / 5])
FRAMES = 12


def run(words: str) -> int:
    return main(shlex.split(words))


def add_rider(
    stage: Usd.Stage, path: str, points: np.ndarray, target: str = "/Hero/Skirt", vertices: tuple[int, ...] = ()
) -> Usd.Prim:
    """Define a mesh that rides on a garment, as an artist would: by a relationship."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    ring = np.arange(10)
    faces = np.concatenate([np.c_[ring, np.roll(ring, -1), ring + 10], [[10, 12, 14], [0, 4, 2]]])
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
    mesh.GetPrim().CreateRelationship("ssilk:ridesOn").SetTargets([target])
    if vertices:
        mesh.GetPrim().CreateAttribute("ssilk:rideVertices", Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray(vertices))
    return mesh.GetPrim()


def disc_on(mesh: Mesh, face: int, shares: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a disc that lies on a face around a point of it, and the point."""
    corners = mesh.points[mesh.faces[face]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    x = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    foot = shares @ corners
    return foot + radius * DISC @ np.stack([x, np.cross(normal, x), normal]), foot


def skirt_of(name: str = "model.safetensors") -> Mesh:
    return load_model(name).scene.garment.mesh


def lively(path: str) -> None:
    """Let a model move its cloth far from linear blend skinning, by joints and by shapes."""
    file, rng = load_model(path), np.random.default_rng(1)
    own = {name: value.copy() for name, value in file.parameters.items()}
    own["output.2.weight"] *= 20
    own["output.2.bias"] += rng.normal(scale=0.3, size=own["output.2.bias"].shape).astype(np.float32)
    save_model(path, replace(file, parameters=own))


FACES = (30, 301, 444)  # of the skirt, beneath the riders
SHARES = np.array([[0.5, 0.3, 0.2], [1 / 3, 1 / 3, 1 / 3], [0.8, 0.1, 0.1]])


@pytest.fixture
def hero(toy, tmp_path, monkeypatch):
    """A folder with the toy and worn.usda: its stage with two buttons and a brooch on three vertices."""
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "clip.usda", frames=FRAMES)
    mesh = skirt_of()
    stage = Usd.Stage.CreateNew("worn.usda")
    stage.GetRootLayer().subLayerPaths.append("rigged.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    for number, (face, shares) in enumerate(zip(FACES, SHARES)):
        points, _ = disc_on(mesh, face, shares, 0.01)
        vertices = tuple(map(int, mesh.faces[face])) if number == 1 else ()
        add_rider(stage, f"/Hero/Button{number}", points, vertices=vertices)
    stage.GetRootLayer().Save()
    return tmp_path


def largest_off(
    cloth: np.ndarray, riders: list[np.ndarray], mesh: Mesh, rest: list[np.ndarray], faces, shares
) -> float:
    """How far riders are from the points of the cloth that they lie on [m]; each moves rigidly from its rest."""
    worst = 0.0
    for moved, own, face, share in zip(riders, rest, faces, shares, strict=True):
        away, now = own - own.mean(0), moved - moved.mean(0)
        left, _, right = np.linalg.svd(now.T @ away)
        turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        assert np.abs(now - away @ turn.T).max() < ROUNDED  # rigid
        foot = share @ mesh.points[mesh.faces[face]]
        placed = moved.mean(0) + turn @ (foot - own.mean(0))
        worst = max(worst, float(np.linalg.norm(placed - share @ cloth[mesh.faces[face]])))
    return worst


def off_in(shot: Shot | GlbShot) -> float:
    """How far the riders of a toy's shot are off, in the worst of its frames [m]."""
    mesh, worst = skirt_of(), 0.0
    rest = [disc_on(mesh, face, share, 0.01)[0] for face, share in zip(FACES, SHARES)]
    for time in shot.frame_times:
        posed = dict(zip([each.name for each in shot.meshes], shot.points(time)))
        riders = [posed[f"Button{number}"] for number in range(3)]
        worst = max(worst, largest_off(shot.garment_points(time), riders, mesh, rest, FACES, SHARES))
    return worst


def add_belt(stage: Usd.Stage) -> None:
    """Let a strip of the skirt's own triangles ride on it: two rows of vertices, moved to the middles of edges."""
    mesh = skirt_of()
    belt = UsdGeom.Mesh.Define(stage, "/Hero/Belt")
    faces = mesh.faces[BELT]
    used, corners = np.unique(faces, return_inverse=True)
    belt.CreatePointsAttr(
        Vt.Vec3fArray.FromNumpy(((mesh.points[used] + mesh.points[used + 24]) / 2).astype(np.float32))
    )
    belt.CreateFaceVertexCountsAttr([3] * len(faces))
    belt.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.ravel().astype(np.int32)))
    belt.GetPrim().CreateRelationship("ssilk:ridesOn").SetTargets(["/Hero/Skirt"])
    belt.GetPrim().CreateAttribute("ssilk:rideSoft", Sdf.ValueTypeNames.Bool).Set(True)
    stage.GetRootLayer().Save()


BELT = slice(96, 144)  # faces of the skirt
SOFT = 2e-3  # [m] of a soft rider in the toy, whose triangles are 60 mm wide


def belt_off(shot: Shot | GlbShot) -> float:
    """How far a belt is from the middles of the edges that it lies on, in the worst frame of a shot [m]."""
    used, worst = np.unique(skirt_of().faces[BELT]), 0.0
    for time in shot.frame_times:
        cloth = shot.garment_points(time)
        (belt,) = (at for at, each in zip(shot.points(time), shot.meshes) if each.name == "Belt")
        worst = max(worst, float(np.linalg.norm(belt - (cloth[used] + cloth[used + 24]) / 2, axis=1).max()))
    return worst


@pytest.mark.parametrize("target", ["usd", "blender", "game4", "glb", "glb4"])
def test_soft_riders_have_the_weights_and_shapes_of_their_cloth(hero, capsys, target):
    add_belt(Usd.Stage.Open("worn.usda"))
    lively("model.safetensors")
    name, model = "shot.glb" if "glb" in target else "shot.usdc", "model.safetensors"
    if "4" in target:
        model = "few.safetensors"
        assert run(f"reduce model.safetensors -o {model} --influences 4 --motions clip.usda") == 0
    capsys.readouterr()
    assert run(f"bake {model} --stage worn.usda --motion clip.usda --target {target} -o {name}") == 0
    told = capsys.readouterr()
    (said,) = re.findall(r"/Hero/Belt is soft, and at most (\S+) mm off its cloth", told.out + told.err)
    shot = GlbShot(name) if "glb" in target else Shot(name)
    off = belt_off(shot)
    assert off < (6e-3 if "4" in target else SOFT)  # four joints of all that move the corners of a triangle
    assert float(said) / 1000 == pytest.approx(off, rel=0.5)  # of all its points, not of those on edges alone
    first, last = (shot.garment_points(time) for time in (shot.frame_times[0], shot.frame_times[-1]))
    assert np.abs(np.ptp(last, axis=0) - np.ptp(first, axis=0)).max() > 0.01  # it moves
    assert run(f"verify {name}") == 0


def test_soft_riders_have_the_shapes_that_layers_add_and_leave_out(hero):
    add_belt(Usd.Stage.Open("worn.usda"))
    lively("model.safetensors")
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o layers --refine 2") == 0
    path = "layers/shots/clip/model/anim.usdc"
    assert belt_off(Shot(path)) < SOFT
    stage = Usd.Stage.Open(path)
    before = Shot(stage).garment_points(5)
    stage.GetDefaultPrim().GetVariantSet("quality").SetVariantSelection("skin")
    assert np.abs(Shot(stage).garment_points(5) - before).max() > 1e-3
    assert belt_off(Shot(stage)) < SOFT


def test_a_soft_rider_is_no_point_cache_and_no_three_vertices_carry_it(hero, capsys):
    stage = Usd.Stage.Open("worn.usda")
    add_belt(stage)
    bake = "bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc"
    assert run(f"{bake} --refine 1 --refined-output points") == 2
    assert "/Hero/Belt: it is soft, and rides on cloth that is written as points" in capsys.readouterr().err
    name_vertices(1, 2, 30)(stage.GetPrimAtPath("/Hero/Belt"))
    stage.GetRootLayer().Save()
    assert run(bake) == 2
    assert "it has ssilk:rideSoft and ssilk:rideVertices" in capsys.readouterr().err
    assert not Path("shot.usdc").exists()


@pytest.mark.parametrize("target", ["usd", "blender", "game8", "game4", "arkit", "glb", "glb4"])
def test_riders_are_on_their_cloth_in_every_target(hero, target):
    name = {"arkit": "shot.usdz", "glb": "shot.glb", "glb4": "shot.glb"}.get(target, "shot.usdc")
    influences = "" if target not in ("game4", "arkit", "glb4") else "reduce model.safetensors -o few.safetensors"
    model = "model.safetensors"
    if influences:
        assert run(f"{influences} --influences 4 --motions clip.usda") == 0
        model = "few.safetensors"
    assert run(f"bake {model} --stage worn.usda --motion clip.usda --target {target} -o {name}") == 0
    assert off_in(GlbShot(name) if name.endswith(".glb") else Shot(name)) < ROUNDED
    assert run(f"verify {name}") == 0


@pytest.mark.parametrize(
    "more",
    ["--lbs", "--hold 2", "--latent-iterations 1", "--refine 2", "--refine 2 --refined-output points",
     "--samples-per-frame 2", "--no-body", "--quality crowd"],
)  # fmt: skip
def test_riders_are_on_their_cloth_whatever_moves_it(hero, more):
    assert run(f"bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc {more}") == 0
    assert off_in(Shot("shot.usdc")) < ROUNDED


def test_several_meshes_are_one_rigid_thing_and_rigging_leaves_riders(hero):
    stage = Usd.Stage.Open("hero.usda")
    UsdGeom.Xform.Define(stage, "/Hero/Clasp").GetPrim().CreateRelationship("ssilk:ridesOn").SetTargets(
        ["/Hero/Skirt"]
    )
    for number in range(2):
        part, _ = disc_on(skirt_of(), FACES[number], SHARES[number], 0.01)
        add_rider(stage, f"/Hero/Clasp/Part{number}", part).GetRelationship("ssilk:ridesOn").SetTargets([])
    UsdGeom.Xformable(stage.GetPrimAtPath("/Hero/Clasp")).AddTranslateOp().Set((0.001, 0.002, 0.003))
    stage.GetRootLayer().Save()
    assert run("rig hero.usda --garment Skirt --proxies 4 -o clasped.usda") == 0
    assert run("bake model.safetensors --stage clasped.usda --motion clip.usda -o shot.usdc") == 0
    shot = Usd.Stage.Open("shot.usdc")
    names = UsdSkel.Skeleton(shot.GetPrimAtPath("/Hero/Skeleton")).GetJointsAttr().Get()
    carried = [
        UsdSkel.BindingAPI(shot.GetPrimAtPath(f"/Hero/Part{each}")).GetJointIndicesAttr().Get() for each in (0, 1)
    ]
    assert {names[index].rpartition("/")[2] for indices in carried for index in indices} == {"Clasp"}


def test_riders_are_on_cloth_that_was_simulated(hero):
    # It is stretched, by which the middle of what a button touches leaves the point beneath its own middle.
    assert run("simulate worn.usda --motion clip.usda -o shot.usdc --range 0-3 --garment Skirt") == 0
    assert off_in(Shot("shot.usdc")) < ALLOWED / 10
    assert run("simulate worn.usda --motion clip.usda -o points.usdc --range 0-3 --garment Skirt --points") == 0
    assert (
        run("skin points.usdc --stage worn.usda --motion clip.usda -o skinned.glb --target glb --garment Skirt") == 0
    )
    assert off_in(GlbShot("skinned.glb")) < ALLOWED / 10


def test_layers_keep_riders_with_the_asset_and_a_shot_shows_them_of_every_garment(hero):
    bake = "bake model.safetensors --stage worn.usda --motion clip.usda -o layers"
    assert run(bake) == 0
    assert run(f"{bake} --garment-name other") == 0  # whose body the shot does not show
    stage = Usd.Stage.Open("layers/shots/clip/shot.usda")
    shown = [
        str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh) and "Button" in prim.GetName()
    ]
    assert len(shown) == 6
    assert off_in(Shot("layers/shots/clip/model/anim.usdc")) < ROUNDED
    assert off_in(Shot("layers/shots/clip/other/anim.usdc")) < ROUNDED
    geometry = Sdf.Layer.FindOrOpen("layers/assets/model/geometry.usdc")
    assert geometry.GetPrimAtPath("/model/Button0").relationships["ssilk:ridesOn"]
    assert run("verify layers/shots/clip/model/anim.usdc") == 0


def test_a_garment_is_read_back_without_the_joints_of_its_riders(hero):
    assert run("bake model.safetensors --stage rigged.usda --motion clip.usda -o bare.usdc") == 0
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc") == 0
    bare, worn = read_baked("bare.usdc"), read_baked("shot.usdc")
    assert worn.garment.joint_names == bare.garment.joint_names
    np.testing.assert_allclose(worn.pose.rotations, bare.pose.rotations, atol=1e-6)
    assert run("bake model.safetensors --stage rigged.usda --motion shot.usdc -o again.usdc") == 0  # as a motion
    np.testing.assert_allclose(Shot("again.usdc").garment_points(5), Shot("bare.usdc").garment_points(5), atol=1e-5)


def test_without_a_rider_of_its_own_a_shot_is_as_it_was(hero, capsys):
    stage = Usd.Stage.Open("worn.usda")
    for number in range(3):
        stage.RemovePrim(f"/Hero/Button{number}")
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o before.usdc") == 0
    stage.GetRootLayer().Save()
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o bare.usdc") == 0
    other = UsdGeom.Mesh.Define(stage, "/Hero/Hat").GetPrim()
    other.CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    add_rider(stage, "/Hero/Feather", 0.01 * DISC, target="/Hero/Hat")
    stage.GetRootLayer().Save()
    capsys.readouterr()
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc") == 0
    said = capsys.readouterr()
    assert (
        "/Hero/Feather: it rides on /Hero/Hat, another garment than is baked here, and is left out"
        in said.out + said.err
    )
    assert Path("bare.usdc").read_bytes() == Path("shot.usdc").read_bytes()


def aim(*targets: str):
    return lambda rider: rider.GetRelationship("ssilk:ridesOn").SetTargets(targets)


def name_vertices(*vertices: int):
    return lambda rider: rider.CreateAttribute("ssilk:rideVertices", Sdf.ValueTypeNames.IntArray).Set(
        Vt.IntArray(vertices)
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (aim("/Hero/Cloak"), "it rides on /Hero/Cloak, which is not in the stage; the garment is /Hero/Skirt"),
        (aim("/Hero/Body"), "it rides on /Hero/Body, which is no garment"),
        (aim("/Hero/Skirt", "/Hero/Body"), "it rides on 2 prims, /Hero/Skirt, /Hero/Body; a rider has one garment"),
        (lambda rider: UsdGeom.Xformable(rider).AddTranslateOp().Set((0, 0, 3)), "mm away from .*within 50 mm"),
        (lambda rider: UsdSkel.BindingAPI(rider).CreateJointIndicesPrimvar(False, 1).Set([0] * 20), "skinned itself"),
        (lambda rider: UsdGeom.Imageable(rider).MakeInvisible(), "has no visible mesh"),
        (name_vertices(1, 2, 99999), "three different vertices"),
    ],
)  # fmt: skip
def test_what_cannot_ride_is_refused_in_one_sentence(hero, capsys, change, says):
    stage = Usd.Stage.Open("worn.usda")
    change(stage.GetPrimAtPath("/Hero/Button0"))
    stage.GetRootLayer().Save()
    capsys.readouterr()
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc") == 2
    said = capsys.readouterr().err
    assert re.search(f"/Hero/Button0: .*{says}", said) and len(said.strip().splitlines()) == 1, said
    assert not Path("shot.usdc").exists()


UNDER, TURNED_BY = 85, 81  # faces of the skirt: beneath a plate, and another that carries it


def plate(mesh: Mesh) -> np.ndarray:
    """A plate 10 cm wide that lies on the skirt, away from its hem."""
    points, foot = disc_on(mesh, UNDER, SHARES[1], 0.05)
    corners = mesh.points[mesh.faces[UNDER]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    height = (points - foot) @ normal
    return points - 0.9 * height[:, None] * normal


def test_how_deep_a_rider_enters_its_cloth_is_told_where_it_is_more_than_a_millimetre(hero, capsys):
    lively("model.safetensors")
    mesh, stage = skirt_of(), Usd.Stage.Open("worn.usda")
    rest = plate(mesh)
    add_rider(stage, "/Hero/Plate", rest, vertices=tuple(map(int, mesh.faces[TURNED_BY])))
    stage.GetRootLayer().Save()
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usdc") == 0
    told, shot = capsys.readouterr().err, Shot("shot.usdc")
    (index,) = (number for number, each in enumerate(shot.meshes) if each.name == "Plate")
    faces = shot.meshes[index].faces
    depths = []
    for time in shot.frame_times:
        points = shot.points(time)[index]
        samples = np.concatenate([points, points[faces].mean(axis=1)])
        depths.append(depth_by_libigl(mesh, shot.garment_points(time), samples))
    own = np.concatenate([rest, rest[faces].mean(axis=1)])
    below = depth_by_libigl(mesh, mesh.points, own)
    deeper = np.array([(depth - below.clip(min=0)).max() for depth in depths])
    assert deeper.max() > 2e-3
    said = read_provenance("shot.usdc")["riders_in_cloth"]
    assert said["Plate"]["depth"] == pytest.approx(deeper.max(), rel=0.02)
    assert said["Plate"]["frame"] == shot.frame_times[int(deeper.argmax())]
    line = f"Plate enters the cloth by: {1000 * said['Plate']['depth']:.1f} mm, clip at time code"
    assert line in told and "Button" not in "".join(said)
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o layers") == 0
    assert "Plate enters the cloth by: " in capsys.readouterr().err
    again = "bake model.safetensors --stage worn.usda --motion clip.usda -o layers"
    assert run(again) == 0 and "current" in capsys.readouterr().err


def test_what_three_vertices_carry_far_from_the_cloth_enters_none_of_it(hero, capsys):
    mesh, stage = skirt_of(), Usd.Stage.Open("worn.usda")
    points, _ = disc_on(mesh, FACES[1], SHARES[1], 0.01)
    add_rider(stage, "/Hero/Lantern", points + [0, 0, 1.5], vertices=tuple(map(int, mesh.faces[FACES[1]])))
    stage.GetRootLayer().Save()
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usda") == 0
    assert "Lantern enters" not in capsys.readouterr().err


def depth_by_libigl(mesh: Mesh, cloth: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """How far samples lie beneath cloth that is wound to face outwards [m], by the normals of its nearest faces."""
    squares, face, nearest = igl.point_mesh_squared_distance(samples, cloth, mesh.faces)
    corners = cloth[mesh.faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.sqrt(squares) * np.where(((samples - nearest) * normal).sum(axis=1) < 0, 1, -1)


def test_verify_finds_a_rider_that_left_its_cloth(hero, capsys):
    assert run("bake model.safetensors --stage worn.usda --motion clip.usda -o shot.usda") == 0
    layer = Sdf.Layer.FindOrOpen("shot.usda")
    points = layer.GetAttributeAtPath("/Hero/Button0.points")
    points.default = Vt.Vec3fArray.FromNumpy(np.array(points.default) + np.float32([0, 0.002, 0]))
    layer.Save()
    capsys.readouterr()
    assert run("verify shot.usda") == 3
    assert "Button0 is 2 mm off its cloth at time code 0" in capsys.readouterr().err


def test_usd_core_bakes_a_brooch_on_the_cape_that_ships_where_the_cape_is(tmp_path, monkeypatch):
    """A stage with the character alone, whose model knows the cape by a name; UsdSkel.BakeSkinning is the judge."""
    monkeypatch.chdir(tmp_path)
    file = load_model(str(shipped_path("cape")))
    mesh = file.scene.garment.mesh
    loose = np.flatnonzero((file.scene.classes[mesh.faces] == LOOSE).all(axis=1))
    faces, shares = loose[[50, 900, 2500, 4000]], np.random.default_rng(0).dirichlet([1, 1, 1], 4)
    stage = Usd.Stage.CreateNew("hero.usda")
    stage.GetRootLayer().subLayerPaths.append(str(demo_body_path()))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    rest = []
    for number, (face, share, radius) in enumerate(zip(faces, shares, (0.006, 0.015, 0.025, 0.04))):
        rest.append(disc_on(mesh, face, share, radius)[0])
        add_rider(stage, f"/Body/Brooch{number}", rest[-1], target="/Body/Cape")
    stage.GetRootLayer().Save()
    skeleton = file.scene.character.skeleton
    write_motion(Path("motion.usdc"), demo_shot(skeleton), skeleton)
    bake = f"bake {shipped_path('cape')} --stage hero.usda --motion motion.usdc --range 30-89 -o shot.usdc"
    assert run(bake) == 0
    baked = Usd.Stage.Open("shot.usdc")
    assert UsdSkel.BakeSkinning(UsdSkel.Root(baked.GetDefaultPrim()))

    def points(name: str, code: float) -> np.ndarray:
        prim = baked.GetDefaultPrim().GetChild(name)
        return np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code), dtype=float)

    worst, moved = 0.0, []
    for code in np.arange(baked.GetStartTimeCode(), baked.GetEndTimeCode() + 1):
        riders = [points(f"Brooch{number}", code) for number in range(4)]
        moved.append(riders[0].mean(axis=0))
        worst = max(worst, largest_off(points("Cape", code), riders, mesh, rest, faces, shares))
    assert np.ptp(moved, axis=0).max() > 0.3  # the character walks
    assert worst < ALLOWED
