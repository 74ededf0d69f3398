# SPDX-License-Identifier: Apache-2.0
"""Make It Move takes some of each kind of motion, as much as a training needs."""

from __future__ import annotations

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.arrays.enough import enough, kind_of

from .conftest import activate

KINDS = ("1H_Melee_Attack_Chop", "Running_A", "Running_B", "RunningC", "Walking.001", "Idle", "Idle_2", "2H_Idle")


def test_names_tell_kinds():
    assert [kind_of(name) for name in KINDS] == [
        "melee", "running", "running", "running", "walking", "idle", "idle", "idle",
    ]  # fmt: skip
    assert kind_of("001") == ""


def test_each_kind_comes_before_another_of_one():
    assert [KINDS[index] for index in enough(KINDS, [1.0] * 8, 4.0)] == [
        "1H_Melee_Attack_Chop", "Running_A", "Walking.001", "Idle",
    ]  # fmt: skip
    assert enough(KINDS, [1.0] * 8, 8.0) == list(range(8))
    assert enough(["Long", "Walk"], [100.0, 5.0], 10.0) == [0]
    assert enough(["Walk", "Long", "Run"], [5.0, 100.0, 5.0], 10.0) == [0, 2]


def test_of_many_actions_as_many_are_taken_as_a_draft_needs(bpy, skirt, monkeypatch):
    from blender_addon.operators import make_it_move, training

    armature = bpy.data.objects["Rig"]
    for kind in ("Walk", "Run", "Jump", "Wave"):
        for number in range(19):
            action = bpy.data.actions.new(f"{kind}_{number:02d}")
            action.use_fake_user = True
            armature.animation_data_create().action = action
            for frame in (1, 120):
                armature.pose.bones["Hips"].keyframe_insert("location", frame=frame)
    activate(bpy, skirt)
    monkeypatch.setattr(training, "on_processor", lambda _: True)
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    settings = skirt.ssilk.training
    assert sum(item.use for item in settings.motions) == 76
    told = make_it_move.take_enough(skirt)
    used = [item.name for item in settings.motions if item.use]
    assert told == "Trains on 16 of 76 motions, 80 s; choose others under Training" and len(used) == 16
    assert {name.partition("_")[0]: 4 for name in used} == {"Walk": 4, "Run": 4, "Jump": 4, "Wave": 4}
    settings.preset = "final"
    assert not make_it_move.take_enough(skirt)
