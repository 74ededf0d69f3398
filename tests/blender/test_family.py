# SPDX-License-Identifier: Apache-2.0
"""A model of a family of bodies in Blender: it is played and baked on the body that the character has."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import model_of

from .scenes import DECODED, shown
from .test_shapes import fuller

EXACT = 3e-5  # [m]
FRAMES = range(1, 41, 3)
HEAVIER, TALLER = (1.3, 1.0, 1.3), (1.0, 1.15, 1.0)  # in metres, y up
FAMILY = """
import sys
from dataclasses import replace
import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdSkel
from ssilk_core.authoring.bodies.carry import dressed_family
from ssilk_core.network.bodies import SEEING, SeenBodies
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.scene.family import BodyFamily
from ssilk_usd.reading.character import read_character
model, stage, folder, *scales = sys.argv[1:]
file, rng = load_model(model), np.random.default_rng(5)
characters = [read_character(stage)]
for number, scale in enumerate(scales):
    scale = np.array(eval(scale)[::1])
    member = Usd.Stage.Open(Usd.Stage.Open(stage).Flatten())
    up = UsdGeom.GetStageUpAxis(member)
    scale = scale if up == "Y" else scale[[0, 2, 1]]
    for prim in member.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            points = UsdGeom.Mesh(prim).GetPointsAttr()
            points.Set([Gf.Vec3f(*(float(a) * b for a, b in zip(p, scale))) for p in points.Get()])
        if prim.IsA(UsdSkel.Skeleton):
            binds = UsdSkel.Skeleton(prim).GetBindTransformsAttr()
            moved = []
            for matrix in binds.Get():
                matrix = Gf.Matrix4d(matrix)
                matrix.SetTranslateOnly(Gf.Vec3d(*(a * b for a, b in zip(matrix.ExtractTranslation(), scale))))
                moved.append(matrix)
            binds.Set(moved)
    path = f"{folder}/member_{number}.usdc"
    member.GetRootLayer().Export(path)
    characters.append(read_character(path))
family = BodyFamily.of(characters)
dressed, _ = dressed_family(replace(file.scene, character=characters[0]), family, characters[1:])
columns = {
    f"{name}.0": rng.normal(0, 0.1, (2, len(file.parameters[f"{name}.0.bias"]), family.size))
    for name in SEEING if f"{name}.0.bias" in file.parameters
}
save_model(f"{folder}/family.safetensors", replace(file, bodies=SeenBodies(dressed, columns)))
"""


GRADED = """
import sys
from dataclasses import replace
from ssilk_core.network.checkpoint import load_model, save_model
file = load_model(sys.argv[1])
garment = replace(file.scene.garment, graded=True)
save_model(sys.argv[2], replace(file, scene=replace(file.scene, garment=garment)))
"""


@pytest.fixture
def wearing(trained: Any, folder: Path, ssilk_python: str) -> Any:
    """The trained skirt, with a model of a family of three bodies in a folder of its own."""
    own = folder / "family"
    if not own.exists():
        own.mkdir()
        model = model_of(trained)
        words = [model, model.parent / "dressed.usdc", own, HEAVIER, TALLER]
        subprocess.run([ssilk_python, "-c", FAMILY, *map(str, words)], check=True)
    trained.ssilk.model = str(own / "family.safetensors")
    return trained


def decoded_on(ssilk_python: str, folder: Path, stage: str) -> np.ndarray:
    """What `ssilk bake` decodes on the stage of a member, over the motion that Blender sampled last, (F, V, 3)."""
    own = folder / "family"
    words = [own / "family.safetensors", own / stage, own / "bake" / "motion.usdc", 1.0, "", folder / "found.npy"]
    subprocess.run([ssilk_python, "-c", DECODED, *map(str, words)], check=True)
    return np.load(folder / "found.npy")[[frame - 1 for frame in FRAMES]]


def make_heavier(bpy: Any) -> None:
    fuller(bpy.data.objects["Pillar"], 1.0, "Heavy", amount=0.3)


def make_taller(bpy: Any) -> None:
    """Bones of the character and the mesh of its body grow; proxies and the skirt stay."""
    pillar, armature = bpy.data.objects["Pillar"], bpy.data.objects["Rig"]
    for vertex in pillar.data.vertices:
        vertex.co.z *= TALLER[1]
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    proxies = {bone.name: (bone.head.copy(), bone.tail.copy()) for bone in armature.data.edit_bones}
    for bone in armature.data.edit_bones:
        if "proxy" not in bone.name:
            along = bone.tail - bone.head
            bone.head.z *= TALLER[1]
            bone.tail = bone.head + along
    for name, (head, tail) in proxies.items():
        if "proxy" in name:
            armature.data.edit_bones[name].head, armature.data.edit_bones[name].tail = head, tail
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.objects.active = bpy.data.objects["Skirt"]


MEMBERS = {"heavier": (make_heavier, "member_0.usdc"), "taller": (make_taller, "member_1.usdc")}


@pytest.mark.parametrize("member", MEMBERS)
def test_live_play_and_bakes_dress_the_body_that_is_there(ready, wearing, folder, ssilk_python, member):
    change, stage = MEMBERS[member]
    change(ready)
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    baked = shown(ready, wearing, FRAMES)
    wanted = decoded_on(ssilk_python, folder, stage)
    assert np.abs(baked - wanted).max() < EXACT
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    played = shown(ready, wearing, FRAMES)
    assert np.abs(played - wanted).max() < EXACT
    from blender_addon.panels.playback import live_line

    assert "a body of the model's family, that of member_" in live_line(wearing)
    other = decoded_on(ssilk_python, folder, "../" + str(model_of_training(wearing)))
    assert np.abs(played - other).max() > 0.01


def model_of_training(garment: Any) -> Path:
    """The stage that the garment was trained with, relative to the folder above the family's."""
    from blender_addon.playback.models import job_of

    stage = job_of(garment) / "dressed.usdc"
    return stage.relative_to(Path(garment.ssilk.model).parents[1])


def test_solved_frames_shots_in_usd_and_the_plain_copy_are_on_that_body(
    ready, wearing, folder, tmp_path, ssilk_python
):
    from pxr import Usd, UsdGeom

    from blender_addon.playback import playing

    make_heavier(ready)
    ready.context.scene.frame_end = 4
    slim = np.array([vertex.co for vertex in wearing.data.vertices])
    shot = tmp_path / "heavy.usdc"
    assert ready.ops.ssilk.bake(to_timeline=False, to_usd=True, filepath=str(shot)) == {"FINISHED"}
    stage = Usd.Stage.Open(str(shot))
    pillar = next(prim for prim in stage.Traverse() if prim.GetName() == "Pillar")
    across = np.ptp(np.array(UsdGeom.Mesh(pillar).GetPointsAttr().Get()), axis=0)
    assert sorted(across.round(3))[0] == pytest.approx(2 * 0.15 * 1.3, abs=0.01)
    assert ready.ops.ssilk.toggle_lbs() == {"FINISHED"}
    copy = np.array([vertex.co for vertex in ready.data.objects["Skirt LBS"].data.vertices])
    assert np.linalg.norm(copy - slim, axis=1).max() > 0.02
    wearing.ssilk.live_quality = "latent_few"
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    played = playing.live(wearing)
    assert not played.wrong and played.solved == 4
    assert np.abs(shown(ready, wearing, range(1, 5))).max() < 5


def test_on_the_first_body_it_plays_as_a_model_of_that_body(ready, trained, wearing):
    family = wearing.ssilk.model
    wearing.ssilk.model = ""
    ready.ops.ssilk.play_live()
    own = shown(ready, wearing, FRAMES)
    ready.ops.ssilk.stop_live()
    wearing.ssilk.model = family
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    np.testing.assert_allclose(shown(ready, wearing, FRAMES), own, atol=1e-6)


def test_another_body_is_taken_up_while_it_plays(ready, wearing):
    from blender_addon.playback import playing

    ready.ops.ssilk.play_live()
    slim = shown(ready, wearing, FRAMES)
    make_heavier(ready)
    ready.context.view_layer.update()
    assert playing.live(wearing).behind
    ready.ops.ssilk.refresh_live()
    assert np.abs(shown(ready, wearing, FRAMES) - slim).max() > 0.01
    ready.data.objects["Pillar"].data.shape_keys.key_blocks["Heavy"].value = 0.0
    ready.ops.ssilk.refresh_live()
    np.testing.assert_allclose(shown(ready, wearing, FRAMES), slim, atol=1e-6)


@pytest.mark.parametrize("graded", [False, True], ids=["same", "graded"])
def test_stretch_counts_from_the_rest_shape_that_the_model_trained(ready, wearing, ssilk_python, graded):
    """One garment for all bodies is stretched over a heavy one; one that is graded to it is not."""
    from blender_addon.arrays import heat
    from blender_addon.playback.models import facts_of
    from blender_addon.quality.heat import STRETCH, measuring
    from blender_addon.scene.meshes import triangles_of
    from blender_addon.scene.modifiers import cage_points

    model = Path(wearing.ssilk.model)
    if graded:
        model = model.with_name("graded.safetensors")
        subprocess.run([ssilk_python, "-c", GRADED, wearing.ssilk.model, str(model)], check=True)
        wearing.ssilk.model = str(model)
    make_heavier(ready)
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    graph = ready.context.evaluated_depsgraph_get()
    steps = measuring(wearing, STRETCH, graph)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found = end.value.values
            break
    sewing = facts_of(model).sewing
    assert sewing.graded is graded
    laid = wearing.data.shape_keys.key_blocks["SSILK body"]
    lies = np.array([tuple(point.co) for point in laid.data])
    made = np.array([tuple(point.co) for point in laid.relative_key.data])
    points, triangles = cage_points(wearing, graph), triangles_of(wearing.data)
    wanted, other = (heat.elongations(rest, points, triangles) for rest in ((lies, made) if graded else (made, lies)))
    np.testing.assert_allclose(found, wanted, atol=2e-4)
    assert np.abs(found - other).max() > 0.02


def with_one_more_point(bpy: Any) -> None:
    pillar = bpy.data.objects["Pillar"]
    pillar.data.vertices.add(1)
    pillar.vertex_groups["Head"].add([len(pillar.data.vertices) - 1], 1.0, "REPLACE")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda bpy: fuller(bpy.data.objects["Pillar"], 1.0, "Huge", amount=1.2), "beyond the bodies that the model"),
        (with_one_more_point, "the model's family of bodies has"),
    ],
)
def test_a_body_that_is_none_of_the_family_is_refused(ready, wearing, change: Callable, told: str):
    change(ready)
    assert wearing.data.shape_keys is None
    for operator in (ready.ops.ssilk.play_live, ready.ops.ssilk.bake, ready.ops.ssilk.toggle_lbs):
        with pytest.raises(RuntimeError, match=told):
            operator()
    assert wearing.data.shape_keys is None
