# SPDX-License-Identifier: Apache-2.0
"""The wardrobe: clean meshes, off the body, on bodies of other sizes and rigs too."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import igl
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path

from ssilk_core.demo.garments import GARMENTS, build_garment
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Body, Character, Garment
from ssilk_core.scene.mesh.topology import edge_use, half_edges

HOLES = {"cape": 1, "fringe_skirt": 2, "hooded_dress": 4}
each_garment = pytest.mark.parametrize("name", GARMENTS)


@cache
def character() -> Character:
    return read_character(demo_body_path())


@cache
def garment(name: str) -> Garment:
    return build_garment(name, character())


def distances(body: Body, points: np.ndarray) -> np.ndarray:
    return igl.signed_distance(points, np.array(body.mesh.points), np.array(body.mesh.faces))[0]


def samples(dressed: Garment) -> np.ndarray:
    """All points, and several in the inside of each face."""
    mesh, weights = dressed.mesh, np.random.default_rng(0).dirichlet([1, 1, 1], size=(5, len(dressed.mesh.faces)))
    inner = np.einsum("kfc,fcx->kfx", weights, mesh.points[mesh.faces]).reshape(-1, 3)
    return np.concatenate([mesh.points, inner])


def parts(faces: np.ndarray, count: int) -> int:
    edges = edge_use(faces)[0]
    labels = connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(count, count)))[1]
    return len(np.unique(labels[np.unique(faces)]))


def lengths(dressed: Garment) -> np.ndarray:
    corners = dressed.mesh.points[dressed.mesh.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)


@each_garment
def test_mesh_is_one_clean_manifold_piece(name: str) -> None:
    mesh = garment(name).mesh
    assert 1500 <= mesh.vertex_count <= 6000
    assert edge_use(mesh.faces)[1].max() == 2
    assert np.all(igl.is_vertex_manifold(np.array(mesh.faces)))
    halves = half_edges(mesh.faces)
    assert len(np.unique(halves, axis=0)) == len(halves), "two faces run along an edge the same way"
    assert np.array_equal(np.unique(mesh.faces), np.arange(mesh.vertex_count))
    assert parts(mesh.faces, mesh.vertex_count) == 1
    assert len(igl.boundary_loop_all(np.array(mesh.faces))) == HOLES[name]


@each_garment
def test_triangles_are_even(name: str) -> None:
    edges = lengths(garment(name))
    area = 0.5 * igl.doublearea(np.array(garment(name).mesh.points), np.array(garment(name).mesh.faces))
    shape = 4 * np.sqrt(3) * area / (edges**2).sum(axis=1)  # 1 for an equilateral triangle
    assert shape.min() > 0.35
    assert np.percentile(shape, 2) > 0.65
    assert edges.max() < 2.2 * np.median(edges)


@each_garment
def test_stays_off_the_body_and_faces_outward(name: str) -> None:
    body, mesh = character().merged_body(), garment(name).mesh
    assert distances(body, samples(garment(name))).min() > 6e-3
    _, _, closest, _ = igl.signed_distance(
        np.array(mesh.points), np.array(body.mesh.points), np.array(body.mesh.faces)
    )
    normals = igl.per_vertex_normals(np.array(mesh.points), np.array(mesh.faces))
    away = mesh.points - closest
    close = np.linalg.norm(away, axis=1) < 0.03
    assert close.sum() > 50
    assert (np.sum(normals * away, axis=1)[close] > 0).mean() > 0.97


@pytest.mark.parametrize(("name", "scale"), [("cape", 1.25), ("fringe_skirt", 0.8), ("hooded_dress", 0.8)])
def test_fits_bodies_of_other_sizes(name: str, scale: float) -> None:
    person = resized(character(), scale)
    assert distances(person.merged_body(), samples(build_garment(name, person))).min() > 6e-3


def resized(person: Character, scale: float) -> Character:
    body, skeleton = person.merged_body(), person.skeleton
    bind, rest = skeleton.bind_transforms.copy(), skeleton.rest_transforms.copy()
    bind[:, :3, 3] *= scale
    rest[:, :3, 3] *= scale
    skeleton = replace(skeleton, bind_transforms=bind, rest_transforms=rest)
    return replace(
        person, skeleton=skeleton, bodies=(replace(body, mesh=replace(body.mesh, points=body.mesh.points * scale)),)
    )


def test_a_rig_with_foreign_joint_names_is_fitted_by_proportion() -> None:
    skeleton = character().skeleton
    names = tuple(f"bone_{joint}" for joint in range(skeleton.joint_count))
    person = replace(character(), skeleton=replace(skeleton, joint_names=names))
    cape = build_garment("cape", person)
    assert distances(person.merged_body(), samples(cape)).min() > 6e-3
    assert np.abs(cape.mesh.points.max(axis=0) - garment("cape").mesh.points.max(axis=0)).max() < 0.1


def test_cape_covers_the_shoulders_and_leaves_the_front_open() -> None:
    points = garment("cape").mesh.points
    joints = dict(zip(character().skeleton.joint_names, character().skeleton.bind_transforms[:, :3, 3]))
    shoulder = next(place for name, place in joints.items() if name.endswith("/LeftArm"))
    knee = next(place for name, place in joints.items() if name.endswith("/LeftLeg"))
    above = points[(np.abs(points[:, 0] - shoulder[0]) < 0.03) & (points[:, 1] > shoulder[1])]
    assert len(above) > 5
    assert 0.1 < points[:, 1].min() < knee[1] - 0.1
    low = points[points[:, 1] < shoulder[1] - 0.2]
    assert low[:, 2].max() < 0.0, "below the chest the cape hangs behind the body"


def test_fringe_hangs_in_separate_strips() -> None:
    mesh = garment("fringe_skirt").mesh
    height = mesh.points[mesh.faces][:, :, 1].max(axis=1)
    strips = mesh.faces[height < mesh.points[:, 1].max() - 0.13]
    assert parts(strips, mesh.vertex_count) == 32


def test_unknown_garment_names_the_choices() -> None:
    with pytest.raises(SsilkError, match="cape, fringe_skirt, hooded_dress"):
        build_garment("toga", character())
