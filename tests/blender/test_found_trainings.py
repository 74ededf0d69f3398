# SPDX-License-Identifier: Apache-2.0
"""Trainings that are found beside the file, whatever was undone, renamed, or not saved."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .test_panels import drawn


@pytest.fixture
def saved(bpy, skirt, tmp_path):
    """The skirt in a file that was saved before anything was trained."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "größe.blend"))
    return skirt


def job(bpy, garment: str = "Skirt", file: str = "größe.blend", state: str = "running") -> Path:
    """Return a new job beside the file that trains a garment of some file."""
    from blender_addon.outside import jobs
    from blender_addon.playback.models import trainings_folder

    folder = jobs.create(trainings_folder(), garment)
    jobs.own(folder, garment, file)
    (folder / "state.json").write_text(json.dumps({"state": state, "beat": time.time()}))
    return folder


def job_of(garment):
    from blender_addon.playback.models import job_of

    return job_of(garment)


def test_a_training_is_found_that_the_file_knows_nothing_of(bpy, saved):
    assert job_of(saved) is None
    folder = job(bpy)
    assert job_of(saved) == folder
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    garment = bpy.data.objects["Skirt"]
    assert garment.ssilk.training.folder == "" and job_of(garment) == folder
    activate(bpy, garment)
    assert bpy.ops.ssilk.cancel_training() == {"FINISHED"}
    assert (folder / "cancel").exists()


def test_the_latest_training_counts(bpy, saved):
    first, second = job(bpy), job(bpy)
    saved.ssilk.training.folder = "//ssilk/Skirt-001"  # as an undo leaves it
    assert bpy.path.abspath(saved.ssilk.training.folder) == str(first) and job_of(saved) == second
    job(bpy, file="another.blend")
    job(bpy, "Cape")
    assert job_of(saved) == second


def test_what_a_garment_remembers_is_found_where_names_changed(bpy, saved, tmp_path):
    folder = job(bpy)
    bpy.ops.wm.save_mainfile()
    saved.name = "Rock"
    assert job_of(saved) == folder
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "two.blend"))
    assert job_of(saved) == folder
    (tmp_path / "deeper").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "deeper" / "three.blend"))
    assert saved.ssilk.training.folder.startswith("//..") and job_of(saved) == folder


def test_a_training_without_its_garment_is_shown_and_cancelled(bpy, saved):
    from blender_addon.operators.training import watch
    from blender_addon.panels import GarmentPanel

    folder, other, _ = job(bpy), job(bpy, "Cape"), job(bpy, "Hat", state="done")
    foreign = job(bpy, "Shawl", "another.blend")
    assert watch() > 0
    notes = drawn(GarmentPanel, bpy.context)
    assert notes.count("ssilk.cancel_orphan") == 1 and "Cape 0%" in notes
    with pytest.raises(RuntimeError, match="has ended, or its garment is back"):
        bpy.ops.ssilk.cancel_orphan(folder=str(foreign))
    assert bpy.ops.ssilk.cancel_orphan(folder=str(other)) == {"FINISHED"}
    assert (other / "cancel").exists() and not (folder / "cancel").exists()
    with pytest.raises(RuntimeError, match="has ended, or its garment is back"):
        bpy.ops.ssilk.cancel_orphan(folder=str(folder))
    bpy.data.objects.remove(saved)
    watch()
    assert drawn(GarmentPanel, bpy.context).count("ssilk.cancel_orphan") == 2
    assert bpy.ops.ssilk.cancel_orphan(folder=str(folder)) == {"FINISHED"}
    assert (folder / "cancel").exists()


def test_drawing_reads_no_trainings_without_their_garments(bpy, saved):
    """Panels are drawn many times a second, and the file may lie on a slow disk."""
    from blender_addon.operators.training import watch
    from blender_addon.panels import GarmentPanel

    folder = job(bpy, "Cape")
    watch()
    (folder / "state.json").unlink()
    job(bpy, "Hat")
    notes = drawn(GarmentPanel, bpy.context)
    assert "Cape 0%" in notes and "Hat 0%" not in notes
    watch()
    notes = drawn(GarmentPanel, bpy.context)
    assert "Hat 0%" in notes and "Cape 0%" not in notes


def test_jobs_that_do_not_say_what_they_train_are_left_out(bpy, saved):
    from blender_addon.playback.models import trainings

    folder = job(bpy)
    for text in ("", "[]", '{"garment": "Skirt", "file": 3, "begun": 1}'):
        (folder / "training.json").write_text(text)
        assert trainings() == [] and job_of(saved) is None
