# SPDX-License-Identifier: Apache-2.0
"""Validation of the world's dataclasses: each mistake is one sentence, and what is built stays as it was."""

import re
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import (
    Body,
    Character,
    Deformer,
    Garment,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)

POINTS, FACES = np.eye(3), np.array([[0, 1, 2]])
EYES = np.tile(np.eye(4), (2, 1, 1))
ONES = SkinWeights("/w", [[0], [0], [0]], [[1.0], [1], [1]])
MESH = Mesh("/m", POINTS, FACES)


def skeleton(**changes: object) -> Skeleton:
    return Skeleton(
        **(
            {
                "path": "/s",
                "joint_names": ("A", "A/B"),
                "parents": [-1, 0],
                "bind_transforms": EYES,
                "rest_transforms": EYES,
            }
            | changes
        )
    )


def motion(**changes: object) -> Motion:
    quaternions = np.tile([1.0, 0, 0, 0], (4, 2, 1))
    return Motion(
        **({"path": "/a", "fps": 30.0, "rotations": quaternions, "translations": np.zeros((4, 2, 3))} | changes)
    )


def rig(**changes: object) -> ProxyRig:
    return ProxyRig(
        **({"path": "/r", "joint_names": ("P",), "parents": [0], "bind_transforms": EYES[:1], "skin": ONES} | changes)
    )


def scene(garment: Garment | None = None, proxies: ProxyRig | None = None) -> Scene:
    garment = garment or Garment(MESH, ONES, [0, 1, 2])
    return Scene(Character("/c", skeleton(), ()), garment, proxies or rig())


def with_nan(array: np.ndarray) -> np.ndarray:
    changed = np.array(array, dtype=float)
    changed.reshape(-1)[0] = np.nan
    return changed


def scaled(factor: float) -> np.ndarray:
    return np.tile(np.diag([factor, 1, 1, 1]), (2, 1, 1))


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "no joints": (lambda: skeleton(joint_names=()), "no joints"),
    "repeated joints": (lambda: skeleton(joint_names=("A", "A")), "joint names repeat"),
    "too many parents": (lambda: skeleton(parents=[-1, 0, 1]), "3 parents for 2 joints"),
    "child first": (lambda: skeleton(parents=[1, -1]), "'A' precedes its parent"),
    "own parent": (lambda: skeleton(parents=[-1, 1]), "'A/B' precedes its parent"),
    "parent of no one": (lambda: skeleton(parents=[-1, -2]), "'A/B' precedes its parent"),
    "bind transform that scales": (
        lambda: skeleton(bind_transforms=scaled(2.0)),
        "bind transform of joint 'A' scales",
    ),
    "rest transform that mirrors": (
        lambda: skeleton(rest_transforms=scaled(-1.0)),
        "rest transform of joint 'A' .*mirrors",
    ),
    "bind transform that is NaN": (
        lambda: skeleton(bind_transforms=with_nan(EYES)),
        "1 of 2 bind transforms hold NaN",
    ),
    "bind transforms of another count": (lambda: skeleton(bind_transforms=EYES[:1]), r"shape \(1, 4, 4\)"),
    "weights of another shape": (lambda: SkinWeights("/w", [[0]], [[0.5, 0.5]]), "indices of shape"),
    "flat weights": (lambda: SkinWeights("/w", [0, 1], [0.5, 0.5]), "indices of shape"),
    "negative weights": (lambda: SkinWeights("/w", [[0, 1]], [[1.5, -0.5]]), "1 skinning weights are negative"),
    "empty rows": (lambda: SkinWeights("/w", [[0, 1]] * 2, [[1, 0], [0, 0]]), "1 vertices have no skinning weight"),
    "NaN weights": (lambda: SkinWeights("/w", [[0]], [[np.nan]]), "1 of 1 weight rows hold NaN"),
    "weights past the joints": (lambda: ONES.check_joints(0), "3 joint indices lie outside"),
    "no points": (lambda: Mesh("/m", np.zeros((0, 3)), FACES), "the mesh has no points"),
    "no faces": (lambda: Mesh("/m", POINTS, np.zeros((0, 3))), "the mesh has no faces"),
    "NaN points": (lambda: Mesh("/m", with_nan(POINTS), FACES), "1 of 3 points hold NaN"),
    "faces past the points": (lambda: Mesh("/m", POINTS, [[0, 1, 3]]), "1 face indices lie outside 0 to 2"),
    "negative faces": (lambda: Mesh("/m", POINTS, [[0, 1, -1]]), "1 face indices lie outside"),
    "polygons too short": (lambda: Mesh("/m", POINTS, FACES, [3], [0, 1]), "polygons do not fit"),
    "polygons past the points": (lambda: Mesh("/m", POINTS, FACES, [3], [0, 1, 5]), "polygons do not fit"),
    "too few uvs": (lambda: Mesh("/m", POINTS, FACES, uvs=np.zeros((2, 2))), "texture coordinates do not match"),
    "body weights of another mesh": (
        lambda: Body(MESH, SkinWeights("/w", [[0]], [[1.0]])),
        "1 weight rows for 3 points",
    ),
    "a body on missing joints": (
        lambda: Character("/c", skeleton(), (Body(MESH, SkinWeights("/w", [[9]] * 3, [[1.0]] * 3)),)),
        "3 joint indices lie outside 0 to 1",
    ),
    "no body": (lambda: Character("/c", skeleton(), ()).merged_body(), "no skinned body mesh"),
    "garment weights of another mesh": (
        lambda: Garment(MESH, SkinWeights("/w", [[0]], [[1.0]])),
        "1 weight rows for 3",
    ),
    "too many classes": (lambda: Garment(MESH, classes=[0] * 4), "4 vertex classes for 3 points"),
    "unknown classes": (lambda: Garment(MESH, classes=[0, 1, 3]), "1 vertex classes are not 0, 1 or 2"),
    "proxies of another count": (lambda: rig(parents=[0, 1]), "2 parents for 1 proxy joints"),
    "proxies of one name": (
        lambda: rig(joint_names=("P", "P"), parents=[0, 0], bind_transforms=EYES),
        "names repeat",
    ),
    "proxies that scale": (lambda: rig(bind_transforms=scaled(3.0)[:1]), "bind transform of joint 'P' scales"),
    "no frames": (lambda: motion(rotations=np.zeros((0, 2, 4)), translations=np.zeros((0, 2, 3))), "no frames"),
    "no rate": (lambda: motion(fps=0.0), "a rate of 0"),
    "an endless rate": (lambda: motion(fps=float("inf")), "a rate of inf"),
    "translations of other joints": (
        lambda: motion(translations=np.zeros((4, 3, 3))),
        r"\(frames, joints, 3\) are needed",
    ),
    "NaN rotations": (lambda: motion(rotations=with_nan(np.ones((4, 2, 4)))), "1 of 4 frames of rotations hold NaN"),
    "infinite translations": (
        lambda: motion(translations=np.full((4, 2, 3), np.inf)),
        "4 of 4 frames of translations",
    ),
    "a rotation of zero": (lambda: motion(rotations=np.zeros((4, 2, 4))), "zero quaternion"),
    "a garment without weights": (lambda: scene(Garment(MESH, None, [0, 1, 2])), "no skinning weights"),
    "a garment without classes": (lambda: scene(Garment(MESH, ONES)), "no vertex classes"),
    "a garment on proxies": (
        lambda: scene(Garment(MESH, SkinWeights("/w", [[2]] * 3, [[1.0]] * 3), [0, 1, 2])),
        "3 joint indices lie outside 0 to 1",
    ),
    "a rig of another garment": (
        lambda: scene(proxies=rig(skin=SkinWeights("/w", [[0]], [[1.0]]))),
        "1 rig weight rows for 3",
    ),
    "a proxy that hangs from itself": (lambda: scene(proxies=rig(parents=[2])), "precedes its parent or has none"),
    "a proxy that hangs from nothing": (lambda: scene(proxies=rig(parents=[-1])), "precedes its parent or has none"),
    "shapes of another mesh": (
        lambda: Deformer(scene(), ONES, np.zeros((2, 5, 3))),
        r"blendshapes of shape \(2, 5, 3\)",
    ),
}


@pytest.mark.parametrize("build, words", WRONG.values(), ids=WRONG.keys())
def test_each_mistake_is_one_sentence(build, words):
    with pytest.raises(SsilkError) as error:
        build()
    text = str(error.value)
    assert re.search(words, text), text
    assert re.match(r"/\w+: ", text) and text.endswith(".") and "\n" not in text


def test_arrays_are_copied_and_frozen():
    points = POINTS.copy()
    mesh = Mesh("/m", points, FACES)
    points[0] = 9
    np.testing.assert_array_equal(mesh.points, POINTS)
    with pytest.raises(ValueError, match="read-only"):
        mesh.points[0] = 9
    with pytest.raises(FrozenInstanceError):
        mesh.path = "/n"


def test_weights_are_normalised_and_dense_adds_repeated_joints():
    skin = SkinWeights("/w", [[0, 2], [1, 1]], [[1.0, 3.0], [2.0, 2.0]])
    np.testing.assert_allclose(skin.weights, [[0.25, 0.75], [0.5, 0.5]])
    np.testing.assert_allclose(skin.dense(3), [[0.25, 0, 0.75], [0, 1, 0]])


def test_from_dense_keeps_the_largest_and_renormalises():
    dense = np.array([[0.5, 0.3, 0.2], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(SkinWeights.from_dense("/w", dense).dense(3), dense)
    two = SkinWeights.from_dense("/w", dense, influences=2)
    assert two.indices.shape == (2, 2)
    np.testing.assert_allclose(two.dense(3), [[0.625, 0.375, 0], [0, 1, 0]])


def test_polygons_default_to_the_triangles():
    mesh = Mesh("/m", np.zeros((4, 3)), [[0, 1, 2], [0, 2, 3]])
    assert mesh.polygon_counts.tolist() == [3, 3] and mesh.polygon_indices.tolist() == [0, 1, 2, 0, 2, 3]
    quad = Mesh("/m", np.zeros((4, 3)), [[0, 1, 2], [0, 2, 3]], [4], [0, 1, 2, 3], np.zeros((4, 2)))
    assert quad.uvs.shape == (4, 2)


def test_bodies_are_merged_in_order():
    wide = Body(Mesh("/n", POINTS + 1, FACES), SkinWeights("/n", [[0, 1]] * 3, [[0.5, 0.5]] * 3))
    merged = Character("/c", skeleton(), (Body(MESH, ONES), wide)).merged_body()
    np.testing.assert_array_equal(merged.mesh.points, np.concatenate([POINTS, POINTS + 1]))
    np.testing.assert_array_equal(merged.mesh.faces, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_allclose(merged.skin.dense(2), [[1, 0]] * 3 + [[0.5, 0.5]] * 3)
    assert Character("/c", skeleton(), (wide,)).merged_body() is wide


def test_rotations_are_made_unit_and_clips_remember_where_they_began():
    whole = motion(rotations=np.tile([2.0, 0, 0, 0], (4, 2, 1)), start=10.0)
    np.testing.assert_allclose(whole.rotations[..., 0], 1)
    part = whole.clip(1, 3)
    assert (part.frame_count, part.start) == (2, 11.0)


def test_a_scene_counts_proxies_after_the_characters_joints():
    twice = rig(joint_names=("P", "P/Q"), parents=[1, 2], bind_transforms=EYES)
    whole = scene(proxies=twice)
    assert whole.joint_names == ("A", "A/B", "P", "P/Q") and whole.parents.tolist() == [-1, 0, 1, 2]
    assert whole.bind_transforms.shape == (4, 4, 4)
    none = scene(proxies=rig(joint_names=(), parents=[], bind_transforms=[]))
    assert none.rig.proxy_count == 0 and none.bind_transforms.shape == (2, 4, 4)
    assert replace(none, rig=twice).joint_names == whole.joint_names
