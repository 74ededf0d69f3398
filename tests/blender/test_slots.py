# SPDX-License-Identifier: Apache-2.0
"""Actions with a slot for each of several characters: each plays its own, whatever became of its name."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate, add_armature, make_meta

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


def posed(bpy, armature, frames: range) -> np.ndarray:
    """Return where Blender shows the bones in its timeline, shape (F, bones, 4, 4)."""
    from blender_addon.motions.sampling import worlds

    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found.append(worlds(armature.evaluated_get(bpy.context.evaluated_depsgraph_get())))
    return np.array(found)


def sampled(bpy, armature, kind: str, name: str, track: str = "") -> np.ndarray:
    """Return where a motion that is sampled by itself has the bones, likewise."""
    from blender_addon.motions.sampling import prepare_takes, sample
    from blender_addon.motions.sources import Source
    from blender_addon.scene.armature import read_joints

    joints = read_joints(armature, bpy.data.objects["Skirt"]).character
    (take,) = prepare_takes(armature, [Source(kind, name, track)])
    assert list(sample(armature, joints, [take]))
    return np.array(take.worlds)


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


def play(action, *things) -> None:
    """Assign an action as an artist does; Blender chooses the slots."""
    for thing in things:
        thing.animation_data.action = action


def empty(bpy, name: str):
    thing = bpy.data.objects.new(name, None)
    bpy.context.collection.objects.link(thing)
    return thing


def above(bpy, rig):
    rig.parent = empty(bpy, "Root")
    return rig.parent, "location"


def looked_at(bpy, rig):
    constraint = rig.pose.bones["Head"].constraints.new("DAMPED_TRACK")
    constraint.target = empty(bpy, "Target")
    return constraint.target, "location"


def another_rig(bpy, rig):
    """The artist animates control bones that the deforming ones copy."""
    control = add_armature(bpy)
    for bone in rig.pose.bones:
        constraint = bone.constraints.new("COPY_TRANSFORMS")
        constraint.target, constraint.subtarget = control, bone.name
    return control, 'pose.bones["Spine"].location'


def its_data(bpy, rig):
    """A switch of the rig that is a property of the armature's data."""
    rig.data["held"] = 0.0
    rig.data.update_tag()
    constraint = rig.pose.bones["Head"].constraints.new("LIMIT_LOCATION")
    constraint.use_min_x, constraint.min_x, constraint.owner_space = True, 0.7, "LOCAL"
    driver = constraint.driver_add("influence").driver
    target = driver.variables.new().targets[0]
    target.id_type, target.id, target.data_path, driver.expression = "ARMATURE", rig.data, '["held"]', "var"
    return rig.data, '["held"]'


@pytest.fixture
def controlled(bpy, skirt, request):
    """A rig and what moves it besides its own keys, both with slots in two actions, of which the second plays."""
    from blender_addon.motions.keys import SLOTS

    if not SLOTS:
        pytest.skip("actions have no slots before Blender 4.4")
    rig = skirt.ssilk.armature = bpy.data.objects["Rig"]
    control, path = request.param(bpy, rig)
    for name, size in (("Walk", 0.3), ("Run", 1.5)):
        action = bpy.data.actions.new(name)
        action.use_fake_user = True
        for thing, moved in ((rig, 'pose.bones["Spine"].location'), (control, path)):
            animation = thing.animation_data_create()
            animation.action, animation.action_slot = action, action.slots.new(thing.id_type, thing.name)
            curve = action.fcurve_ensure_for_datablock(thing, moved, index=0)
            for frame, value in ((1, 0.0), (20, size)):
                curve.keyframe_points.insert(frame, value)
    return rig, control


CONTROLS = (above, looked_at, another_rig, its_data)


@pytest.mark.parametrize("controlled", CONTROLS, indirect=True)
def test_what_has_a_slot_in_an_action_plays_it_along(bpy, controlled):
    from blender_addon.motions.sources import ACTION, Source, mixed_motions

    rig, control = controlled
    walk, run = bpy.data.actions["Walk"], bpy.data.actions["Run"]
    play(walk, rig, control)
    shown = posed(bpy, rig, range(1, 21))
    play(run, rig, control)
    assert np.abs(posed(bpy, rig, range(1, 21)) - shown).max() > 0.1
    np.testing.assert_allclose(sampled(bpy, rig, ACTION, "Walk"), shown, atol=1e-6)
    assert (control.animation_data.action, control.animation_data.use_nla) == (run, True)
    assert mixed_motions(rig, [Source(ACTION, "Walk")]) == ""


@pytest.mark.parametrize("controlled", CONTROLS, indirect=True)
def test_what_moves_a_rig_by_an_action_of_its_own_is_told(bpy, controlled):
    from blender_addon.motions.sources import ACTION, TIMELINE, Source, mixed_motions

    rig, control = controlled
    own, mine = bpy.data.actions["Run"].copy(), control.animation_data.action_slot.identifier
    control.animation_data.action, control.animation_data.action_slot = own, own.slots[mine]
    for action in (bpy.data.actions["Walk"], bpy.data.actions["Run"]):
        action.slots.remove(action.slots[mine])
    assert mixed_motions(rig, [Source(TIMELINE, "Timeline")]) == ""
    told = mixed_motions(rig, [Source(ACTION, "Walk")])
    assert told.startswith(f"'{control.name}' moves 'Rig', too: while 'Walk' is sampled, it moves as on")
    control.animation_data_clear()
    assert mixed_motions(rig, [Source(ACTION, "Walk")]) == ""


def test_a_strip_plays_though_another_track_is_solo(bpy, cast):
    from blender_addon.motions.sources import STRIP

    hero, _villain, action = cast
    slot, animation = hero.animation_data.action_slot, hero.animation_data
    animation.action = None
    for number in range(2):
        strip = animation.nla_tracks.new().strips.new("Walk", 1 + 50 * number, action)
        strip.action_slot, strip.scale = slot, 2.0 + number
    track, other = animation.nla_tracks
    other.mute = True
    first, last = (round(end) for end in (track.strips[0].frame_start, track.strips[0].frame_end))
    shown = posed(bpy, hero, range(first, last + 1))
    other.mute, other.is_solo = False, True
    found = sampled(bpy, hero, STRIP, track.strips[0].name, track.name)
    np.testing.assert_allclose(found, shown, atol=1e-6)
    assert (track.is_solo, other.is_solo, track.mute, other.mute) == (False, True, False, False)


def test_a_transition_is_sampled_between_its_strips(bpy, cast):
    from blender_addon.motions.sources import STRIP

    hero, _villain, action = cast
    slot, animation = hero.animation_data.action_slot, hero.animation_data
    animation.action = None
    track = animation.nla_tracks.new()
    for number in range(2):
        strip = track.strips.new("Walk", 1 + 40 * number, action)
        strip.action_slot, strip.extrapolation = slot, "NOTHING"
    activate(bpy, hero)
    window = bpy.context.window_manager.windows[0]
    area = window.screen.areas[0]
    before, area.ui_type = area.ui_type, "NLA_EDITOR"
    track.select = True
    for strip in track.strips:
        strip.select = True
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        assert bpy.ops.nla.transition_add() == {"FINISHED"}
    area.ui_type = before
    (between,) = (strip for strip in track.strips if strip.type == "TRANSITION")
    shown = posed(bpy, hero, range(round(between.frame_start), round(between.frame_end) + 1))
    assert np.ptp(shown, axis=0).max() > 0.01
    np.testing.assert_allclose(sampled(bpy, hero, STRIP, between.name, track.name), shown, atol=1e-6)


def test_an_action_of_a_bone_whose_name_has_quotes_is_found(bpy, cast):
    from blender_addon.motions.sources import sources

    hero, _villain, action = cast
    hero.data.bones["Spine"].name = 'Bip01 "Spine"'
    assert [source.name for source in sources(hero)] == ["Timeline", action.name]


@pytest.mark.parametrize("controlled", [above], indirect=True)
def test_a_slot_that_nothing_plays_is_told(bpy, controlled):
    """The action came from another file, where the empty above had another name."""
    from blender_addon.motions.sources import ACTION, Source, mixed_motions

    rig, root = controlled
    assert mixed_motions(rig, [Source(ACTION, "Walk")]) == ""
    root.animation_data_clear()
    root.name = "Hero root"
    told = mixed_motions(rig, [Source(ACTION, "Walk")])
    assert told.startswith(
        "The slot 'Root' of the action 'Walk' is played by nothing, and 'Rig' leans on 'Hero root';"
    )
    rig.parent = None
    assert mixed_motions(rig, [Source(ACTION, "Walk")]) == ""


@pytest.mark.parametrize("controlled", [above], indirect=True)
def test_a_strip_beside_an_action_of_the_empty_above_is_told(bpy, controlled):
    from blender_addon.motions.sources import STRIP, Source, mixed_motions

    rig, root = controlled
    strip = rig.animation_data.nla_tracks.new().strips.new("Walk", 1, bpy.data.actions["Walk"])
    source = Source(STRIP, strip.name, rig.animation_data.nla_tracks[0].name)
    assert mixed_motions(rig, [source]).startswith("'Root' moves 'Rig', too: while")
    root.animation_data.nla_tracks.new().strips.new("Walk", 1, bpy.data.actions["Walk"])
    root.animation_data.action = None
    assert mixed_motions(rig, [source]) == ""  # its strips play along


def test_shape_keys_that_change_in_the_action_that_is_chosen_are_told(bpy, cast):
    from types import SimpleNamespace

    from blender_addon.motions.shapes import tell_changing_shapes
    from blender_addon.motions.sources import ACTION, Source

    hero, _villain, action = cast
    pillar, said = bpy.data.objects["Pillar"], []
    bpy.data.objects["Skirt"].ssilk.armature = hero
    pillar.shape_key_add(name="Basis")
    breath, keys = pillar.shape_key_add(name="Breath"), pillar.data.shape_keys
    keys.animation_data_create().action = action
    keys.animation_data.action_slot = action.slots.new("KEY", keys.name)
    for frame, breath.value in ((1, 0.0), (12, 1.0)):
        breath.keyframe_insert("value", frame=frame)
    keys.animation_data.action = None
    operator = SimpleNamespace(report=lambda kind, text: said.append(text))
    tell_changing_shapes(operator, bpy.data.objects["Skirt"])
    assert not said
    tell_changing_shapes(operator, bpy.data.objects["Skirt"], [Source(ACTION, action.name)])
    (told,) = said
    assert told.startswith("The shape key 'Breath' of 'Pillar' changes over time")
    assert keys.animation_data.action is None
