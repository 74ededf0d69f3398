# SPDX-License-Identifier: Apache-2.0
"""Certify on the Baking panel: what Blender shows then does not pass through itself, and what is missing is told."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import model_of

from .conftest import activate
from .scenes import shown
from .test_panels import drawn

FRAMES = range(1, 5)
TAMED = """
import sys
from dataclasses import replace
import numpy as np
from ssilk_core.network.checkpoint import load_model, save_model
file = load_model(sys.argv[1])
parameters = dict(file.parameters)
parameters["decoder.shapes"] = parameters["decoder.shapes"] * 0.3
parameters["decoder.skin_offset"] = parameters["decoder.skin_offset"] * 0
save_model(sys.argv[1], replace(file, parameters=parameters))
"""
CROSSING = """
import sys
import numpy as np
from ssilk_core.network.checkpoint import load_model
from ssilk_core.physics.intersections.pairs import self_intersections
points, faces = np.load(sys.argv[1]), load_model(sys.argv[2]).scene.garment.mesh.faces
print(sum(len(self_intersections(each.astype(float), faces)) > 0 for each in points))
"""


def crossing(bpy, garment, python: str, folder) -> int:
    """The number of frames in which triangles of the model intersect, as Blender evaluates them, by libigl's test."""
    points = folder / "points.npy"
    np.save(points, shown(bpy, garment, FRAMES))
    words = [python, "-c", CROSSING, str(points), str(model_of(garment))]
    found = subprocess.run(words, check=True, capture_output=True, text=True)
    return int(found.stdout)


def without_ipctk(bpy) -> None:
    preferences = bpy.context.preferences.addons["blender_addon"].preferences
    said = json.loads(preferences.handshake)
    preferences.handshake = json.dumps({**said, "versions": {**said["versions"], "ipctk": None}})


def test_a_certified_bake_does_not_pass_through_itself_in_blender(ready, trained, ssilk_python, tmp_path, capfd):
    ready.context.scene.frame_start, ready.context.scene.frame_end = FRAMES[0], FRAMES[-1]
    subprocess.run([ssilk_python, "-c", TAMED, str(model_of(trained))], check=True)
    activate(ready, trained)
    assert ready.ops.ssilk.bake(pre_roll=0) == {"FINISHED"}
    assert crossing(ready, trained, ssilk_python, tmp_path)
    assert "frames intersect" not in capfd.readouterr().out
    trained.ssilk.certify = True
    assert ready.ops.ssilk.bake(pre_roll=0) == {"FINISHED"}
    assert f"0 of {len(FRAMES)} frames intersect, 0 show covered skin" in capfd.readouterr().out
    assert crossing(ready, trained, ssilk_python, tmp_path) == 0


def test_the_panel_has_it_where_the_python_has_ipctk_and_else_says_what_to_install(ready, trained):
    from blender_addon.panels.playback import BakingPanel

    assert "certify" in drawn(BakingPanel, ready.context)
    without_ipctk(ready)
    notes = drawn(BakingPanel, ready.context)
    assert "certify" not in notes and "To certify bakes, install ssilk[certify] in" in " ".join(notes)


def test_a_garment_that_is_certified_elsewhere_is_not_baked_without(ready, trained):
    trained.ssilk.certify = True
    without_ipctk(ready)
    with pytest.raises(RuntimeError, match=r"install ssilk\[certify\] in .*, or switch Certify off\."):
        ready.ops.ssilk.bake()
