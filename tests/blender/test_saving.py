# SPDX-License-Identifier: Apache-2.0
"""Paths that garments remember, when files are saved elsewhere and copied."""

from __future__ import annotations

import shutil

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

BEFORE = ["//ssilk/Skirt-001/model.safetensors", "//ssilk/Skirt-001", "//../Tänze/walk.usdc"]
DEEPER = ["//../ssilk/Skirt-001/model.safetensors", "//../ssilk/Skirt-001", "//../../Tänze/walk.usdc"]


@pytest.fixture
def saved(bpy, skirt, tmp_path):
    """The skirt in a saved file, with a model, a training and a file of motion."""
    from blender_addon.motions.sources import FILE, Source
    from blender_addon.operators.training import add_motion

    folder = tmp_path / "shots ä"
    folder.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "one.blend"))
    skirt.ssilk.model, skirt.ssilk.training.folder = BEFORE[:2]
    add_motion(skirt, Source(FILE, BEFORE[2]))
    bpy.ops.wm.save_mainfile()
    return skirt


def remembered(garment) -> list[str]:
    return [path.replace("\\", "/") for path in (garment.ssilk.model, garment.ssilk.training.folder)] + [
        item.name.replace("\\", "/") for item in garment.ssilk.training.motions
    ]


def test_paths_follow_a_file_that_is_saved_elsewhere(bpy, saved, tmp_path):
    assert remembered(saved) == BEFORE
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shots ä" / "two.blend"))
    assert remembered(saved) == BEFORE
    (tmp_path / "shots ä" / "deeper").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shots ä" / "deeper" / "two.blend"))
    assert remembered(saved) == DEEPER
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert remembered(bpy.data.objects["Skirt"]) == DEEPER


def test_a_copy_gets_paths_of_its_own_and_the_file_keeps_its(bpy, saved, tmp_path):
    copy = tmp_path / "shots ä" / "deeper" / "copy.blend"
    copy.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    assert remembered(saved) == BEFORE
    bpy.ops.wm.open_mainfile(filepath=str(copy))
    assert remembered(bpy.data.objects["Skirt"]) == DEEPER


def test_a_folder_that_moves_as_a_whole_keeps_its_models(bpy, saved, tmp_path):
    from blender_addon.playback.models import model_of

    model = tmp_path / "shots ä" / "ssilk" / "Skirt-001" / "model.safetensors"
    model.parent.mkdir(parents=True)
    model.touch()
    shutil.copytree(tmp_path / "shots ä", tmp_path / "moved")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "one.blend"))
    assert model_of(bpy.data.objects["Skirt"]).resolve().is_relative_to(tmp_path / "moved")


def test_absolute_paths_stay(bpy, saved, tmp_path):
    saved.ssilk.model = str(tmp_path / "x.safetensors")
    (tmp_path / "elsewhere").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elsewhere" / "two.blend"))
    assert saved.ssilk.model == str(tmp_path / "x.safetensors")
