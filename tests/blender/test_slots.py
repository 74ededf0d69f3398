# SPDX-License-Identifier: Apache-2.0
"""Actions with a slot for each of several characters: each plays its own, whatever became of its name."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import add_armature, make_meta

HERO, VILLAIN = 0.9, 0.2  # how far they lean [rad]


@pytest.fixture
def cast(bpy, skirt):
    """Two characters with one action, the villain's slot first; the hero wears the skirt."""
    from blender_addon.motions.keys import SLOTS

    if not SLOTS:
        pytest.skip("actions have no slots before Blender 4.4")
    hero = bpy.data.objects["Rig"]
    hero.name = "Hero"
    villain = add_armature(bpy)
    villain.name = "Villain"
    action = bpy.data.actions.new("Walk")
    action.use_fake_user = True
    for thing, lean, last in ((villain, VILLAIN, 30), (hero, HERO, 12)):
        animation = thing.animation_data_create()
        animation.action, animation.action_slot = action, action.slots.new("OBJECT", thing.name)
        bone = thing.pose.bones["Spine"]
        bone.rotation_mode = "XYZ"
        for frame in (1, last):
            bone.rotation_euler.x = lean * frame / last
            bone.keyframe_insert("rotation_euler", frame=frame)
    return hero, villain, action


def leaning(bpy, armature, action, frame: int) -> float:
    """Return by how much the spine leans in a sampled frame of the action [rad]."""
    from blender_addon.motions.sampling import prepare_takes, sample
    from blender_addon.motions.sources import ACTION, Source
    from blender_addon.scene.armature import read_joints

    joints = read_joints(armature, bpy.data.objects["Skirt"]).character
    (take,) = prepare_takes(armature, [Source(ACTION, action.name)])
    assert list(sample(armature, joints, [take]))
    spine = take.worlds[frame - take.frames.start][joints.names.index("Spine")]
    rest = np.array(armature.data.bones["Spine"].matrix_local)
    turned = spine[:3, :3] @ rest[:3, :3].T
    return float(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))


def on_a_strip(bpy, hero, villain, action) -> None:
    slot = hero.animation_data.action_slot
    hero.animation_data.action = None
    strip = hero.animation_data.nla_tracks.new().strips.new("Walk", 1, action)
    strip.action_slot = slot


def let_go(bpy, hero, villain, action) -> None:
    hero.animation_data_clear()


def after_another_action(bpy, hero, villain, action) -> None:
    on_a_strip(bpy, hero, villain, action)
    hero.animation_data.action = bpy.data.actions.new("Other")
    hero.animation_data.action_slot = hero.animation_data.action.slots.new("OBJECT", "Else")


@pytest.mark.parametrize("rename", [("Hero", "Villain"), ("Held", "Villain"), ("Held", "Hero"), ("Villain", "Hero")])
@pytest.mark.parametrize("change", [on_a_strip, after_another_action, let_go])
def test_each_character_plays_its_own_slot(bpy, cast, change, rename):
    hero, villain, action = cast
    change(bpy, *cast)
    hero.name, villain.name = "Aside", "Beside"
    hero.name, villain.name = rename
    assert leaning(bpy, hero, action, 12) == pytest.approx(HERO, abs=1e-4)


@pytest.mark.parametrize("muted", [True, False])
def test_a_strip_of_another_characters_slot_does_not_make_that_slot_its_own(bpy, cast, muted):
    """A strip that was left over, or that borrows the villain's motion, stands below the own one."""
    hero, villain, action = cast
    own, theirs = hero.animation_data.action_slot, villain.animation_data.action_slot
    hero.animation_data.action = None
    for number, slot in enumerate((theirs, own)):
        track = hero.animation_data.nla_tracks.new()
        track.strips.new(f"Strip{number}", 1 + 50 * number, action).action_slot = slot
        track.mute = muted and slot == theirs
    if muted:
        hero.name = "Renamed"
    assert leaning(bpy, hero, action, 12) == pytest.approx(HERO, abs=1e-4)


def test_strips_in_a_meta_strip_tell_the_own_slot(bpy, cast):
    hero, villain, action = cast
    after_another_action(bpy, *cast)
    make_meta(bpy, hero, hero.animation_data)
    villain.animation_data_clear()
    hero.name, villain.name = "Villain", "Hero"
    assert leaning(bpy, hero, action, 12) == pytest.approx(HERO, abs=1e-4)


def test_a_strip_that_is_tweaked_is_told(bpy, cast):
    from blender_addon.errors import SetupError

    hero, _villain, action = cast
    on_a_strip(bpy, *cast)
    hero.animation_data.nla_tracks[0].select = hero.animation_data.nla_tracks[0].strips[0].select = True
    hero.animation_data.use_tweak_mode = True
    with pytest.raises(SetupError, match="A strip of 'Hero' is being tweaked; leave tweak mode"):
        leaning(bpy, hero, action, 12)


def test_the_action_of_a_twin_whose_other_slot_is_free_is_refused(bpy, cast, tmp_path):
    """The twin came from the same file; what it had in this action is played by the other one alone."""
    from blender_addon.errors import SetupError

    hero, villain, action = cast
    on_a_strip(bpy, *cast)
    bpy.data.objects.remove(villain)
    path = str(tmp_path / "hero.blend")
    bpy.data.libraries.write(path, {hero})
    with bpy.data.libraries.load(path) as (_, wanted):
        wanted.objects = ["Hero"]
    (twin,) = wanted.objects
    bpy.context.collection.objects.link(twin)
    twin.name = "Guest"
    (own,) = {strip.action for track in twin.animation_data.nla_tracks for strip in track.strips}
    assert own != action
    assert leaning(bpy, twin, own, 12) == pytest.approx(HERO, abs=1e-4)
    assert leaning(bpy, hero, action, 12) == pytest.approx(HERO, abs=1e-4)
    with pytest.raises(SetupError, match="none is told to be of 'Guest'"):
        leaning(bpy, twin, action, 12)


def test_a_single_strip_that_borrows_anothers_slot_leaves_the_own_motion(bpy, cast):
    from blender_addon.motions.sources import sources

    hero, villain, action = cast
    hero.animation_data.action = None
    strip = hero.animation_data.nla_tracks.new().strips.new("Walk", 1, action)
    strip.action_slot = villain.animation_data.action_slot
    assert leaning(bpy, hero, action, 12) == pytest.approx(HERO, abs=1e-4)
    assert [source.kind for source in sources(hero)] == ["TIMELINE", "ACTION", "STRIP"]


def test_strips_of_several_slots_stand_by_themselves_where_nothing_tells_the_own(bpy, cast):
    from blender_addon.errors import SetupError
    from blender_addon.motions.sources import sources

    hero, villain, action = cast
    slots = [villain.animation_data.action_slot, hero.animation_data.action_slot]
    hero.animation_data_clear()
    hero.name = "Held"
    for number, slot in enumerate(slots):
        track = hero.animation_data_create().nla_tracks.new()
        track.strips.new(f"Strip{number}", 1 + 50 * number, action).action_slot = slot
    hero.animation_data.last_slot_identifier = ""
    assert [source.kind for source in sources(hero)][-2:] == ["STRIP", "STRIP"]
    with pytest.raises(SetupError, match="none is told to be of 'Held'"):
        leaning(bpy, hero, action, 12)


def test_frames_are_those_of_the_slot(bpy, cast):
    from blender_addon.motions.sources import ACTION, Source, frames_of

    hero, villain, _ = cast
    assert frames_of(hero, Source(ACTION, "Walk")) == range(1, 13)
    assert frames_of(villain, Source(ACTION, "Walk")) == range(1, 31)


def test_a_strip_of_the_own_slot_counts_as_the_action_and_one_of_another_by_itself(bpy, cast):
    from blender_addon.motions.sources import sources

    hero, villain, action = cast
    on_a_strip(bpy, *cast)
    assert [source.kind for source in sources(hero)] == ["TIMELINE", "ACTION"]
    other = hero.animation_data.nla_tracks.new().strips.new("Villain's", 100, action)
    other.action_slot = villain.animation_data.action_slot
    # Before Blender 5.0 a new strip is called after its action, whatever name is given.
    assert [(source.kind, source.name) for source in sources(hero)][2:] == [("STRIP", other.name)]


def test_an_action_whose_slot_nobody_tells_is_refused_with_their_names(bpy, cast):
    hero, villain, action = cast
    hero.animation_data_clear()
    villain.animation_data_clear()
    hero.name = "Held"
    from blender_addon.errors import SetupError

    with pytest.raises(SetupError, match=r"has the slots 'Villain', 'Hero', and none is told to be of 'Held'"):
        leaning(bpy, hero, action, 12)
