# SPDX-License-Identifier: Apache-2.0
"""Sentences of ssilk in an artist's words."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from blender_addon.outside import jobs
from blender_addon.outside.wording import BONES as OF_BONES
from blender_addon.outside.wording import recall, remember, reworded, with_bones

NAMES = {
    "dressed.usdc:/Character/Skirt": "'Skirt'",
    "dressed.usdc:/Character/Skirt_2": "'Skirt.2'",
    "dressed.usdc": "the character",
    "motions/Walk.usdc": "'Walk'",
}


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("{0}/dressed.usdc:/Character/Skirt: it is torn.", "'Skirt': it is torn."),
        ("dressed.usdc:/Character/Skirt_2: it is torn.", "'Skirt.2': it is torn."),
        ("dressed.usdc:/Character/Other/Part and {0}/dressed.usdc.", "the character and the character."),
        ("{0}/motions/Walk.usdc:/Animation: too short.", "'Walk': too short."),
        ("/home/me/undressed.usdc: no such file.", "/home/me/undressed.usdc: no such file."),
        ("../dressed.usdc, /other/dressed.usdc", "../dressed.usdc, /other/dressed.usdc"),
    ],
)
def test_what_was_made_is_called_what_it_stands_for(said, meant):
    folder = Path("/tmp/a (job) + more")
    assert reworded(said.format(folder), folder, NAMES) == meant


BONES = {"Hips": "Hips", "Hips/Arm_L": "Arm.L", "Hips/Arm_L/handslot_l": "handslot.l", "Hips/Spine": "Spine"}


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("joint 'Hips/Arm_L/handslot_l' is 0.2 m off", "joint 'handslot.l' is 0.2 m off"),
        ("handslot_l, Arm_L and 3 more stand still", "handslot.l, Arm.L and 3 more stand still"),
        ("'Hips' and 'Hips/Spine'; /home/Arm_L/a.usd, Arm_L_2", "'Hips' and 'Spine'; /home/Arm_L/a.usd, Arm_L_2"),
        ("pin it, or paint primvars:ssilk:class", "pin it, or paint its classes"),
    ],
)
def test_joints_are_called_as_the_bones_are(said, meant):
    assert with_bones(said, BONES) == meant


def test_names_are_kept_with_a_training_and_read_with_its_state(tmp_path):
    assert recall(tmp_path) == {}
    remember(tmp_path, NAMES)
    assert recall(tmp_path) == NAMES
    (tmp_path / "state.json").write_text('{"state": "failed", "error": "motions/Walk.usdc: too short."}')
    assert jobs.read_state(tmp_path).error == "'Walk': too short."
    odd = "motions/Walk.usdc: joint 'Hips/Arm_L' jumps, and Hips/Arm_L/handslot_l."
    (tmp_path / "state.json").write_text(json.dumps({"state": "running", "text": odd}))
    remember(tmp_path, BONES, OF_BONES)
    assert jobs.read_state(tmp_path).text == "'Walk': joint 'Arm.L' jumps, and handslot.l."
    (tmp_path / "state.json").write_text('{"state": "failed", "error": "motions/Walk.usdc: too short."}')
    (tmp_path / "names.json").write_text("[")
    assert jobs.read_state(tmp_path).error == "motions/Walk.usdc: too short."
