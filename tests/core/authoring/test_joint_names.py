# SPDX-License-Identifier: Apache-2.0
"""Joints of other rigs are found by their names, and where these say nothing by their places."""

import numpy as np
import pytest

from ssilk_core.authoring.bodies.joint_names import propose
from ssilk_core.scene.assets import Skeleton

from ..humanoids import PARTS, SCHEMES, humanoid

OWN = humanoid(SCHEMES["cmu"])


def parts_found(names, own, other, kept=PARTS):
    """Which part of the other figure stands for each part of the own one."""
    back = {name: part for part, name in names.items()}
    found = propose(own, other, "map.toml")
    found.images(own, other)  # raises unless it is sound
    return {part: back.get(found.names[SCHEMES["cmu"][part]], "") for part in kept}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_each_program_names_its_joints_otherwise_and_all_are_found(scheme):
    for arms in (45.0, 0.0):
        other = humanoid(SCHEMES[scheme], arms=arms, size=1.1, axes=3)
        assert parts_found(SCHEMES[scheme], OWN, other) == {part: part for part in PARTS}


@pytest.mark.parametrize("scheme", ["mixamo", "unreal", "smpl", "numbers"])
def test_a_figure_that_faces_another_way_keeps_its_sides(scheme):
    other = humanoid(SCHEMES[scheme], arms=0, turn=180)
    assert parts_found(SCHEMES[scheme], OWN, other) == {part: part for part in PARTS}


def test_a_shorter_spine_leaves_one_joint_out_and_a_longer_one_is_matched_in_order():
    shorter = humanoid(SCHEMES["unreal"], without=("spine2",))
    found = parts_found(SCHEMES["unreal"], OWN, shorter)
    assert found == {part: "" if part == "spine2" else part for part in PARTS}
    own = humanoid(SCHEMES["cmu"], without=("spine2",))
    kept = [part for part in PARTS if part != "spine2"]
    found = parts_found(SCHEMES["unreal"], own, humanoid(SCHEMES["unreal"]), kept)
    assert found == {part: part for part in kept}


def test_the_file_says_how_each_was_found():
    named = propose(OWN, humanoid(SCHEMES["unreal"]), "map.toml").notes
    assert named["LeftArm"] == "by name" and named["Hips"] == "carries the body"
    by_place = propose(OWN, humanoid(SCHEMES["numbers"]), "map.toml").notes
    assert by_place["LeftArm"].startswith("by place, 0 %")
    left = propose(OWN, humanoid(SCHEMES["unreal"], without=("left hand",)), "map.toml")
    assert left.names["LeftHand"] == "" and left.notes["LeftHand"] == "none: moves with LeftForeArm"


@pytest.mark.parametrize("controls", [False, True], ids=["deforming joints alone", "a control rig"])
def test_limbs_of_a_control_rig_that_have_roots_of_their_own_are_found(controls):
    names = SCHEMES["rigify"]
    whole = humanoid(names, arms=30)
    # As only deforming joints are exported, or beside joints of the same names that control them.
    parents = np.array(whole.parents)
    loose = [PARTS.index(f"{side} {part}") for side in ("left", "right") for part in ("collar", "upper arm", "thigh")]
    parents[loose] = -1
    binds, paths = whole.bind_transforms, [name.rpartition("/")[2] for name in whole.joint_names]
    if controls:
        others = [f"ORG{name.removeprefix('DEF')}" for name in paths]
        paths, binds = others + paths, np.concatenate([binds, binds])
        parents = np.concatenate([whole.parents, np.where(parents < 0, -1, parents + len(PARTS))])
    other = Skeleton("/rigify", tuple(paths), parents, binds, binds, hub=len(paths) - 1)  # a foot, as a hub may be
    assert parts_found(names, OWN, other) == {part: part for part in PARTS}
