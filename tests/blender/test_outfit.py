# SPDX-License-Identifier: Apache-2.0
"""Garments of one character: their order in the panel, trained one over the other, baked, and hidden skin."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model

from .conftest import activate, add_mesh, tube
from .scenes import decoded, ended, enliven, rig_and_animate, shown
from .test_panels import drawn

FRAMES = range(1, 13)


@pytest.fixture
def coat(bpy, skirt):
    """A coat over the skirt, with as many bones of its own; both have classes, and the skirt is active."""
    garment = add_mesh(bpy, "Coat", *tube(24, 13, (0.6, 1.0, 1.35), (0.58, 0.2, 0.185)))
    for each in (garment, skirt):
        each.ssilk.armature = bpy.data.objects["Rig"]
    activate(bpy, skirt)
    return garment


def names(garments) -> list[str]:
    return [garment.name for garment in garments]


def order(bpy) -> list[str]:
    from blender_addon.scene.garment import garments_of

    return names(garments_of(bpy.data.objects["Rig"]))


def over(garment) -> dict[str, str]:
    """What the model of a garment says that it was trained over."""
    from blender_addon.playback.models import model_of

    return load_model(model_of(garment)).provenance.get("over") or {}


def test_the_order_is_that_of_the_panel_and_is_changed_there(bpy, skirt, coat):
    from blender_addon.panels.garment import GarmentPanel
    from blender_addon.scene.garment import beneath

    assert order(bpy) == ["Coat", "Skirt"] and not beneath(skirt)  # nobody has put them in order
    told = drawn(GarmentPanel, bpy.context)
    assert told.count("ssilk.move_layer") == 4 and "ssilk.train_outfit" in told and "ssilk.bake_outfit" in told
    assert bpy.ops.ssilk.move_layer(garment="Coat", where="OUTER") == {"FINISHED"}
    assert order(bpy) == ["Skirt", "Coat"] and names(beneath(coat)) == ["Skirt"] and not beneath(skirt)
    bpy.ops.ssilk.move_layer(garment="Coat", where="OUTER")  # it is the outermost already
    assert order(bpy) == ["Skirt", "Coat"]
    hat = add_mesh(bpy, "Apron", *tube(8, 3, (1.0, 1.2), (0.3, 0.3)))
    hat.ssilk.armature = bpy.data.objects["Rig"]
    activate(bpy, hat)
    assert order(bpy) == ["Skirt", "Coat", "Apron"]  # what is new is worn outside, until somebody says otherwise
    bpy.ops.ssilk.move_layer(garment="Apron", where="INNER")
    assert order(bpy) == ["Skirt", "Apron", "Coat"] and names(beneath(coat)) == ["Skirt", "Apron"]
    with pytest.raises(RuntimeError, match="'Scarf' is not in this view layer"):
        bpy.ops.ssilk.move_layer(garment="Scarf", where="INNER")


def test_an_outfit_is_trained_in_order_each_over_those_beneath_and_baked(
    ready, skirt, coat, tmp_path, ssilk_python, capfd
):
    from blender_addon.motions.keys import has_keys
    from blender_addon.operators.training import needs_training
    from blender_addon.playback.models import job_of, model_of

    bpy = ready
    assert bpy.ops.ssilk.move_layer(garment="Skirt", where="INNER") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="Save the file first"):
        bpy.ops.ssilk.train_outfit()
    for garment in (coat, skirt):
        activate(bpy, garment)
        rig_and_animate(bpy, garment)
        garment.ssilk.training.preset, garment.ssilk.training.iterations = "draft", 4
    bpy.context.scene.frame_end = FRAMES[-1]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "outfit.blend"))
    with pytest.raises(RuntimeError, match="has no trained model"):
        bpy.ops.ssilk.bake_outfit()
    activate(bpy, coat)
    assert bpy.ops.ssilk.train_outfit() == {"FINISHED"}
    assert bpy.context.object == coat
    inner = job_of(skirt)  # it begins first; the other waits for it
    states = [ended(garment) for garment in (skirt, coat)]
    assert [(state.state, state.error) for state in states] == [("done", "")] * 2
    assert over(skirt) == {} and over(coat) == {inner.name: sha256(model_of(skirt))}
    assert not needs_training(skirt) and not needs_training(coat)
    with pytest.raises(RuntimeError, match="All garments of this outfit are trained"):
        bpy.ops.ssilk.train_outfit()
    for garment in (skirt, coat):
        enliven(ssilk_python, model_of(garment))
    assert needs_training(coat) and not needs_training(skirt)  # the model beneath is another one now
    assert bpy.ops.ssilk.bake_outfit() == {"FINISHED"}
    for garment in (skirt, coat):
        assert has_keys(garment)
        wanted = decoded(ssilk_python, model_of(garment), tmp_path, pre_roll=1.0)
        np.testing.assert_allclose(shown(bpy, garment, FRAMES), wanted, atol=1e-4)
    assert bpy.ops.ssilk.hide_covered_outfit() == {"FINISHED"}
    pillar = bpy.data.objects["Pillar"]
    assert {each.name for each in pillar.modifiers} <= {"Armature", "SSILK Under Skirt", "SSILK Under Coat"}
    baked_over_what_is_shown_beneath(bpy, coat, skirt, tmp_path, capfd)


def baked_over_what_is_shown_beneath(bpy, coat, skirt, folder, capfd) -> None:
    """Solved for and certified over a cache with what Blender shows of the skirt, which the shot names."""
    from ssilk_usd.reading.facts import read_provenance
    from ssilk_usd.shots.play import Shot

    from blender_addon.operators.baking import BENEATH, inputs_folder
    from blender_addon.playback.models import model_of

    frames, usd = range(1, 3), folder / "coat.usdc"
    bpy.context.scene.frame_end, coat.ssilk.certify = frames[-1], True
    activate(bpy, coat)
    capfd.readouterr()
    assert bpy.ops.ssilk.bake(quality="hero", pre_roll=0, to_usd=True, filepath=str(usd)) == {"FINISHED"}
    assert "of 2 frames intersect themselves or Skirt" in capfd.readouterr().out
    met = inputs_folder(coat, model_of(coat)) / BENEATH / "0" / "Skirt.usdc"
    cache = Shot(met)
    inner = np.array([cache.garment_points(time) for time in cache.frame_times])
    np.testing.assert_allclose(inner, shown(bpy, skirt, frames)[..., [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    for made in ("refined", "certificate"):
        said = read_provenance(usd)[made]
        assert (folder / said["over"]["Skirt"]).resolve() == met and said["over_sha256"]["Skirt"] == sha256(met)


def test_one_garment_alone_is_trained_over_what_is_there(ready, skirt, coat, tmp_path, capfd):
    """An inner garment without a model is left out, and one with a chosen model is told."""
    from blender_addon.outside import jobs
    from blender_addon.playback.models import job_of

    bpy = ready
    bpy.ops.ssilk.move_layer(garment="Skirt", where="INNER")
    activate(bpy, coat)
    rig_and_animate(bpy, coat)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "alone.blend"))
    bpy.ops.ssilk.find_motions()
    coat.ssilk.training.preset, coat.ssilk.training.iterations = "draft", 4
    skirt.ssilk.model = str(tmp_path / "chosen.safetensors")
    capfd.readouterr()
    assert bpy.ops.ssilk.train() == {"FINISHED"}
    assert "'Skirt' beneath 'Coat' has a chosen model" in capfd.readouterr().out
    assert jobs.models_beneath(job_of(coat)) == []
    assert (ended(coat).state, ended(coat).error) == ("done", "")


def test_a_job_says_what_it_is_trained_over(tmp_path):
    from blender_addon.outside import jobs

    jobs._write(tmp_path / jobs.ORDER, {"command": ["train", "--over", "../inner/model.safetensors", "--json"]})
    assert jobs.models_beneath(tmp_path) == [Path(os.path.normpath(tmp_path / "../inner/model.safetensors"))]
    assert jobs.models_beneath(tmp_path / "nowhere") == []


def test_what_starts_inside_the_garment_beneath_is_found_and_pushed_out(ready, skirt, coat, tmp_path, ssilk_python):
    """The coat is narrower than the skirt on one side; nothing is wrong with it alone."""
    bpy = ready
    for garment in (skirt, coat):
        activate(bpy, garment)
        assert bpy.ops.ssilk.classify() == {"FINISHED"}
    for vertex in coat.data.vertices:
        if vertex.co.x > 0:
            vertex.co.x, vertex.co.y = 0.84 * vertex.co.x, 0.84 * vertex.co.y
    bpy.ops.ssilk.generate_rig(proxies=6)
    assert bpy.ops.ssilk.inspect() == {"FINISHED"}
    preflight = bpy.context.window_manager.ssilk_preflight

    def found() -> list[int]:
        return [number for number, item in enumerate(preflight.findings) if item.code == "garments-cross"]

    assert not found()  # nobody has said which of them is beneath
    bpy.ops.ssilk.move_layer(garment="Skirt", where="INNER")
    assert bpy.ops.ssilk.inspect() == {"FINISHED"}
    (preflight.active,) = found()
    item = preflight.findings[preflight.active]
    assert "triangles intersect those of 'Skirt'" in item.found and item.elements == "polygons"
    assert crossing(ssilk_python, tmp_path, coat, skirt) > 0
    before = points_of(coat)
    assert bpy.ops.ssilk.push_out() == {"FINISHED"}
    assert crossing(ssilk_python, tmp_path, coat, skirt) == 0
    assert 0 < np.linalg.norm(points_of(coat) - before, axis=1).max() < 0.1
    assert bpy.ops.ssilk.inspect() == {"FINISHED"} and not found()


def points_of(thing) -> np.ndarray:
    points = np.empty(len(thing.data.vertices) * 3, dtype=np.float32)
    thing.data.vertices.foreach_get("co", points)
    return points.reshape(-1, 3).astype(float)


def triangles_of(thing) -> np.ndarray:
    thing.data.calc_loop_triangles()
    return np.array([triangle.vertices[:] for triangle in thing.data.loop_triangles])


CROSSING = """
import sys
import numpy as np
from ssilk_core.physics.intersections.pairs import intersections_between
both = np.load(sys.argv[1])
print(len(np.unique(intersections_between(*(both[name] for name in ("x", "f", "y", "g")))[:, 0])))
"""


def crossing(python: str, folder: Path, outer, inner) -> int:
    """Triangles of a mesh that intersect another one's, by libigl on what Blender has; both objects stand at 0."""
    whole = {"x": points_of(outer), "f": triangles_of(outer), "y": points_of(inner), "g": triangles_of(inner)}
    np.savez(folder / "both.npz", **whole)
    told = subprocess.run([python, "-c", CROSSING, str(folder / "both.npz")], check=True, capture_output=True)
    return int(told.stdout)
