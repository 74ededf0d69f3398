# SPDX-License-Identifier: Apache-2.0
"""Which colliders stand for the body: capsules in a limb do, a bracelet around it and a chair under it do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ssilk_core.physics.world.own_shapes import OwnShapes
from ssilk_core.scene.assets import Body, Character, Collider, Mesh, Motion, Skeleton, SkinWeights

FRAMES, LIMB = 20, 0.05  # [m] radius of the arm
AWAY = np.array([0.2, 1.15, 0.0])  # from the trunk to the middle of the arm


def posed(path: str, mesh: trimesh.Trimesh, places: np.ndarray, present: np.ndarray | None = None) -> Collider:
    whole = np.ones(1, dtype=bool) if present is None else present
    return Collider(path, mesh.faces, np.asarray(mesh.vertices)[None], places, whole)


@pytest.fixture(scope="module")
def dressed(scene):
    """A trunk of 40 cm by 60 cm, an arm that swings away from it, and the toy's strip of cloth beside both."""
    trunk = trimesh.creation.box((0.3, 0.6, 0.2)).subdivide().subdivide()
    arm = trimesh.creation.capsule(height=0.3, radius=LIMB, count=(24, 24))
    arm.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    arm.apply_translation(AWAY - arm.bounds.mean(axis=0))
    trunk.apply_translation([0, 1, 0])
    both = trimesh.util.concatenate([trunk, arm])
    joint = (np.arange(len(both.vertices)) >= len(trunk.vertices)).astype(int)
    binds = np.tile(np.eye(4), (3, 1, 1))
    skeleton = Skeleton("/doll", ("Hips", "Hips/Spine", "Hips/Spine/Arm"), [-1, 0, 1], binds, binds)
    skin = SkinWeights("/doll/body", joint[:, None], np.ones((len(joint), 1)))
    body = Body(Mesh("/doll/body", both.vertices, both.faces), skin)
    return replace(scene, character=Character("/doll", skeleton, (body,)))


@pytest.fixture(scope="module")
def motion() -> Motion:
    """The body walks along x, and its arm swings up by 80 cm."""
    rotations, translations = np.tile([1.0, 0, 0, 0], (FRAMES, 3, 1)), np.zeros((FRAMES, 3, 3))
    translations[:, 0, 0] = np.linspace(0, 2, FRAMES)
    translations[:, 1, 1] = np.linspace(0, 0.8, FRAMES)
    translations[:, 2, 1] = 0
    return Motion("walk", 30.0, rotations, translations)


def carried(motion: Motion, joint: int) -> np.ndarray:
    places = np.tile(np.eye(4), (FRAMES, 1, 1))
    places[:, :3, 3] = motion.translations[:, : joint + 1].sum(axis=1)
    return places


def along_the_arm(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    mesh.apply_translation(AWAY - mesh.bounds.mean(axis=0))
    return mesh


def capsule(radius: float, height: float = 0.2) -> trimesh.Trimesh:
    return along_the_arm(trimesh.creation.capsule(height=height, radius=radius, count=(24, 24)))


@pytest.mark.parametrize(("radius", "is_own"), [(0.03, True), (0.063, True), (0.08, False)])
def test_capsules_of_a_limb_are_its_own_though_they_stick_out_a_little(dressed, motion, radius, is_own):
    found = posed("/Ragdoll/Arm", capsule(radius, 0.08), carried(motion, 1))
    assert OwnShapes.of(dressed, motion).has(found) is is_own


def test_a_box_that_fills_the_trunk_is_its_own_and_open_shapes_are_judged_by_their_area(dressed, motion):
    box = trimesh.creation.box((0.29, 0.62, 0.19))
    box.apply_translation([0, 1, 0])
    shapes = OwnShapes.of(dressed, motion)
    assert shapes.has(posed("/Ragdoll/Trunk", box, carried(motion, 0)))
    tube = capsule(0.045)
    opened = trimesh.Trimesh(tube.vertices, tube.faces[: len(tube.faces) // 2])
    assert shapes.has(posed("/Ragdoll/Open", opened, carried(motion, 1)))


@pytest.mark.parametrize("inner", [LIMB + 0.0005, LIMB - 0.002])
def test_a_bracelet_is_a_prop_though_it_goes_with_the_arm_and_cuts_into_it(dressed, motion, inner):
    tube = 0.006
    ring = along_the_arm(trimesh.creation.torus(major_radius=inner + tube, minor_radius=tube))
    assert not OwnShapes.of(dressed, motion).has(posed("/Bracelet", ring, carried(motion, 1)))


def test_a_chair_in_which_the_body_sits_is_a_prop(dressed, motion):
    seat, back = trimesh.creation.box((0.5, 0.1, 0.5)), trimesh.creation.box((0.5, 0.8, 0.06))
    seat.apply_translation([0, 0.73, 0])  # the trunk sinks 8 cm into it
    back.apply_translation([0, 1, -0.1])  # and 3 cm into this
    still = replace(motion, rotations=motion.rotations[:1], translations=motion.translations[:1])
    for part in (seat, back, trimesh.util.concatenate([seat, back])):
        assert not OwnShapes.of(dressed, still).has(posed("/Chair", part, np.eye(4)[None]))


def test_what_the_body_walks_through_is_a_prop_and_so_is_what_the_arm_leaves(dressed, motion):
    inside = capsule(0.03)
    shapes = OwnShapes.of(dressed, motion)
    assert not shapes.has(posed("/Post", inside, np.eye(4)[None]))
    assert not shapes.has(posed("/Wrong", inside, carried(motion, 0)))
    first = np.arange(FRAMES) == 0
    assert shapes.has(posed("/Brief", inside, np.eye(4)[None], first))  # there while it is inside, and then no more
    assert not shapes.has(posed("/Never", inside, carried(motion, 1), np.zeros(1, dtype=bool)))
