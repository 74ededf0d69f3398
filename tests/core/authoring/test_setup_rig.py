# SPDX-License-Identifier: Apache-2.0
"""Proxy rigs: placement, hierarchy, frames and weights, on sheets whose geodesics are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssilk_core import events
from ssilk_core.authoring.setup.clusters import carrying_joint, distribute_proxies
from ssilk_core.authoring.setup.proxy_weights import falloff
from ssilk_core.authoring.setup.rig import RigOptions, build_rig
from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import LOOSE, PINNED, TIGHT, Body, Character, Garment, Mesh, Scene, Skeleton, SkinWeights
from ssilk_core.scene.mesh.topology import edges

JOINTS = ("Hips", "Hips/LeftLeg", "Hips/RightLeg")


def transforms(*positions: tuple[float, float, float]) -> np.ndarray:
    return kinematics.rigid(np.tile(np.eye(3), (len(positions), 1, 1)), np.array(positions))


@pytest.fixture(scope="module")
def character() -> Character:
    bind = transforms((0.5, 1.1, 0), (0.2, 1, 0), (0.8, 1, 0))
    parents = np.array([-1, 0, 0])
    skeleton = Skeleton("/Rig", JOINTS, parents, bind, kinematics.local_transforms(bind, parents))
    mesh = Mesh("/Body", [[0.0, 1, 0], [1, 1, 0], [0, 2, 0]], [[0, 1, 2]])
    return Character("/C", skeleton, (Body(mesh, SkinWeights("/Body", np.zeros((3, 1)), np.ones((3, 1)))),))


def hanging(columns: int = 21, rows: int = 21, *, slits: int = 0, seed: int | None = None) -> Garment:
    """A sheet one metre wide and tall in z = 0, its top row pinned and the next two tight, cut into strips below."""
    r, c = np.divmod(np.arange(rows * columns), columns)
    points = np.column_stack([c / (columns - 1), 1 - r / (rows - 1), np.zeros(len(r))])
    if seed is not None:
        points[:, :2] += np.random.default_rng(seed).uniform(-0.2, 0.2, size=(len(r), 2)) / columns
    classes = np.select([r == 0, r <= 2], [PINNED, TIGHT], LOOSE)
    at = np.flatnonzero((r < rows - 1) & (c < columns - 1))
    if slits:
        at = at[(r[at] < 2) | ((c[at] + 1) % slits != 0)]
    faces = np.concatenate(
        [np.column_stack([at, at + columns, at + columns + 1]), np.column_stack([at, at + columns + 1, at + 1])]
    )
    weights = np.column_stack([np.full(len(r), 0.2), 0.8 * (1 - points[:, 0]), 0.8 * points[:, 0]]).clip(0)
    skin = SkinWeights("/Sheet", np.tile([0, 1, 2], (len(r), 1)), weights)
    return Garment(Mesh("/World/Sheet 1", points, faces), skin, classes)


def depth(rig, joint_count: int = 3) -> list[int]:
    levels: list[int] = []
    for parent in rig.parents:
        levels.append(0 if parent < joint_count else levels[parent - joint_count] + 1)
    return levels


@pytest.fixture(scope="module")
def sheet_rig(character):
    garment = hanging(seed=1)
    return garment, build_rig(character, garment)


def test_hierarchy_is_breadth_first_from_the_roots_at_the_seam(character, sheet_rig):
    garment, rig = sheet_rig
    Scene(character, garment, rig)
    levels = depth(rig)
    assert rig.proxy_count == 20
    assert levels == sorted(levels) and 1 <= levels.count(0) <= 4
    heights = rig.bind_transforms[:, 1, 3]
    # The loose part begins in row three of twenty: roots stand in its upper third, none lower.
    assert heights[: levels.count(0)].min() > 1 - 3 / 20 - (17 / 20) / 3
    for proxy, parent in enumerate(rig.parents):
        if parent >= 3:
            between = np.linalg.norm(rig.bind_transforms[:, :3, 3] - rig.bind_transforms[proxy, :3, 3], axis=1)
            above = [other for other in range(proxy) if levels[other] == levels[proxy] - 1]
            # On a flat sheet the geodesically nearest of the level above is the nearest in space, if they touch.
            assert between[parent - 3] <= 2 * between[above].min()


def test_names_are_joint_paths_under_the_parents(character, sheet_rig):
    _, rig = sheet_rig
    names = (*JOINTS, *rig.joint_names)
    for number, (name, parent) in enumerate(zip(rig.joint_names, rig.parents)):
        assert name == f"{names[parent]}/Sheet_1_proxy_{number:02d}"


def test_proxies_are_spread_evenly(sheet_rig):
    _, rig = sheet_rig
    points = rig.bind_transforms[:, :3, 3]
    between = np.linalg.norm(points[:, None] - points, axis=2) + np.diag(np.full(20, np.inf))
    # No 20 points in the loose part, 1 m by 0.85 m, can all be further apart than in a hexagonal packing of
    # discs whose centres may lie on its border.
    best = np.sqrt(2 * (1.0 + 0.25) * (0.85 + 0.25) / (np.sqrt(3) * 20))
    assert between.min() > 0.55 * best
    assert between.min() / between.min(axis=1).mean() > 0.75


def test_frames_run_along_the_cloth_and_face_outward(sheet_rig):
    _, rig = sheet_rig
    y, z = rig.bind_transforms[:, :3, 1], rig.bind_transforms[:, :3, 2]
    np.testing.assert_allclose(z, np.tile([0, 0, 1], (20, 1)), atol=1e-9)
    assert np.linalg.det(rig.bind_transforms[:, :3, :3]).min() > 0.999
    children = {int(parent) - 3 for parent in rig.parents if parent >= 3}
    for proxy, parent in enumerate(rig.parents):
        if parent >= 3 and proxy not in children:
            away = rig.bind_transforms[proxy, :3, 3] - rig.bind_transforms[parent - 3, :3, 3]
            np.testing.assert_allclose(y[proxy], away / np.linalg.norm(away), atol=1e-9)


def test_only_loose_vertices_follow_proxies_and_all_of_them_do(sheet_rig):
    garment, rig = sheet_rig
    dense = rig.skin.dense(23)
    loose = garment.classes == LOOSE
    assert (dense[loose, 3:].sum(axis=1) > 0).all()
    np.testing.assert_allclose(dense[~loose], np.pad(garment.skin.dense(3)[~loose], ((0, 0), (0, 20))), atol=1e-12)
    assert (dense[:, 3:] > 0).sum(axis=1).max() <= 4


def test_body_share_falls_off_from_the_seam(sheet_rig):
    _, rig = sheet_rig
    body = rig.skin.dense(23)[:, :3].sum(axis=1).reshape(21, 21)
    assert (np.diff(body[2:].mean(axis=1)) <= 1e-12).all()
    assert body[3].min() > 0.7 and body[20].max() == 0


def turned(character, garment, rig, degrees: float) -> np.ndarray:
    """Posed vertices after each root proxy has turned by itself about the horizontal, the body at rest."""
    scene = Scene(character, garment, rig)
    local = kinematics.local_transforms(scene.bind_transforms, scene.parents)
    for joint in 3 + np.flatnonzero(rig.parents < 3):
        sign = 1 if joint % 2 else -1
        local[joint, :3, :3] = (
            Rotation.from_rotvec([np.radians(sign * degrees), 0, 0]).as_matrix() @ local[joint, :3, :3]
        )
    world = kinematics.world_transforms(local[None], scene.parents)
    return kinematics.skin_points(
        garment.mesh.points, rig.skin, kinematics.skinning_matrices(world, scene.bind_transforms)
    )[0]


def test_seam_stays_whole_when_roots_turn(character):
    garment = hanging(seed=2)
    pairs = edges(garment.mesh.faces)
    across = pairs[(garment.classes[pairs] == LOOSE).sum(axis=1) == 1]

    def worst(blend: bool) -> float:
        posed = turned(character, garment, build_rig(character, garment, RigOptions(seam_blend=blend)), 40)
        length = [np.linalg.norm(p[across[:, 0]] - p[across[:, 1]], axis=1) for p in (posed, garment.mesh.points)]
        return float(np.abs(length[0] / length[1] - 1).max())

    assert worst(True) < 0.25
    assert worst(False) > 4 * worst(True)


def test_rig_moves_with_the_garment_and_ignores_vertex_order(character):
    garment = hanging(seed=3)
    order = np.random.default_rng(5).permutation(garment.mesh.vertex_count)
    place = np.argsort(order)
    turn, shift = Rotation.from_euler("xyz", [0.3, 1.1, -0.4]).as_matrix(), np.array([1.0, -2, 0.5])
    skin = SkinWeights("/Sheet", garment.skin.indices[order], garment.skin.weights[order])
    moved = Garment(
        Mesh("/World/Sheet 1", (garment.mesh.points @ turn.T + shift)[order], place[garment.mesh.faces]),
        skin,
        garment.classes[order],
    )
    first, second = build_rig(character, garment), build_rig(character, moved)
    np.testing.assert_array_equal(first.parents, second.parents)
    np.testing.assert_allclose(
        kinematics.rigid(turn, shift) @ first.bind_transforms, second.bind_transforms, atol=1e-9
    )
    np.testing.assert_allclose(first.skin.dense(23)[order], second.skin.dense(23), atol=1e-9)


def test_strips_get_proxies_of_their_own_and_never_share_them(character):
    garment = hanging(columns=24, slits=4)
    said: list[events.Event] = []
    rig = build_rig(character, garment, RigOptions(proxies=4), report=said.append)
    assert rig.proxy_count == 6 and "6 loose pieces" in said[0].text
    assert (rig.parents < 3).all()
    strip = np.arange(garment.mesh.vertex_count) % 24 // 4
    dense = rig.skin.dense(9)[:, 3:]
    for number in range(6):
        own = np.flatnonzero((dense > 0)[(strip == number) & (garment.classes == LOOSE)].any(axis=0))
        assert len(own) == 1
        assert set(strip[dense[:, own[0]] > 0]) == {number}


def test_each_proxy_is_told(character):
    said: list[events.Event] = []
    build_rig(character, hanging(columns=24, slits=4), RigOptions(proxies=8), report=said.append)
    told = [event for event in said if isinstance(event, events.Progress)]
    assert [(event.done, event.total) for event in told] == [(number, 8) for number in range(1, 9)]
    assert told[-1].seconds_left == 0


def test_two_proxies_on_a_strip_make_a_chain_that_hinges_at_the_seam(character):
    rig = build_rig(character, hanging(columns=24, slits=4), RigOptions(proxies=12))
    assert depth(rig) == [0, 1] * 6
    heights = rig.bind_transforms[:, 1, 3].reshape(6, 2)
    assert (heights[:, 0] >= 0.85 - 1e-9).all() and (heights[:, 1] <= 1e-9).all()


def test_strips_beyond_the_limit_follow_their_neighbours(character):
    garment = hanging(columns=24, slits=4)
    said: list[events.Event] = []
    rig = build_rig(character, garment, RigOptions(proxies=1, max_proxies=3), report=said.append)
    assert rig.proxy_count == 3 and "warning" in {event.level for event in said if isinstance(event, events.Message)}
    assert (rig.skin.dense(6)[garment.classes == LOOSE, 3:].sum(axis=1) > 0).all()


@pytest.mark.parametrize("proxies", [1, 5, 400])
def test_pieces_smaller_than_their_share_are_filled_and_no_more(character, proxies):
    rig = build_rig(character, hanging(columns=3, rows=5), RigOptions(proxies=proxies))
    assert rig.proxy_count == min(proxies, 6)
    assert np.isfinite(rig.skin.weights).all()


def test_nothing_loose_or_no_proxies_is_plain_skinning(character):
    garment = hanging()
    held = Garment(garment.mesh, garment.skin, np.minimum(garment.classes, TIGHT))
    for rig in (build_rig(character, held), build_rig(character, garment, RigOptions(proxies=0))):
        assert rig.proxy_count == 0
        np.testing.assert_array_equal(rig.skin.dense(3), garment.skin.dense(3))


def test_loose_island_is_refused(character):
    garment = hanging()
    with pytest.raises(SsilkError, match=r"441 loose vertices \(the first is 0\) lie on islands without a pinned"):
        build_rig(character, Garment(garment.mesh, garment.skin, np.full(441, LOOSE)))


def test_a_loose_vertex_of_no_face_is_refused_as_such(character):
    garment = hanging()
    mesh = replace(garment.mesh, points=np.append(garment.mesh.points, [[0.0, 1, 0]], axis=0))
    rows = garment.skin.indices, garment.skin.weights
    skin = SkinWeights(mesh.path, *(np.append(row, row[:1], axis=0) for row in rows))
    with pytest.raises(SsilkError, match=r"1 loose vertices belong to no face \(the first is 441\)"):
        build_rig(character, Garment(mesh, skin, np.append(garment.classes, LOOSE)))


def mirrored(points: np.ndarray) -> np.ndarray:
    return points * [-1, 1, 1] + [1, 0, 0]


@pytest.mark.parametrize(
    "options",
    [{"columns": 21}, {"columns": 20}, {"columns": 24, "slits": 4}, {"columns": 21, "slits": 3}],
    ids=["a column in the middle", "none there", "pairs of strips", "a strip in the middle"],
)
@pytest.mark.parametrize("proxies", [2, 7, 20])
def test_proxies_of_a_symmetric_garment_are_symmetric(character, options, proxies):
    garment = hanging(**options)  # whose diagonals are no images
    rig = build_rig(character, garment, RigOptions(proxies=proxies))
    Scene(character, garment, rig)
    leaves, places = [name.rpartition("/")[2] for name in rig.joint_names], rig.bind_transforms[:, :3, 3]
    flipped = [{"L": f"{leaf[:-1]}R", "R": f"{leaf[:-1]}L"}.get(leaf[-1], leaf) for leaf in leaves]
    mates = np.array([leaves.index(leaf) for leaf in flipped])
    assert rig.proxy_count >= proxies - 1 and (mates[mates] == np.arange(len(mates))).all()
    np.testing.assert_allclose(places[mates], mirrored(places), atol=1e-9)
    rough = build_rig(character, garment, RigOptions(proxies=proxies, exact=False))
    assert rough.proxy_count == rig.proxy_count
    hinges, joints = ({*each.parents[each.parents < len(JOINTS)]} for each in (rough, rig))
    assert hinges == joints
    for leaf, place in zip(leaves, places):
        assert leaf.endswith({-1: "_L", 0: tuple("0123456789"), 1: "_R"}[int(np.sign(np.round(place[0] - 0.5, 6)))])
    turns = rig.bind_transforms[:, :3, :3]
    image = turns[mates] * np.array([-1, 1, 1])[:, None] * [-1, 1, 1]  # x = y x z of the images of y and z
    paired = mates != np.arange(len(mates))
    np.testing.assert_allclose(turns[paired], image[paired], atol=1e-9)
    parents = np.where(rig.parents < 3, np.array([0, 2, 1])[np.minimum(rig.parents, 2)], 0)
    chained = rig.parents >= 3
    parents[chained] = 3 + mates[rig.parents[chained] - 3]
    np.testing.assert_array_equal(rig.parents[mates][paired], parents[paired])
    twin = np.array([np.abs(garment.mesh.points - point).sum(1).argmin() for point in mirrored(garment.mesh.points)])
    weights = rig.skin.dense(3 + len(mates))[:, 3:]
    np.testing.assert_allclose(weights[twin][:, mates], weights, atol=1e-5)


def test_a_garment_that_is_only_nearly_symmetric_has_no_sides(character):
    garment = hanging()
    points = garment.mesh.points.copy()
    points[100, 2] += 1e-4
    rig = build_rig(character, replace(garment, mesh=replace(garment.mesh, points=points)))
    assert not any(name.endswith(("_L", "_R")) for name in rig.joint_names)


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ([0.1, 0.8, 0.1, 0.0], 1),  # one joint dominates
        ([0.2, 0.4, 0.4, 0.0], 0),  # half on each leg: the hips carry it
        ([0.0, 0.3, 0.1, 0.6], 3),  # deep in the left leg
        ([0.0, 0.4, 0.2, 0.4], 1),  # shared within the left leg
    ],
)
def test_carrying_joint_is_the_deepest_with_most_of_the_weight(weights, expected):
    assert carrying_joint(np.array(weights), np.array([-1, 0, 0, 1])) == expected


def test_shares_follow_area_but_leave_none_out():
    areas, alone = np.array([6.0, 3.0, 0.1]), np.arange(3)
    assert distribute_proxies(areas, np.array([99, 99, 99]), 10, alone).tolist() == [6, 3, 1]
    assert distribute_proxies(areas, np.array([2, 2, 2]), 10, alone).tolist() == [2, 2, 2]
    assert distribute_proxies(areas, np.array([9, 9, 9]), 2, alone).tolist() == [1, 1, 0]


def test_pieces_that_are_images_have_equal_shares():
    sizes = np.array([99] * 4)
    assert distribute_proxies(np.array([3.0, 3, 1, 1]), sizes, 9, np.array([1, 0, 3, 2])).tolist() == [3, 3, 1, 1]
    assert distribute_proxies(np.array([3.0, 3, 2, 1]), sizes, 9, np.array([1, 0, 2, 3])).tolist() == [3, 3, 2, 1]


def test_falloff_is_continuous_where_the_choice_of_proxies_changes():
    proxies = np.arange(12.0)
    along = np.linspace(0, 11, 20001)
    weights = falloff(np.abs(along[:, None] - proxies), 1.0, 3)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert (weights > 0).sum(axis=1).max() == 3
    # exp(-d^2) is nowhere steeper than 0.86 and the normaliser stays above 0.7: no step exceeds a few slopes.
    assert np.abs(np.diff(weights, axis=0)).max() < 4 * np.diff(along)[0]


def test_equally_near_proxies_share_what_there_is():
    np.testing.assert_allclose(falloff(np.ones((2, 5)), 1.0, 3).sum(axis=1), 1)


@pytest.mark.parametrize("bad", [{"proxies": -1}, {"max_proxies": 0}, {"roots_per_cluster": 0}, {"influences": 0}])
def test_bad_options_are_named(bad):
    with pytest.raises(SsilkError, match=next(iter(bad))):
        RigOptions(**bad)
