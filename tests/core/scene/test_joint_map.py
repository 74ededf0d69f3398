# SPDX-License-Identifier: Apache-2.0
"""Maps of joints between two characters: read, written, and refused where they are not sound."""

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Skeleton, SkinWeights
from ssilk_core.scene.joint_map import (
    JointMap,
    named_side,
    read_joint_map,
    size_ratio,
    weights_left,
    write_joint_map,
)

PLACES = {
    "Hips": (0, 1.0, 0), "Spine": (0, 1.2, 0), "Head": (0, 1.6, 0), "LeftArm": (0.2, 1.4, 0),
    "LeftHand": (0.7, 1.4, 0), "RightArm": (-0.2, 1.4, 0), "RightHand": (-0.7, 1.4, 0),
}  # fmt: skip
PARENTS = {"Spine": "Hips", "Head": "Spine", "LeftArm": "Spine", "LeftHand": "LeftArm", "RightArm": "Spine",
           "RightHand": "RightArm"}  # fmt: skip
ITS = {"Hips": "pelvis", "Spine": "spine_01", "Head": "head", "LeftArm": "upperarm_l", "LeftHand": "hand_l",
       "RightArm": "upperarm_r", "RightHand": "hand_r"}  # fmt: skip


def skeleton(path: str, names: dict[str, str]) -> Skeleton:
    """A few joints of a figure, under names of their own."""
    paths, parents, binds = dict[str, str](), [], np.tile(np.eye(4), (len(PLACES), 1, 1))
    for number, (joint, place) in enumerate(PLACES.items()):
        above = PARENTS.get(joint)
        paths[joint] = f"{paths[above]}/{names[joint]}" if above else names[joint]
        parents.append([*PLACES].index(above) if above else -1)
        binds[number, :3, 3] = place
    return Skeleton(path, tuple(paths.values()), parents, binds, binds)


OWN, OTHER = skeleton("hero.usd:/Hero", {name: name for name in PLACES}), skeleton("other.usd:/Other", ITS)

UNSOUND = {
    "a joint that the garment's character lacks": ({"Hipz": "pelvis"}, "has no joint 'Hipz'.* mean 'Hips'"),
    "a joint that the other one lacks": ({"Spine": "spine_1"}, "has no joint 'spine_1'.* mean 'spine_01'"),
    "a joint that stands for two": ({"Head": "spine_01"}, "'spine_01' stands for both 'Spine' and 'Head'"),
    "no hub": ({"Hips": ""}, "no joint stands for 'Hips', which carries the body"),
    "left for right": ({"LeftHand": "hand_r", "RightHand": "hand_l"}, "'hand_r' for 'LeftHand' hangs from"),
    "arms that are swapped": (
        {"LeftArm": "upperarm_r", "LeftHand": "hand_r", "RightArm": "upperarm_l", "RightHand": "hand_l"},
        "'upperarm_r' on the right stands for 'LeftArm' on the left",
    ),
    "a child above its parent": ({"Spine": "head", "Head": "spine_01"}, "'head' for 'Spine'|for 'LeftArm' hangs"),
    "a hand for the head": (
        {"LeftArm": "", "LeftHand": "head", "Head": "hand_l"},
        "of 'hand_l' and 'Head' one is in the middle of the body and one far beside it",
    ),
}  # fmt: skip


def test_a_sound_map_says_which_joint_stands_for_which():
    images = JointMap("map.toml", {**ITS, "Head": ""}).images(OWN, OTHER)
    assert images.tolist() == [0, 1, -1, 3, 4, 5, 6]


@pytest.mark.parametrize("case", UNSOUND)
def test_an_unsound_map_is_refused_in_one_sentence(case):
    change, told = UNSOUND[case]
    with pytest.raises(SsilkError, match=told) as raised:
        JointMap("map.toml", {**ITS, **change}).images(OWN, OTHER)
    assert str(raised.value).startswith("map.toml") and str(raised.value).count(". ") == 0


def test_sides_without_names_are_told_by_their_places():
    names = {**ITS, "LeftArm": "a1", "LeftHand": "a2", "RightArm": "b1", "RightHand": "b2"}
    nameless = skeleton("other.usd:/Other", names)
    loose = replace(nameless, parents=[-1, *[0] * 6])  # as deforming bones of control rigs may hang
    JointMap("map.toml", names).images(OWN, loose)
    with pytest.raises(SsilkError, match="is on the other side of the body"):
        JointMap("map.toml", {**names, "LeftHand": "b2", "RightHand": "a2"}).images(OWN, loose)


def test_files_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "map.toml"
    write_joint_map(path, JointMap("x", {"Hips": "mixamorig:Hips", "a b": ""}, {"Hips": "by name"}), "One.\nTwo.")
    assert path.read_text().startswith("# One.\n# Two.\n[joints]\n") and "# by name" in path.read_text()
    assert read_joint_map(path).names == {"Hips": "mixamorig:Hips", "a b": ""}


@pytest.mark.parametrize(
    ("text", "told"),
    [("[joints", "not a TOML file"), ("[bones]\nA = 'b'", "tables bones"), ("", "tables none"),
     ("joints = 3", "tables joints"), ("[joints]\nHips = 3", "'Hips': 3 stands for it")],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, text, told):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(SsilkError, match=told):
        read_joint_map(tmp_path / "map.toml")
    with pytest.raises(SsilkError, match=r"there is no such file.*inspect --onto"):
        read_joint_map(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("name", "side"),
    [("LHipJoint", "left"), ("LeftUpLeg", "left"), ("lowerarm_l", "left"), ("R_Hip", "right"),
     ("thigh_L_001", "left"), ("DEF_upper_arm_R", "right"), ("Bip01_L_Thigh", "left"), ("rShldr", "right"),
     ("handL", "left"), ("lowerarm", None), ("root", None), ("ROOT", None), ("Spine", None), ("clavicle", None)],
)  # fmt: skip
def test_names_tell_sides(name, side):
    assert named_side(name) == side


def test_size_is_told_by_bones():
    binds = np.array(OTHER.bind_transforms)
    binds[:, :3, 3] *= 1.3
    larger = Skeleton(OTHER.path, OTHER.joint_names, OTHER.parents, binds, binds)
    assert size_ratio(OWN, larger, np.arange(7)) == pytest.approx(1.3)


def test_weight_on_joints_that_none_stands_for_is_told_where_they_are_away_from_the_next():
    skin = SkinWeights("cloth", np.array([[0, 4]]), np.array([[0.4, 0.6]]))
    images = np.array([0, 1, 2, 3, -1, 5, 6])
    assert weights_left(skin, OWN, images) == [(4, pytest.approx(0.6))]
    assert weights_left(skin, OWN, np.arange(7)) == []
