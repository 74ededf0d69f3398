# SPDX-License-Identifier: Apache-2.0
"""Families of bodies: the space that they span, and a garment carried from one to another."""

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.authoring.bodies.carry import carried_moves, carry, dressed_family
from ssilk_core.authoring.bodies.differences import differences, family_findings, need_family
from ssilk_core.errors import SsilkError
from ssilk_core.scene.family import BodyFamily, motion_on, with_joints
from ssilk_core.scene.kinematics import motion_transforms


def shaped(character, change, path="/other"):
    """A character whose points and joints (N, 3) are moved by a function."""
    bodies = tuple(replace(b, mesh=replace(b.mesh, points=change(b.mesh.points))) for b in character.bodies)
    skeleton = character.skeleton
    joints = change(np.array(skeleton.bind_transforms[:, :3, 3]))
    return replace(character, path=path, skeleton=with_joints(skeleton, joints), bodies=bodies)


def taller(points):
    return points * [1, 1.2, 1]


def heavier(points):
    grown = np.array(points)
    middle = [0, 0, 0]
    grown[:, [0, 2]] += 0.3 * (grown - middle)[:, [0, 2]] * np.exp(-np.square((grown[:, 1:2] - 1.1) / 0.2))
    return grown


@pytest.fixture
def members(scene):
    base = scene.character
    return [base, shaped(base, taller, "/taller"), shaped(base, heavier, "/heavier")]


def test_each_member_is_where_it_spans_the_space_and_is_found_again(members):
    family = BodyFamily.of(members)
    assert family.size == 2 and not family.members[0].any()
    np.testing.assert_allclose(np.abs(family.members).max(axis=0), 1)
    for known in (family, family.stored()):
        for member, coordinates in zip(members, known.members):
            place = known.place_of(member)
            np.testing.assert_allclose(place.coordinates, coordinates, atol=1e-9)
            assert max(place.joints_off, place.points_off) < 1e-12 and place.beyond == 0
    body, skeleton = (
        at(part, family.members[2])
        for at, part in ((family.body_at, members[0].merged_body()), (family.skeleton_at, members[0].skeleton))
    )
    np.testing.assert_allclose(body.mesh.points, members[2].merged_body().mesh.points, atol=1e-12)
    np.testing.assert_allclose(skeleton.bind_transforms, members[2].skeleton.bind_transforms, atol=1e-12)
    np.testing.assert_allclose(skeleton.rest_transforms, members[2].skeleton.rest_transforms, atol=1e-12)


def test_the_base_is_at_exactly_zero(members):
    assert not BodyFamily.of(members).place_of(members[0]).coordinates.any()


def test_more_members_than_directions_are_all_found(members):
    between = shaped(members[0], lambda points: 0.5 * (points + taller(points)), "/between")
    family = BodyFamily.of([*members, between])
    assert family.size == 2
    np.testing.assert_allclose(family.members[3], 0.5 * family.members[1], atol=1e-9)


def test_a_body_beyond_the_members_and_one_beside_the_space_are_told(members):
    family = BodyFamily.of(members)
    middle, spread = family.members.mean(axis=0), np.linalg.norm(family.members - family.members.mean(axis=0), axis=1)
    farthest = family.members[spread.argmax()]
    assert family.beyond(middle) == 0
    assert family.beyond(farthest + 0.5 * (farthest - middle)) == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(family.nearest(farthest + 0.5 * (farthest - middle)), farthest, atol=1e-4)
    aside = shaped(members[0], lambda points: points + [0, 0, 0.02])
    assert 0.005 < family.place_of(aside).points_off <= 0.0201


def test_a_garment_stays_exactly_where_it_is_on_the_same_body(scene):
    carried = carry(scene, scene.character)
    np.testing.assert_array_equal(carried.scene.garment.mesh.points, scene.garment.mesh.points)
    np.testing.assert_array_equal(carried.scene.rig.bind_transforms, scene.rig.bind_transforms)


def test_a_body_scaled_and_moved_as_a_whole_takes_its_garment_along(scene):
    def change(points):
        turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
        return 1.3 * points @ turn + [0.1, 0.2, -0.3]

    base, cloth = scene.character.merged_body(), scene.garment.mesh
    other = replace(base, mesh=replace(base.mesh, points=change(base.mesh.points)))
    moves = carried_moves(cloth, scene.lbs_skin, base, other, scene.character.skeleton.joint_count)
    np.testing.assert_allclose(cloth.points + moves, change(cloth.points), atol=1e-9)


def test_cloth_on_skin_follows_the_skin_beneath_and_proxies_follow_the_cloth(scene, members):
    carried = carry(scene, members[2]).scene
    cloth, moved = scene.garment.mesh.points, carried.garment.mesh.points - scene.garment.mesh.points
    assert np.abs(moved[:, 2]).max() > 0.005  # the strip hangs behind a body that grows
    assert moved[np.argmin(np.abs(cloth[:, 1] - 1.1)), 2] < 0  # away from it
    shifts = carried.rig.bind_transforms[:, :3, 3] - scene.rig.bind_transforms[:, :3, 3]
    at = [np.linalg.norm(cloth - place, axis=1).argmin() for place in scene.rig.bind_transforms[:, :3, 3]]
    np.testing.assert_allclose(shifts, moved[at], atol=1e-12)


def test_skin_that_other_joints_move_counts_little(scene):
    """Half of the body moves; cloth beside it that hangs from the other half stays nearly where it is."""
    base, cloth = scene.character.merged_body(), scene.garment.mesh
    joints = scene.character.skeleton.joint_count
    spine = base.skin.dense(joints)[:, 1:2] > 0.5
    other = replace(base, mesh=replace(base.mesh, points=base.mesh.points + 0.05 * spine * [1.0, 0, 0]))
    skins = [
        replace(
            scene.lbs_skin, indices=np.full((cloth.vertex_count, 1), joint), weights=np.ones((cloth.vertex_count, 1))
        )
        for joint in (0, 1)
    ]
    low = np.abs(cloth.points[:, 1] - 1.13) < 0.06  # beside the half that stays
    own, its = (carried_moves(cloth, skin, base, other, joints)[low, 0] for skin in skins)
    assert (own < its).all()


def test_a_garment_lies_on_members_where_it_was_carried(scene, members):
    family = BodyFamily.of(members)
    dressed, carried = dressed_family(scene, family, members[1:])
    assert dressed.scene_at(scene, family.members[0]) is scene
    for coordinates, each in zip(family.members[1:], carried):
        found = dressed.scene_at(scene, coordinates)
        np.testing.assert_allclose(found.garment.mesh.points, each.scene.garment.mesh.points, atol=1e-9)
        np.testing.assert_allclose(found.rig.bind_transforms, each.scene.rig.bind_transforms, atol=1e-9)
        np.testing.assert_allclose(found.bind_transforms, each.scene.bind_transforms, atol=1e-9)


def test_a_motion_of_another_body_turns_its_joints_alike_and_stands_on_the_ground(scene, members, toy_motion):
    motion, base, other = toy_motion(scene, 12), members[0].skeleton, members[1].skeleton
    carried = motion_on(motion, base, other, 1.2)
    own, its = (motion_transforms(each, base.parents) for each in (motion, carried))
    np.testing.assert_allclose(its[:, :, :3, :3], own[:, :, :3, :3], atol=1e-12)
    hub = base.hub
    grown = other.bind_transforms[hub, :3, 3] + 1.2 * (own[:, hub, :3, 3] - base.bind_transforms[hub, :3, 3])
    np.testing.assert_allclose(its[:, hub, :3, 3], grown, atol=1e-12)
    still = motion_on(motion, base, base, 1.0)
    np.testing.assert_allclose(still.translations, motion.translations, atol=1e-15)


def renamed(character):
    names = (*character.skeleton.joint_names[:-1], "Hips/Spine/Wing")
    return replace(character, path="/renamed", skeleton=replace(character.skeleton, joint_names=names))


def cut(character):
    body = character.bodies[0]
    keep = body.mesh.vertex_count - 1
    faces = body.mesh.faces[(body.mesh.faces < keep).all(axis=1)]
    mesh = replace(body.mesh, points=body.mesh.points[:keep], faces=faces, polygon_counts=None, polygon_indices=None)
    skin = replace(body.skin, indices=body.skin.indices[:keep], weights=body.skin.weights[:keep])
    return replace(character, path="/cut", bodies=(replace(body, mesh=mesh, skin=skin),))


@pytest.mark.parametrize(
    ("change", "told"),
    [(renamed, "missing (Hips/Spine/Arm)"), (renamed, "more (Hips/Spine/Wing)"), (cut, "points, not")],
)
def test_what_is_no_member_is_told_by_name(scene, change, told):
    other = change(scene.character)
    assert told in "; ".join(differences(scene.character, other))
    (finding,) = family_findings([scene.character, other])
    assert finding.severity == "error" and finding.code == "no-family" and finding.prim == other.path
    with pytest.raises(SsilkError, match="no member of the family"):
        need_family([scene.character, other])


def test_quads_are_the_same_whichever_way_they_are_split(scene, members):
    """Readers split a quad along its shorter diagonal, which another body may have elsewhere."""
    corners, splits = np.array([0, 1, 2, 3]), ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]])

    def split(character, faces):
        body = character.bodies[0]
        mesh = replace(body.mesh, faces=faces, polygon_counts=[4], polygon_indices=corners, uvs=None)
        return replace(character, bodies=(replace(body, mesh=mesh),))

    base, other = (split(each, faces) for each, faces in zip(members, splits))
    assert not differences(base, other)
    assert BodyFamily.of([base, other]).size == 1


def test_turned_joints_are_told_and_refused_for_training(scene, members):
    binds = np.array(members[1].skeleton.bind_transforms)
    binds[2, :3, :3] = binds[2, :3, :3] @ [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turned = replace(members[1], skeleton=replace(members[1].skeleton, bind_transforms=binds))
    found = {finding.code: finding for finding in family_findings([members[0], turned])}
    assert found["turned-bind-pose"].indices == (2,) and "90.0 degrees" in found["turned-bind-pose"].found
    assert need_family([members[0], turned]).size == 1
    with pytest.raises(SsilkError, match=r"'Hips/Spine/Arm' is bound 90\.0 degrees"):
        need_family([members[0], turned], trained=True)


def test_one_body_is_no_family(scene):
    with pytest.raises(SsilkError, match="the same body as"):
        BodyFamily.of([scene.character, scene.character])
    (finding,) = family_findings([scene.character, scene.character])
    assert finding.severity == "error"


def test_weights_that_differ_are_told(scene, members):
    body = members[1].bodies[0]
    other = replace(members[1], bodies=(replace(body, skin=replace(body.skin, weights=body.skin.weights[:, ::-1])),))
    codes = [finding.code for finding in family_findings([scene.character, other])]
    assert codes == ["other-weights", "family"]


@pytest.mark.parametrize("signs", [[-1, 1], [1, -1], [-1, -1]])
def test_directions_go_the_same_way_whichever_way_linear_algebra_has_them(members, monkeypatch, signs):
    found, svd = BodyFamily.of(members), np.linalg.svd

    def mirrored(matrix, **options):
        left, values, axes = svd(matrix, **options)
        axes[:2] *= np.array(signs)[:, None]
        return left, values, axes

    monkeypatch.setattr(np.linalg, "svd", mirrored)
    again = BodyFamily.of(members)
    for name in ("members", "joint_moves", "point_moves", "taller"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    assert (found.members.max(axis=0) == 1).all()
