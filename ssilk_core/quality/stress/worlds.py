# SPDX-License-Identifier: Apache-2.0
"""Scenes made larger, smaller, finer, coarser or worse meshed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...scene.assets import Body, Floats, Garment, Ints, Mesh, Scene, SkinWeights

INFLUENCES = 8


@dataclass(frozen=True, eq=False)
class Cloth:
    """A garment with dense weights: points (V, 3), LBS (V, J) and rig weights (V, J + P), classes (V,)."""

    points: Floats
    lbs: Floats
    rig: Floats
    classes: Ints


def garment_size(scene: Scene) -> float:
    """Return the diagonal of a garment's bounding box at rest [m]."""
    return float(np.linalg.norm(np.ptp(scene.garment.mesh.points, axis=0)))


def scale_scene(scene: Scene, scale: float) -> Scene:
    """Return the scene scaled by `scale`."""
    skeleton, rig, garment = scene.character.skeleton, scene.rig, scene.garment
    grown = replace(
        skeleton,
        bind_transforms=_moved(skeleton.bind_transforms, scale),
        rest_transforms=_moved(skeleton.rest_transforms, scale),
    )
    bodies = [Body(_scaled(body.mesh, scale), body.skin) for body in scene.character.bodies]
    return Scene(
        replace(scene.character, skeleton=grown, bodies=tuple(bodies)),
        replace(
            garment,
            mesh=_scaled(garment.mesh, scale),
            sewn=None if garment.sewn is None else scale * garment.sewn,
        ),
        replace(rig, bind_transforms=_moved(rig.bind_transforms, scale)),
    )


def _moved(transforms: Floats, scale: float) -> Floats:
    moved = np.array(transforms)
    moved[:, :3, 3] *= scale
    return moved


def _scaled(mesh: Mesh, scale: float) -> Mesh:
    return replace(mesh, points=scale * mesh.points)


def add_slivers(scene: Scene, height: float, every: int = 100) -> Scene:
    """Return the scene with one in `every` triangles turned into a sliver with ratio `height` of height to base.

    The tip of the triangle moves next to the middle of the opposite edge. Slivers share no vertices.
    """
    garment, mesh = scene.garment, scene.garment.mesh
    sewn = None if garment.sewn is None else _with_slivers(garment.sewn, mesh.faces, height, every)
    places = _with_slivers(mesh.points, mesh.faces, height, every)
    thin = Mesh(mesh.path, places, mesh.faces, stiffness=mesh.stiffness)
    return replace(scene, garment=replace(garment, mesh=thin, sewn=sewn))


def _with_slivers(places: Floats, faces: Ints, height: float, every: int) -> Floats:
    points, used = np.array(places), np.zeros(len(places), dtype=bool)
    for face in faces[::every]:
        if used[face].any():
            continue
        used[face] = True
        a, b, tip = points[face]
        base, middle = b - a, (a + b) / 2
        rise = (tip - a) - base * ((tip - a) @ base) / (base @ base)
        points[face[2]] = middle + height * np.linalg.norm(base) * rise / max(np.linalg.norm(rise), 1e-300)
    return points


def resize_garment(scene: Scene, count: int) -> Scene:
    """Return the scene with a garment of about `count` vertices: a patch of it, subdivided as often as needed."""
    skin, rig, faces = scene.lbs_skin, scene.rig.skin, scene.garment.mesh.faces
    lbs, whole = skin.dense(scene.character.skeleton.joint_count), rig.dense(len(scene.joint_names))
    cloth = Cloth(scene.garment.mesh.points, lbs, whole, scene.classes)
    while len(cloth.points) < count:
        cloth, faces = _subdivided(cloth, faces)
    return _garbed(scene, *_patch(cloth, faces, count))


def _subdivided(cloth: Cloth, faces: Ints) -> tuple[Cloth, Ints]:
    """Split every triangle into four; a new vertex is the mean of two, and takes the looser of their classes."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, index = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (index.reshape(-1, 3) + len(cloth.points)).T
    a, b, c = faces.T
    corners = (a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)

    def between(values: Floats) -> Floats:
        return np.concatenate([values, values[pairs].mean(axis=1)])

    classes = np.concatenate([cloth.classes, cloth.classes[pairs].max(axis=1)])
    split = Cloth(between(cloth.points), between(cloth.lbs), between(cloth.rig), classes)
    return split, np.concatenate([np.stack(part, axis=1) for part in corners])


def _patch(cloth: Cloth, faces: Ints, count: int) -> tuple[Cloth, Ints]:
    """Keep the faces nearest to the border of loose cloth, until they have `count` vertices."""
    points, classes = cloth.points, cloth.classes
    mixed = faces[np.ptp(classes[faces], axis=1) > 0]
    seed = points[mixed[0, 0] if len(mixed) else faces[0, 0]]
    order = np.argsort(np.linalg.norm(points[faces] - seed, axis=2).max(axis=1), kind="stable")
    _, first = np.unique(faces[order], return_index=True)
    newly = np.bincount(first // 3, minlength=len(faces))  # number of new vertices per face, in this order
    most = max(1, int(np.searchsorted(np.cumsum(newly), count, side="right")))
    used, compact = np.unique(faces[order[:most]], return_inverse=True)
    kept = Cloth(points[used], cloth.lbs[used], cloth.rig[used], classes[used])
    return kept, compact.reshape(-1, 3)


def _garbed(scene: Scene, cloth: Cloth, faces: Ints) -> Scene:
    path = scene.garment.mesh.path
    skin, rig = (SkinWeights.from_dense(path, values, INFLUENCES) for values in (cloth.lbs, cloth.rig))
    garment = Garment(Mesh(path, cloth.points, faces), skin, cloth.classes)
    return Scene(scene.character, garment, replace(scene.rig, skin=rig))
