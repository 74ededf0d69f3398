# SPDX-License-Identifier: Apache-2.0
"""Proxies that an artist moved, added, deleted, reparented and repainted outlive a rig that is generated anew."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, activate
from .scenes import proxies_of, weights_of


@pytest.fixture
def edit(ready, rigged):
    """A function that changes edit bones by hand, and leaves the garment active."""

    def run(change):
        armature = ready.data.objects["Rig"]
        activate(ready, armature)
        ready.ops.object.mode_set(mode="EDIT")
        change(armature.data.edit_bones)
        ready.ops.object.mode_set(mode="OBJECT")
        activate(ready, rigged)

    return run


def edits_of(bpy, thing):
    from blender_addon.rigging.edit_tracking import find_edits

    return find_edits(bpy.data.objects["Rig"], thing)


def heads(bpy) -> dict[str, tuple[float, ...]]:
    return {bone.name: tuple(bone.head_local) for bone in bpy.data.objects["Rig"].data.bones}


def parents(bpy) -> dict[str, str]:
    return {bone.name: bone.parent.name for bone in bpy.data.objects["Rig"].data.bones if bone.parent}


def test_a_fresh_rig_has_no_edits(ready, rigged):
    assert edits_of(ready, rigged).summary == ""


def test_the_same_again_is_the_same(ready, rigged):
    places, weights = heads(ready), weights_of(rigged)
    ready.ops.ssilk.generate_rig(proxies=6)
    assert (heads(ready), edits_of(ready, rigged).summary) == (places, "")
    np.testing.assert_array_equal(weights_of(rigged), weights)


def test_what_was_moved_stays_where_it_is(ready, rigged, edit):
    name = proxies_of(ready)[2]
    weights = weights_of(rigged)

    def move(bones):
        for end in ("head", "tail"):
            getattr(bones[name], end).x += 0.02

    edit(move)
    assert edits_of(ready, rigged).summary == "1 moved"
    moved = heads(ready)
    for _ in range(2):
        ready.ops.ssilk.generate_rig(proxies=6)
        assert (heads(ready), edits_of(ready, rigged).summary) == (moved, "1 moved")
        np.testing.assert_allclose(weights_of(rigged), weights, atol=1e-6)
    ready.ops.ssilk.generate_rig(proxies=6, keep_edits=False)
    assert heads(ready) != moved


def test_renaming_is_no_edit_but_stays_with_what_was_moved(ready, rigged, edit):
    first, second = proxies_of(ready)[:2]

    def rename(bones):
        bones[first].name = "Train.L"
        bones[second].name = "Train.R"
        bones["Train.R"].tail.x += 0.05

    edit(rename)
    assert edits_of(ready, rigged).summary == "1 moved"
    ready.ops.ssilk.generate_rig(proxies=6)
    assert "Train.R" in proxies_of(ready)
    assert "Train.R" in rigged.vertex_groups
    assert len(proxies_of(ready)) == 6


def test_what_was_added_stays(ready, rigged, edit):
    above = proxies_of(ready)[1]

    def add(bones):
        bone = bones.new("Ribbon")
        bone.head, bone.tail, bone.parent = (0.4, 0, 0.7), (0.4, 0, 0.6), bones[above]

    edit(add)
    rigged.vertex_groups.new(name="Ribbon").add([0, 1], 1.0, "ADD")
    found = edits_of(ready, rigged)
    assert (found.summary, found.added) == ("1 added, 2 vertices repainted", ("Ribbon",))
    ready.ops.ssilk.generate_rig(proxies=6)
    assert parents(ready)["Ribbon"] == above
    assert len(proxies_of(ready)) == 7
    painted = weights_of(rigged)[:, rigged.vertex_groups["Ribbon"].index]
    assert (painted[:2] > 0.2).all()
    assert not painted[2:].any()
    assert edits_of(ready, rigged).summary == "1 added, 2 vertices repainted"


def test_what_was_deleted_is_not_made_again(ready, rigged, edit):
    leaf = next(name for name in proxies_of(ready) if name not in parents(ready).values())
    edit(lambda bones: bones.remove(bones[leaf]))
    assert edits_of(ready, rigged).summary == "1 deleted"
    for _ in range(2):
        ready.ops.ssilk.generate_rig(proxies=6)
        assert leaf not in proxies_of(ready)
        assert leaf not in rigged.vertex_groups
        assert edits_of(ready, rigged).summary == "1 deleted"
        np.testing.assert_allclose(weights_of(rigged).sum(axis=1), 1, atol=1e-6)


def test_deleting_a_root_changes_nothing_on_those_below(ready, rigged, edit):
    root = next(name for name in proxies_of(ready) if parents(ready)[name] in BONES)
    below = [name for name, above in parents(ready).items() if above == root]
    edit(lambda bones: bones.remove(bones[root]))
    assert edits_of(ready, rigged).summary == "1 deleted"
    ready.ops.ssilk.generate_rig(proxies=6)
    assert all(parents(ready)[name] in BONES for name in below)


def test_what_was_reparented_stays_so(ready, rigged, edit):
    second = proxies_of(ready)[1]

    def reparent(bones):
        bones[second].parent = bones["Spine"]

    edit(reparent)
    assert edits_of(ready, rigged).summary == "1 moved"
    ready.ops.ssilk.generate_rig(proxies=6)
    assert parents(ready)[second] == "Spine"
    assert len(proxies_of(ready)) == 6


def test_a_copy_of_a_proxy_is_an_addition(ready, rigged, edit):
    name = proxies_of(ready)[0]

    def copy(bones):
        source, bone = bones[name], bones.new("Copy")
        bone.head, bone.tail, bone.parent = (0.4, 0, 0.7), (0.4, 0, 0.6), source
        bone["ssilk_made"] = source["ssilk_made"]

    edit(copy)
    assert edits_of(ready, rigged).added == ("Copy",)


def test_repainted_weights_stay(ready, rigged):
    name = next(name for name in proxies_of(ready) if name in rigged.vertex_groups)
    for group in rigged.vertex_groups:
        group.remove([5, 6])
    rigged.vertex_groups[name].add([5, 6], 1.0, "REPLACE")
    assert edits_of(ready, rigged).summary == "2 vertices repainted"
    before = weights_of(rigged)
    ready.ops.ssilk.generate_rig(proxies=6)
    column = rigged.vertex_groups[name].index
    np.testing.assert_allclose(weights_of(rigged)[[5, 6], column], 1, atol=1e-6)
    np.testing.assert_allclose(np.sort(weights_of(rigged)[7:]), np.sort(before[7:]), atol=1e-6)
    assert edits_of(ready, rigged).summary == "2 vertices repainted"


def test_subdividing_is_no_repainting(ready, rigged):
    ready.ops.object.mode_set(mode="EDIT")
    ready.ops.mesh.select_all(action="SELECT")
    ready.ops.mesh.subdivide(number_cuts=1)
    ready.ops.object.mode_set(mode="OBJECT")
    assert len(rigged.data.vertices) > 1000
    assert edits_of(ready, rigged).summary == ""


def test_fewer_proxies_leave_an_edited_one_its_own(ready, rigged, edit):
    """Where no new proxy is near, a moved one stays beside the new ones, as if it had been added."""
    name = proxies_of(ready)[-1]

    def move(bones):
        bones[name].tail.z -= 0.03

    edit(move)
    ready.ops.ssilk.generate_rig(proxies=3)
    assert name in proxies_of(ready)
    assert len(proxies_of(ready)) in {3, 4}
    np.testing.assert_allclose(weights_of(rigged).sum(axis=1), 1, atol=1e-6)


@pytest.fixture
def dressed_up(ready, rigged):
    """The skirt with weights of chance put on as trained ones, after its vertex 5 was repainted; both weights."""
    from blender_addon.scene.weights import put_trained_weights

    armature, names = ready.data.objects["Rig"], [*BONES, *proxies_of(ready)]
    for group in rigged.vertex_groups:
        group.remove([5])
    rigged.vertex_groups["Hips"].add([5], 1.0, "REPLACE")
    before = named_weights(rigged, names)
    learned = np.random.default_rng(0).dirichlet(np.ones(len(names)), len(rigged.data.vertices)).astype(np.float32)
    put_trained_weights(armature, rigged, learned, names)
    return names, before, learned


def named_weights(thing, names) -> np.ndarray:
    columns = [thing.vertex_groups[name].index if name in thing.vertex_groups else -1 for name in names]
    return np.pad(weights_of(thing), ((0, 0), (0, 1)))[:, columns]


def test_trained_weights_are_no_repainting_and_repainted_vertices_stay_known(ready, rigged, dressed_up):
    names, before, learned = dressed_up
    np.testing.assert_allclose(named_weights(rigged, names), learned, atol=1e-6)
    found = edits_of(ready, rigged)
    assert (found.summary, np.flatnonzero(found.repainted).tolist()) == ("1 vertices repainted", [5])
    ready.ops.ssilk.generate_rig(proxies=6)
    np.testing.assert_allclose(named_weights(rigged, names)[5], before[5], atol=1e-5)
    assert np.count_nonzero(weights_of(rigged)[6]) < len(names)
    assert not any(attribute.name.startswith(("ssilk:own", "ssilk:worn")) for attribute in rigged.data.attributes)


def test_trained_weights_come_off_again_but_for_what_was_painted_on_them(ready, rigged, dressed_up):
    from blender_addon.scene.gather import gather
    from blender_addon.scene.weights import has_trained_weights, put_trained_weights, restore_own_weights

    names, before, learned = dressed_up
    armature = ready.data.objects["Rig"]
    now = gather(rigged).rig.skin.dense(len(names))  # what is trained on
    np.testing.assert_allclose(now, before, atol=1e-6)
    ready.data.armatures[armature.data.name].bones[names[-1]].name = "Renamed"
    names[-1] = "Renamed"
    for group in rigged.vertex_groups:
        group.remove([9])
    rigged.vertex_groups["Spine"].add([9], 1.0, "REPLACE")
    put_trained_weights(armature, rigged, learned, names)  # once more, as by a second bake
    restore_own_weights(armature, rigged)
    wanted = before.copy()
    wanted[9] = [name == "Spine" for name in names]
    np.testing.assert_allclose(named_weights(rigged, names), wanted, atol=1e-6)
    assert not has_trained_weights(rigged) and np.flatnonzero(edits_of(ready, rigged).repainted).tolist() == [5, 9]


def test_a_garment_without_weights_of_its_own_has_none_again(ready, skirt):
    from blender_addon.scene.weights import has_trained_weights, own_groups, put_trained_weights, restore_own_weights

    armature, weights = ready.data.objects["Rig"], np.full((len(skirt.data.vertices), 3), 1 / 3, dtype=np.float32)
    put_trained_weights(armature, skirt, weights, BONES)
    assert len(skirt.vertex_groups) == 3 and not own_groups(armature, skirt, BONES).any()
    restore_own_weights(armature, skirt)
    assert not skirt.vertex_groups and not has_trained_weights(skirt)


def test_writing_weights_leaves_shape_keys_and_attributes_alone(ready, skirt):
    from blender_addon.scene.weights import read_groups, write_groups

    skirt.shape_key_add(name="Basis")
    longer = skirt.shape_key_add(name="Longer", from_mix=False)
    for point in longer.data:
        point.co.z -= 0.1
    skirt.active_shape_key_index = 1
    skirt.vertex_groups.new(name="Pin").add([3, 4], 0.5, "REPLACE")
    skirt.data.attributes.new("mine", "INT", "FACE").data[2].value = 7

    def state() -> tuple:
        keys = [[tuple(point.co) for point in key.data] for key in skirt.data.shape_keys.key_blocks]
        places = [tuple(vertex.co) for vertex in skirt.data.vertices]
        return (
            keys,
            places,
            read_groups(skirt, skirt.data, ["Pin"]).tolist(),
            skirt.data.attributes["mine"].data[2].value,
        )

    before = state()
    weights = np.random.default_rng(1).dirichlet(np.ones(3), len(skirt.data.vertices)).astype(np.float32)
    for _ in range(2):
        write_groups(skirt, weights, BONES, ())
        np.testing.assert_array_equal(read_groups(skirt, skirt.data, BONES), weights)
    assert state() == before


def test_the_dialog_says_what_there_is_to_keep(ready, rigged, edit):
    from blender_addon.operators.rig import edits_line

    assert edits_line(rigged) == "By hand: nothing"
    edit(lambda bones: bones.remove(bones[proxies_of(ready)[-1]]))
    assert edits_line(rigged) == "By hand: 1 deleted"


def test_a_vertex_group_that_no_bone_moves_is_no_edit_of_a_rig(ready, rigged):
    """As a group of pins, whose vertices nobody has repainted."""
    from blender_addon.rigging.edit_tracking import find_edits

    rigged.vertex_groups.new(name="Pins").add(list(range(28)), 1.0, "REPLACE")
    assert find_edits(ready.data.objects["Rig"], rigged).summary == ""
    rigged.vertex_groups["Hips"].add([5], 0.123, "REPLACE")
    assert find_edits(ready.data.objects["Rig"], rigged).summary == "1 vertices repainted"
