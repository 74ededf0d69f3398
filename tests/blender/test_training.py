# SPDX-License-Identifier: Apache-2.0
"""Training from Blender: motions as Blender evaluates them; real trainings, cancelled, found again and resumed."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import job_of

from .conftest import BONES, activate
from .scenes import ended, rig_and_animate

READ = """
import json, sys
from ssilk_core.scene.kinematics import motion_transforms
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.character import read_character
from ssilk_usd.units import StageUnits
from ssilk_usd.opening.stage import open_stage
skeleton = read_character(sys.argv[1]).skeleton
motion = read_motion(sys.argv[2], skeleton)
units = StageUnits.of(open_stage(sys.argv[1]))
worlds = units.transforms_from_core(motion_transforms(motion, skeleton.parents))
print(json.dumps({"fps": motion.fps, "start": motion.start, "worlds": worlds.tolist()}))
"""


@pytest.fixture
def rigged(ready, skirt, folder):
    """The skirt with proxies on an animated pillar, in a saved file."""
    path = folder / "rigged.blend"
    if not path.exists():
        rig_and_animate(ready, skirt)
        ready.ops.wm.save_as_mainfile(filepath=str(path))
    ready.ops.wm.open_mainfile(filepath=str(path))
    garment = ready.data.objects["Skirt"]
    activate(ready, garment)
    garment.ssilk.training.preset, garment.ssilk.training.iterations = "draft", 4
    return garment


def choose(bpy, garment, *names: str) -> None:
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    for item in garment.ssilk.training.motions:
        item.use = item.name in names
    assert {item.name for item in garment.ssilk.training.motions if item.use} == set(names)


def listed(garment) -> list[tuple[str, str, bool]]:
    return [(item.kind, item.name, item.use) for item in garment.ssilk.training.motions]


def read(python: str, job: Path, name: str) -> dict:
    """Return a sampled motion as ssilk reads it, in Blender's units and axes."""
    words = [python, "-c", READ, str(job / "dressed.usdc"), str(job / "motions" / name)]
    found = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    return {**found, "worlds": np.array(found["worlds"])}


def evaluated(bpy, armature, frames) -> np.ndarray:
    """Return where Blender has the character's bones, frame by frame."""
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        rig = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        found.append([np.array(rig.matrix_world @ rig.pose.bones[name].matrix) for name in BONES])
    return np.array(found)


def refused(bpy) -> str:
    with pytest.raises(RuntimeError) as error:
        bpy.ops.ssilk.train()
    return str(error.value)


def test_motions_are_found_and_choices_stay(ready, rigged):
    armature = ready.data.objects["Rig"]
    camera = ready.data.actions.new("Camera")
    camera.use_fake_user = True
    track = armature.animation_data.nla_tracks.new()
    track.name = "Takes"
    track.strips.new("Spin Ö", 100, ready.data.actions["Spin Ö"])
    ready.ops.ssilk.find_motions()
    assert listed(rigged) == [
        ("TIMELINE", "Timeline", False),
        ("ACTION", "Spin Ö", True),
        ("ACTION", "Walk", True),
    ]  # fmt: skip; the strip plays the action as it is
    rigged.ssilk.training.motions[1].use = False
    ready.data.actions.remove(ready.data.actions["Walk"])
    track.strips["Spin Ö"].use_reverse = True
    ready.ops.ssilk.find_motions()
    assert listed(rigged) == [("TIMELINE", "Timeline", False), ("ACTION", "Spin Ö", False), ("STRIP", "Spin Ö", True)]


def test_all_or_none_of_the_motions_that_the_filter_leaves_are_chosen(ready, rigged):
    from blender_addon.panels.training import MotionList, TrainingPanel

    from .test_panels import drawn

    assert not ready.ops.ssilk.choose_motions.poll()
    choose(ready, rigged, "Walk")
    settings = rigged.ssilk.training
    notes = drawn(TrainingPanel, ready.context)
    assert notes.count("ssilk.choose_motions") == 2 and {"search", "motions", "1 of 3"} <= set(notes)
    settings.search = "sPIN"
    flags = MotionList.filter_items(SimpleNamespace(bitflag_filter_item=4), ready.context, settings, "motions")
    assert flags == ([0, 4, 0], [])
    assert ready.ops.ssilk.choose_motions(value="ALL") == {"FINISHED"}
    assert [item.name for item in settings.motions if item.use] == ["Spin Ö", "Walk"]
    settings.search = ""
    ready.ops.ssilk.choose_motions(value="NONE")
    assert not any(item.use for item in settings.motions)


def test_a_budget_is_in_minutes_or_in_iterations(ready, rigged):
    from blender_addon.operators.training import train_command

    settings = rigged.ssilk.training
    choose(ready, rigged, "Walk")
    assert "--minutes" not in train_command(rigged, "/Skirt", [], [])
    settings.minutes = 2.5
    assert "a budget in iterations and in minutes" in refused(ready)
    settings.iterations = 0
    words = train_command(rigged, "/Skirt", [], [])
    assert words[words.index("--minutes") + 1] == "2.5" and "--set" not in words


def test_files_are_listed_once_by_paths_from_the_blend_file(ready, rigged, folder):
    (folder / "clip ä.usdc").touch()
    for _ in range(2):
        ready.ops.ssilk.add_motion_files(directory=str(folder), files=[{"name": "clip ä.usdc"}])
    ready.ops.ssilk.find_motions()
    assert listed(rigged)[-1] == ("FILE", "//clip ä.usdc", True)
    assert [kind for kind, *_ in listed(rigged)].count("FILE") == 1
    with pytest.raises(RuntimeError, match=r"There is no file //none\.usda"):
        ready.ops.ssilk.add_motion_files(directory=str(folder), files=[{"name": "none.usda"}])
    ready.ops.ssilk.remove_motion(index=len(rigged.ssilk.training.motions) - 1)
    assert "FILE" not in {kind for kind, *_ in listed(rigged)}


def test_motions_are_what_blender_evaluates(ready, rigged, ssilk_python):
    """An action, a reversed strip and the timeline, with a constraint on a target that has an action of its own."""
    scene, armature = ready.context.scene, ready.data.objects["Rig"]
    target = ready.data.objects.new("Target", None)
    scene.collection.objects.link(target)
    for frame, place in ((1, 0.0), (40, 2.0)):
        target.location.x = place
        target.keyframe_insert("location", frame=frame)
    armature.pose.bones["Head"].constraints.new("DAMPED_TRACK").target = target
    armature.scale, armature.location = (2.0, 2.0, 2.0), (1.0, 0.5, 0.25)
    animation = armature.animation_data
    track = animation.nla_tracks.new()
    track.name = "Takes"
    track.strips.new("Spin Ö", 5, ready.data.actions["Spin Ö"]).use_reverse = True
    scene.frame_set(11)
    choose(ready, rigged, "Timeline", "Walk", "Spin Ö")
    scenes, state = len(ready.data.scenes), (animation.action, animation.use_nla, scene.frame_current)
    assert ready.ops.ssilk.train() == {"FINISHED"}
    assert (len(ready.data.scenes), (animation.action, animation.use_nla, scene.frame_current)) == (scenes, state)
    assert not any(item.mute for item in (track, *track.strips))
    ready.ops.ssilk.cancel_training()
    files = sorted(path.name for path in (job_of(rigged) / "motions").iterdir())
    assert files == ["Spin__.usdc", "Spin___2.usdc", "Timeline.usdc", "Walk.usdc"]
    timeline = read(ssilk_python, job_of(rigged), "Timeline.usdc")
    assert (timeline["fps"], timeline["start"]) == (24.0, 1.0)
    wanted = evaluated(ready, armature, range(1, 41))
    np.testing.assert_allclose(timeline["worlds"][..., :3, 3], wanted[..., :3, 3], atol=1e-5)
    np.testing.assert_allclose(timeline["worlds"][..., :3, :3], wanted[..., :3, :3] / 2.0, atol=1e-5)
    animation.action = None
    strip = read(ssilk_python, job_of(rigged), "Spin___2.usdc")
    wanted = evaluated(ready, armature, range(5, 5 + len(strip["worlds"])))
    np.testing.assert_allclose(strip["worlds"][..., :3, 3], wanted[..., :3, 3], atol=1e-5)
    animation.action, animation.use_nla = ready.data.actions["Walk"], False
    wanted = evaluated(ready, armature, range(1, 38))
    walk = read(ssilk_python, job_of(rigged), "Walk.usdc")["worlds"]
    np.testing.assert_allclose(walk[..., :3, 3], wanted[..., :3, 3], atol=1e-5)


def test_a_training_is_cancelled_found_again_and_resumed(ready, rigged, folder):
    choose(ready, rigged, "Walk", "Spin Ö")
    rigged.ssilk.training.iterations = 60
    ready.ops.ed.undo_push(message="before")
    rigged.location.x += 1e-6
    ready.ops.ed.undo_push(message="edited")
    assert ready.ops.ssilk.train() == {"FINISHED"}
    assert rigged.ssilk.training.folder.startswith("//ssilk/Skirt-")
    begun = job_of(rigged)
    ready.ops.ed.undo()
    rigged = ready.data.objects["Skirt"]
    assert rigged.ssilk.training.folder == "" and job_of(rigged) == begun
    assert "being trained already" in refused(ready)
    assert not ready.ops.ssilk.resume_training.poll()
    ended(rigged, after=10)
    ready.ops.wm.save_as_mainfile(filepath=str(folder / "training.blend"))
    ready.ops.wm.read_factory_settings(use_empty=True)
    import addon_utils

    addon_utils.enable("blender_addon", default_set=True)
    ready.ops.wm.open_mainfile(filepath=str(folder / "training.blend"))
    garment = ready.data.objects["Skirt"]
    assert ready.ops.ssilk.cancel_training() == {"FINISHED"}
    state = ended(garment)
    assert state.state == "stopped"
    assert 10 <= state.done < 60
    assert (job_of(garment) / "model.safetensors").exists()
    assert not ready.ops.ssilk.cancel_training.poll()


def test_a_stopped_training_goes_on_to_its_end(ready, rigged, folder):
    preferences = ready.context.preferences.addons["blender_addon"].preferences
    ready.ops.wm.open_mainfile(filepath=str(folder / "training.blend"))
    assert preferences.python
    garment = ready.data.objects["Skirt"]
    stopped = ended(garment)
    assert ready.ops.ssilk.resume_training() == {"FINISHED"}
    state = ended(garment)
    assert (state.state, state.done, state.checkpoint) == ("done", 60, 60)
    assert [done for done, _ in state.curve][: len(stopped.curve)] == [done for done, _ in stopped.curve]
    assert not ready.ops.ssilk.resume_training.poll()


def test_a_file_of_motion_trains_from_where_it_lies(ready, rigged, folder, ssilk_python):
    choose(ready, rigged, "Walk")
    ready.ops.ssilk.train()
    ended(rigged)
    clip = job_of(rigged) / "motions" / "Walk.usdc"
    (folder / "clip ä.usdc").write_bytes(clip.read_bytes())
    choose(ready, rigged)
    ready.ops.ssilk.add_motion_files(directory=str(folder), files=[{"name": "clip ä.usdc"}])
    ready.ops.ssilk.train()
    assert ended(rigged).state == "done"
    command = json.loads((job_of(rigged) / "job.json").read_text())["command"]
    assert "../../clip ä.usdc" in command
    assert not list((job_of(rigged) / "motions").iterdir())


def test_what_a_training_finds_wrong_is_kept_for_the_panel(ready, rigged):
    scene = ready.context.scene
    scene.frame_start = scene.frame_end = 1
    choose(ready, rigged, "Timeline")
    ready.ops.ssilk.train()
    state = ended(rigged)
    assert state.state == "failed"
    assert "'Timeline': " in state.error and "longer motions are needed to train" in state.error
    assert ".usdc" not in state.error


def test_panels_draw_a_training(ready, rigged):
    from blender_addon.arrays.curves import picture, series
    from blender_addon.outside.jobs import CURVE
    from blender_addon.panels import plot
    from blender_addon.panels.training import EnergiesPanel, TrainingPanel
    from blender_addon.playback import models
    from blender_addon.playback.models import trainings

    from .test_panels import drawn

    choose(ready, rigged, "Walk")
    ready.ops.ssilk.train()
    ended(rigged)
    notes = drawn(TrainingPanel, ready.context)
    assert {"100% 100%", "Trained for 4 iterations"} <= set(notes)
    assert "energy than linear blend skinning" in " ".join(notes)  # in as many lines as it needs
    assert not any(note.endswith(" J") for note in notes)
    assert any(note.startswith("Stretch: ") for note in drawn(EnergiesPanel, ready.context))
    assert models.read_all(trainings()) and not models.read_all(trainings())
    (job_of(rigged) / CURVE).unlink()  # panels draw what was read, until the timer reads again
    assert "energy than linear blend skinning" in " ".join(drawn(TrainingPanel, ready.context))
    models.read_all(trainings())
    assert "energy than linear blend skinning" not in " ".join(drawn(TrainingPanel, ready.context))
    shown = plot._pictures[str(job_of(rigged))]
    pixels = np.array(shown.image_pixels_float).reshape(*shown.image_size, 4)
    lines = series(ended(rigged).curve)
    np.testing.assert_allclose(pixels, picture(list(lines.values()), plot.SIZE), atol=1 / 255)


def test_trainings_are_watched_and_left_alone_when_blender_closes(ready, rigged):
    from blender_addon.operators import training

    choose(ready, rigged, "Walk")
    rigged.ssilk.training.iterations = 4000
    ready.ops.ssilk.train()
    ended(rigged, after=1)
    assert training.watch() == training.LOOK
    assert ready.app.timers.is_registered(training.watch)
    training.stop_watching(ready.context)
    assert not ready.app.timers.is_registered(training.watch)
    assert not (job_of(rigged) / "cancel").exists()
    training.begun.add(job_of(rigged))
    ready.context.preferences.addons["blender_addon"].preferences.stop_trainings = True
    training.stop_watching(ready.context)
    assert ended(rigged).state == "stopped"


def unproxied(bpy, garment) -> None:
    armature = bpy.data.objects["Rig"]
    activate(bpy, armature)
    bpy.ops.object.mode_set(mode="EDIT")
    for bone in [bone for bone in armature.data.edit_bones if bone.name not in BONES]:
        armature.data.edit_bones.remove(bone)
    bpy.ops.object.mode_set(mode="OBJECT")
    for group in [group for group in garment.vertex_groups if group.name not in BONES]:
        garment.vertex_groups.remove(group)
    garment.vertex_groups.clear()
    activate(bpy, garment)


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda bpy, garment: garment.ssilk.training.motions.clear(), "No motion is chosen for 'Skirt'"),
        (lambda bpy, garment: setattr(garment.ssilk.training.motions[2], "name", "Run"), "The action 'Run' is gone"),
        (lambda bpy, garment: garment.data.attributes.remove(garment.data.attributes["ssilk:class"]), "no classes"),
        (unproxied, "'Skirt' is loose but has no proxies"),
        (lambda bpy, garment: garment.vertex_groups.clear(), "have no bone's weight, as where a proxy was deleted"),
        (
            lambda bpy, garment: setattr(bpy.data.objects["Rig"].pose.bones["Spine"], "scale", (1, 2, 1)),
            "is scaled at",
        ),
        (lambda bpy, garment: bpy.data.objects.remove(bpy.data.objects["Rig"]), "There is no armature for 'Skirt'"),
        (lambda bpy, garment: bpy.data.objects.remove(bpy.data.objects["Pillar"]), "No body is bound to 'Rig'"),
    ],
)
def test_what_cannot_be_trained_is_named(ready, rigged, harm, told):
    choose(ready, rigged, "Walk")
    before = rigged.ssilk.training.folder
    harm(ready, rigged)
    assert told in refused(ready)
    assert rigged.ssilk.training.folder == before


@pytest.mark.parametrize("lost", ["Rig", "Skirt"])
def test_what_is_deleted_while_motions_are_sampled_changes_nothing(ready, rigged, monkeypatch, lost):
    from blender_addon.motions import sampling

    kept = sampling._sample_slice

    def slice_then_delete(*rest) -> None:
        kept(*rest)
        if lost in ready.data.objects:
            ready.data.objects.remove(ready.data.objects[lost])

    choose(ready, rigged, "Walk")
    monkeypatch.setattr(sampling, "SLICE", 0.0)
    monkeypatch.setattr(sampling, "_sample_slice", slice_then_delete)
    assert f"'{lost}' was deleted meanwhile" in refused(ready)
    assert len(ready.data.scenes) == 1


def test_an_unsaved_file_has_no_place_for_a_training(ready, skirt):
    assert not ready.ops.ssilk.train.poll()
    with pytest.raises(RuntimeError, match="Save the file first"):
        ready.ops.ssilk.train()


def test_a_folder_that_vanished_is_no_training(ready, rigged, folder):
    rigged.ssilk.training.folder = "//ssilk/gone"
    assert not ready.ops.ssilk.cancel_training.poll()
    from blender_addon.panels.training import TrainingPanel

    from .test_panels import drawn

    assert "ssilk.train" in drawn(TrainingPanel, ready.context)
