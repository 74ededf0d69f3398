# SPDX-License-Identifier: Apache-2.0
"""Classes found from the body: what is wrapped, carried, hung, torn or free, on bodies made of cylinders."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from ssilk_core import events
from ssilk_core.authoring.setup.classes import USUAL, ClassOptions, held_classes, hold_levels
from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.authoring.setup.rig import RigOptions
from ssilk_core.authoring.setup.weights import WeightOptions, transfer_weights
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Body,
    Character,
    Garment,
    Mesh,
    Skeleton,
    SkinWeights,
    classes_at,
)  # fmt: skip
from ssilk_core.scene.mesh.topology import components, edges, vertex_areas

SHARED = Path(__file__).parents[4] / "shared" / "data"
RAW = WeightOptions(tight_rounds=0, loose_rounds=0)


def cylinder(radius: float, low: float, high: float, x: float = 0.0) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius, height=high - low, sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    mesh.apply_translation([x, (low + high) / 2, 0])
    return mesh.subdivide().subdivide()


def standing(*limbs: trimesh.Trimesh) -> Character:
    """A character whose limbs each follow a joint of their own, all below one root."""
    names = ("Root", *(f"Root/Limb{number}" for number in range(len(limbs))))
    eye = np.tile(np.eye(4), (len(names), 1, 1))
    bodies = tuple(
        Body(
            Mesh(f"/Limb{number}", limb.vertices, limb.faces),
            SkinWeights("/Limb", np.full((len(limb.vertices), 1), number + 1), np.ones((len(limb.vertices), 1))),
        )
        for number, limb in enumerate(limbs)
    )
    return Character("/Character", Skeleton("/Rig", names, np.r_[-1, np.zeros(len(limbs), int)], eye, eye), bodies)


def tube(
    radii: list[float],
    heights: list[float],
    turn: float = 360.0,
    columns: int = 61,
    rows: int = 41,
    width: float = 0.0,
) -> Mesh:
    """Cloth around the y axis, radius interpolated over height; open at the front when `turn` is under 360.

    `width` draws it out to both sides, so that it goes round two legs that far from the axis.
    """
    y = np.linspace(heights[0], heights[-1], rows)
    radius = np.interp(-y, -np.array(heights), radii)
    closed = turn == 360
    angle = np.radians(180 + np.linspace(-turn / 2, turn / 2, columns, endpoint=not closed))
    x = np.sin(angle) * radius[:, None] + np.clip(2 * np.sin(angle), -1, 1) * width
    points = np.stack([x, np.broadcast_to(y[:, None], x.shape), np.cos(angle) * radius[:, None]], axis=-1)
    at = np.arange(rows * columns).reshape(rows, columns)
    at = np.column_stack([at, at[:, :1]]) if closed else at
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return Mesh("/Tube", points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def found(character: Character, mesh: Mesh, options: ClassOptions | None = None) -> np.ndarray:
    return usual_classes(character, mesh, transfer_weights(character, mesh, options=RAW), options)


def usual_classes(
    character: Character, mesh: Mesh, skin: SkinWeights, options: ClassOptions | None = None
) -> np.ndarray:
    return held_classes(mesh, hold_levels(character, mesh, skin, options, ladder=[USUAL]), USUAL)


@pytest.fixture(scope="module")
def trunk() -> Character:
    return standing(cylinder(0.15, 0.0, 1.5))


def test_close_tube_is_held_and_hangs_from_its_top(trunk):
    mesh = tube([0.16, 0.16], [1.3, 0.7])
    classes = found(trunk, mesh)
    top = mesh.points[:, 1] >= 1.3 - ClassOptions().pinned_width - 1e-9
    assert (classes[top] == PINNED).all() and (classes[~top] == TIGHT).all()


def test_a_closed_double_layer_hangs_as_a_single_one_does(trunk):
    """Cloth with a thickness, as some programs make it: two layers that close around it, without any border."""
    heights, columns, rows = [1.3, 0.7], 61, 41
    outer, inner = (tube([radius, radius + 0.2], heights, columns=columns, rows=rows) for radius in (0.164, 0.16))
    count, around = outer.vertex_count, np.arange(columns)
    after = (around + 1) % columns
    caps = []
    for row, turn in ((0, 1), ((rows - 1) * columns, -1)):
        a, b, c, d = row + around, row + after, count + row + after, count + row + around
        caps += [np.stack([a, b, c], 1)[:, ::turn], np.stack([a, c, d], 1)[:, ::turn]]
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + count, *caps])
    double = Mesh("/Double", np.concatenate([outer.points, inner.points]), faces)
    assert trimesh.Trimesh(double.points, double.faces, process=False).is_watertight
    single, both = found(trunk, inner), found(trunk, double)
    np.testing.assert_array_equal(both[count:], single)
    assert (both[:count] == both[count:]).mean() > 0.95
    assert set(both[:count]) == {PINNED, TIGHT, LOOSE}


def test_back_panel_is_close_but_not_held(trunk):
    mesh = tube([0.16, 0.16], [1.3, 0.7], turn=140)
    classes = found(trunk, mesh)
    below = mesh.points[:, 1] < 1.3 - 2 * ClassOptions().yoke_width
    assert (classes[below] == LOOSE).all()
    assert (classes[mesh.points[:, 1] > 1.29] == PINNED).all()


def test_flared_skirt_is_loose_where_it_leaves_the_body(trunk):
    mesh = tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4])
    classes, height = found(trunk, mesh), mesh.points[:, 1]
    # The flare is 5 cm off the body at 0.95 - 0.04 * 0.55 / 0.34.
    leaves = 0.95 - 0.04 * 0.55 / 0.34
    assert (classes[height < leaves - 0.03] == LOOSE).all()
    assert (classes[height > leaves + 0.03] != LOOSE).all()


def test_cloth_resting_on_top_of_the_body_is_carried():
    mesh = tube([0.001, 0.14], [1.52, 1.51])
    slab = standing(cylinder(0.15, 0.0, 1.5))
    assert (found(slab, mesh) != LOOSE).all()


def test_skirt_around_two_legs_is_loose_between_them_and_a_trouser_leg_is_not():
    legs = standing(cylinder(0.08, 0.0, 0.9, -0.105), cylinder(0.08, 0.0, 0.9, 0.105))
    options = ClassOptions(tight_distance=0.1, speck_reach=0.02)
    skirt = tube([0.09, 0.09], [0.9, 0.3], columns=121, width=0.105)
    middle = (np.abs(skirt.points[:, 0]) < 0.02) & (skirt.points[:, 1] < 0.75)
    assert (found(legs, skirt, options)[middle] == LOOSE).all()
    leg = tube([0.09, 0.09], [0.9, 0.3])
    assert (found(legs, Mesh("/Leg", leg.points + [0.105, 0, 0], leg.faces), options) != LOOSE).all()


def test_skirt_that_hugs_two_legs_is_loose_where_they_part():
    """Pelvis above 0.7 m, legs below; the skirt touches them all the way down."""
    body = standing(cylinder(0.16, 0.7, 1.1), cylinder(0.07, 0.0, 0.72, -0.085), cylinder(0.07, 0.0, 0.72, 0.085))
    skirt = tube([0.17, 0.17, 0.165, 0.165], [1.0, 0.7, 0.65, 0.2], columns=61, rows=25)
    classes, height = found(body, skirt), skirt.points[:, 1]
    assert (classes[height < 0.55] == LOOSE).all()
    assert (classes[height > 0.9] != LOOSE).all()
    trouser = tube([0.08, 0.08], [0.65, 0.1], columns=31, rows=21)
    trouser = Mesh("/Trouser", trouser.points + [0.085, 0, 0], trouser.faces)
    assert (found(body, trouser) != LOOSE).all()


def test_tightness_goes_from_what_is_pinned_to_all(trunk):
    mesh = tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4], columns=41, rows=31)
    skin = transfer_weights(trunk, mesh, options=RAW)
    levels = hold_levels(trunk, mesh, skin)
    np.testing.assert_array_equal(classes_at(levels, 0.5), usual_classes(trunk, mesh, skin))
    shares = [np.mean(classes_at(levels, tightness) == TIGHT) for tightness in np.linspace(0, 1, 11)]
    assert shares[0] == 0 and shares[-1] == np.mean(levels > 0) and np.all(np.diff(shares) >= 0)
    assert len(set(shares)) > 6
    for tightness in (0.0, 0.25, 0.8, 1.0):
        assert set(np.flatnonzero(classes_at(levels, tightness) == PINNED)) == set(np.flatnonzero(levels == 0))
    # A little off the body, cloth is tight sooner the nearer it is.
    flare = (mesh.points[:, 1] < 0.9) & (mesh.points[:, 1] > 0.75)
    order = np.argsort(mesh.points[flare, 1])
    assert np.corrcoef(levels[flare][order], -mesh.points[flare, 1][order])[0, 1] > 0.8


def test_pins_are_taken_in_place_of_the_band_and_hold_what_is_adrift(trunk):
    far = tube([0.5, 0.5], [1.3, 0.7], columns=31, rows=21)
    pins = (far.points[:, 1] < 0.75).astype(int)
    scene = prepare_scene(trunk, Garment(far, pins=pins), rig_options=RigOptions(proxies=2))
    np.testing.assert_array_equal(scene.classes == PINNED, pins == 1)
    assert (scene.classes[pins == 0] == LOOSE).all()
    near = tube([0.16, 0.16], [1.3, 0.7], columns=31, rows=21)
    classes = prepare_scene(trunk, Garment(near, pins=pins), rig_options=RigOptions(proxies=2)).classes
    np.testing.assert_array_equal(classes == PINNED, pins == 1)
    assert (classes[near.points[:, 1] > 1.28] == TIGHT).all()
    with pytest.raises(SsilkError, match=r"3 pins for \d+ points"):
        Garment(near, pins=np.ones(3))


def test_islands_are_held_at_the_tightness_that_is_asked_for(trunk):
    upper, lower = (tube([0.16, 0.16], [high, high - 0.3], columns=31, rows=9) for high in (1.3, 0.8))
    count = upper.vertex_count
    both = Mesh("/Both", np.r_[upper.points, lower.points], np.r_[upper.faces, lower.faces + count])
    garment = Garment(both, pins=both.points[:, 1] > 1.25)
    rigging = RigOptions(proxies=0)
    lost = rf"/Both: 1 of 2 islands \({count} vertices, the first {count}\) are all loose at tightness 0; .*raise"
    with pytest.raises(SsilkError, match=lost):
        prepare_scene(trunk, garment, tightness=0.0, rig_options=rigging)
    found = prepare_scene(trunk, garment, tightness=0.9, rig_options=rigging).garment
    with pytest.raises(SsilkError, match=lost):
        prepare_scene(trunk, found, tightness=0.0, rig_options=rigging)
    far = Mesh("/Both", np.r_[upper.points, lower.points * [3, 1, 3]], both.faces)
    assert (prepare_scene(trunk, Garment(far, pins=garment.pins), tightness=1.0).classes != LOOSE).all()


def test_classes_that_are_there_follow_a_tightness_by_their_levels(trunk):
    said: list[events.Event] = []
    mesh = tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4], columns=31, rows=21)
    first = prepare_scene(trunk, Garment(mesh), tightness=0.5, rig_options=RigOptions(proxies=2))
    kept = prepare_scene(trunk, first.garment, first.rig, report=said.append)
    assert kept.rig is first.rig and said == []
    again = prepare_scene(trunk, first.garment, first.rig, tightness=0.8, rig_options=RigOptions(proxies=3))
    np.testing.assert_array_equal(again.classes, classes_at(first.garment.levels, 0.8))
    assert np.any(again.classes != first.classes) and again.rig.proxy_count == 3
    same = prepare_scene(trunk, first.garment, first.rig, tightness=0.5)
    assert same.rig is first.rig
    painted = Garment(mesh, classes=first.classes)
    kept = prepare_scene(trunk, painted, first.rig, tightness=0.8, report=said.append)
    np.testing.assert_array_equal(kept.classes, first.classes)
    assert kept.rig is first.rig and "no primvars:ssilk:tightness" in said[0].text and said[0].level == "warning"


def test_narrow_strips_hang_free_however_close(trunk):
    mesh = tube([0.16, 0.16], [1.1, 0.5])
    row, column = np.divmod(np.arange(len(mesh.points)), 61)
    lowest = row[mesh.faces].min(axis=1)
    gap = (column[mesh.faces] % 3 == 2).any(axis=1) & (column[mesh.faces] % 3 == 0).any(axis=1)
    fringe = Mesh("/Fringe", mesh.points, mesh.faces[~(gap & (lowest >= 10))])
    classes = found(trunk, fringe)
    assert (classes[row > 12] == LOOSE).all()
    assert (classes[row < 8] != LOOSE).all()


def test_every_island_is_pinned_by_itself(trunk):
    upper, lower = tube([0.16, 0.16], [1.3, 1.0]), tube([0.17, 0.17], [0.8, 0.5])
    count = upper.vertex_count
    both = Mesh(
        "/Both", np.concatenate([upper.points, lower.points]), np.concatenate([upper.faces, lower.faces + count])
    )
    classes = found(trunk, both)
    for part, top in ((slice(None, count), 1.3), (slice(count, None), 0.8)):
        pinned = both.points[part][classes[part] == PINNED]
        assert len(pinned) and pinned[:, 1].min() > top - 0.03


def test_closed_cap_without_a_border_hangs_from_its_top():
    head = trimesh.creation.icosphere(subdivisions=4, radius=0.12)
    hood = Mesh("/Hood", head.vertices * 1.08, head.faces)
    classes = found(standing(head), hood)
    assert hood.points[classes == PINNED, 1].min() > 0.08 and (classes != LOOSE).all()


def test_island_that_rests_nowhere_is_refused(trunk):
    near, far = tube([0.16, 0.16], [1.3, 1.0], rows=9), tube([0.9, 0.9], [1.3, 1.0], rows=9)
    both = Mesh("/Both", np.concatenate([near.points, far.points]), np.concatenate([near.faces, far.faces + 549]))
    with pytest.raises(SsilkError, match=r"/Both: 1 of 2 islands \(549 vertices, the first 549\).*paint"):
        found(trunk, both)


def test_what_one_joint_carries_hangs_from_its_top_however_far_from_the_body(trunk):
    far = tube([0.3, 0.5], [1.3, 0.7], turn=140)
    alone = SkinWeights("/Cape", np.full((far.vertex_count, 1), 1), np.ones((far.vertex_count, 1)))
    classes = prepare_scene(trunk, Garment(far, alone, None), rig_options=RigOptions(proxies=2)).classes
    top = far.points[:, 1] > 1.3 - ClassOptions().pinned_width
    assert (classes[top] == PINNED).all() and (classes[~top] == LOOSE).all()
    shared = SkinWeights("/Cape", np.arange(far.vertex_count)[:, None] % 2, np.ones((far.vertex_count, 1)))
    with pytest.raises(SsilkError, match="rest nowhere on the body"):
        prepare_scene(trunk, Garment(far, shared, None))


def test_classes_follow_the_vertices_when_renumbered_or_turned_about_the_vertical(trunk):
    mesh = tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4])
    order = np.random.default_rng(2).permutation(mesh.vertex_count)
    turn = trimesh.transformations.rotation_matrix(1.0, [0, 1, 0])[:3, :3]

    def turned(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + [3.0, 0, -1.0]

    moved = Mesh("/Moved", turned(mesh.points)[order], np.argsort(order)[mesh.faces])
    body = trunk.bodies[0]
    elsewhere = Character(
        "/C", trunk.skeleton, (Body(Mesh("/B", turned(body.mesh.points), body.mesh.faces), body.skin),)
    )
    np.testing.assert_array_equal(found(elsewhere, moved), found(trunk, mesh)[order])


def test_negative_threshold_is_named():
    with pytest.raises(SsilkError, match="tight_distance"):
        ClassOptions(tight_distance=-0.01)


def test_prepare_fills_what_is_missing_and_says_so(trunk):
    said: list[events.Event] = []
    garment = Garment(tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4]))
    scene = prepare_scene(trunk, garment, rig_options=RigOptions(proxies=6), report=said.append)
    assert scene.rig.proxy_count == 6
    rough = prepare_scene(trunk, garment, rig_options=RigOptions(proxies=6), rough=True)
    assert rough.rig.proxy_count == 6
    np.testing.assert_array_equal(rough.classes, scene.classes)
    text = " ".join(event.text for event in said if isinstance(event, events.Message))
    assert all(word in text for word in ("no vertex classes", "no skinning weights", "no proxy joints"))


def test_prepare_respects_what_is_authored(trunk):
    mesh = tube([0.16, 0.16, 0.5], [1.1, 0.95, 0.4])
    skin = SkinWeights("/T", np.zeros((mesh.vertex_count, 1)), np.ones((mesh.vertex_count, 1)))
    painted = Garment(mesh, skin, np.where(mesh.points[:, 1] > 0.6, PINNED, LOOSE))
    first = prepare_scene(trunk, painted, rig_options=RigOptions(proxies=3))
    said: list[events.Event] = []
    again = prepare_scene(trunk, painted, first.rig, report=said.append)
    assert again.rig is first.rig and said == []
    np.testing.assert_array_equal(again.classes, painted.classes)
    np.testing.assert_array_equal(again.lbs_skin.dense(2), skin.dense(2))


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not beside the checkout")
@pytest.mark.parametrize("name", ["tshirt", "long_sleeve", "pants"])
def test_close_garments_of_the_wardrobe_are_tight_with_a_pinned_ring(name):
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.reading.garment import read_garment

    character = read_character(SHARED / "character.usdc")
    mesh = read_garment(SHARED / "garments" / f"{name}.usdc", character.skeleton).mesh
    classes = found(character, mesh)
    assert np.mean(classes == LOOSE) < 0.1 and 0.02 < np.mean(classes == PINNED) < 0.12
    pinned = np.flatnonzero(classes == PINNED)
    pairs = edges(mesh.faces)
    ring = components(pairs[(classes[pairs] == PINNED).all(axis=1)], mesh.vertex_count)[pinned]
    assert len(set(ring)) == 1
    # All the way round: seen from its own middle, the ring has no gap.
    around = np.sort(np.arctan2(*(mesh.points[pinned][:, [0, 2]] - mesh.points[pinned][:, [0, 2]].mean(axis=0)).T))
    assert np.diff(np.append(around, around[0] + 2 * np.pi)).max() < np.radians(35)


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not beside the checkout")
def test_a_long_skirt_is_tight_on_the_hips_alone():
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.reading.garment import read_garment

    character = read_character(SHARED / "character.usdc")
    mesh = read_garment(SHARED / "garments" / "long_skirt.usdc", character.skeleton).mesh
    classes, height = found(character, mesh), mesh.points[:, 1]
    assert (classes[height < 0.65] == LOOSE).all() and (classes == TIGHT).mean() < 0.2
    assert (classes[height > 0.9] != LOOSE).mean() > 0.9


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not beside the checkout")
def test_cape_hangs_from_its_collar():
    from ssilk_usd.reading.character import read_character

    from ssilk_core.demo.garments import build_garment

    character = read_character(SHARED / "character.usdc")
    mesh = build_garment("cape", character).mesh
    classes = found(character, mesh)
    area = np.bincount(classes, vertex_areas(mesh.points, mesh.faces)) / vertex_areas(mesh.points, mesh.faces).sum()
    assert 0.003 < area[PINNED] < 0.05 and 0.02 < area[TIGHT] < 0.2 and area[LOOSE] > 0.75
    heights = [mesh.points[classes == value, 1].mean() for value in (PINNED, TIGHT, LOOSE)]
    assert heights == sorted(heights, reverse=True)
    pairs = edges(mesh.faces)
    for value in (PINNED, LOOSE):
        piece = components(pairs[(classes[pairs] == value).all(axis=1)], mesh.vertex_count)
        assert len(set(piece[classes == value])) == 1
