# SPDX-License-Identifier: Apache-2.0
"""Scenes and trained models made larger, smaller, finer, coarser or worse meshed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...network.checkpoint import ModelFile
from ...network.parameters import on_moved_garment
from ...network.runtime.deformer import deformer
from ...scene.assets import PINNED, Body, Floats, Garment, Ints, Mesh, Scene, SkinWeights

INFLUENCES = 8


@dataclass(frozen=True, eq=False)
class Cloth:
    """A garment with dense weights: points (V, 3), LBS (V, J) and rig weights (V, J + P), classes (V,); and what else
    its vertices have, (V, ...)."""

    points: Floats
    lbs: Floats
    rig: Floats
    classes: Ints
    more: Floats


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
    points = scene.garment.mesh.points
    cloth = Cloth(points, lbs, whole, scene.classes, points[:, :0])
    while len(cloth.points) < count:
        cloth, faces = _subdivided(cloth, faces)
    return _garbed(scene, *_patch(cloth, faces, count))


def scale_model(file: ModelFile, scene: Scene, scale: float) -> tuple[ModelFile, Scene]:
    """Return a trained model and its scene scaled by `scale`: at rest it is the same, but larger."""
    shapes, moved = ("decoder.shapes", "decoder.offset"), dict(file.parameters)
    last = max(int(name.split(".")[1]) for name in moved if name.startswith("output."))
    rows = np.zeros((scene.rig.proxy_count, file.config.proxy_outputs), dtype=bool)
    rows[:, 6:] = True  # displacements of proxies
    factor = np.where(np.append(np.zeros(file.config.activation_count, dtype=bool), rows), scale, 1.0)
    factors = {
        **dict.fromkeys(shapes, scale), f"output.{last}.weight": factor[:, None], f"output.{last}.bias": factor,
    }  # fmt: skip
    moved |= {name: (moved[name] * by).astype(np.float32) for name, by in factors.items() if name in moved}
    return replace(file, parameters=moved), scale_scene(scene, scale)


def refine_model(file: ModelFile, scene: Scene, count: int) -> tuple[ModelFile, Scene]:
    """Return a trained model on a finer mesh of about `count` vertices, of which the first are its own.

    New vertices lie amid others, with their mean blendshapes and weights, so that the network moves the same cloth.
    """
    joints, faces = scene.character.skeleton.joint_count, scene.garment.mesh.faces
    free, worn = scene.classes != PINNED, deformer(file).skin
    of_vertices = ("decoder.shapes", "decoder.offset", "decoder.skin_offset")
    own = {name: file.parameters[name] for name in of_vertices[:2] if name in file.parameters}
    more = np.zeros((len(free), sum(values[0].size for values in own.values())), dtype=np.float32)
    more[free] = np.hstack([values.reshape(len(values), -1) for values in own.values()])
    lbs, rig = scene.lbs_skin.dense(joints), worn.dense(len(scene.joint_names))
    cloth = Cloth(scene.garment.mesh.points, lbs, rig, scene.classes, more)
    while len(cloth.points) + 3 * len(faces) // 2 < count:  # a vertex for each edge
        cloth, faces = _subdivided(cloth, faces)
    cloth, faces = _with_middles(cloth, faces, max(0, count - len(cloth.points)))
    finer, rows = _garbed(scene, cloth, faces, influences=None), cloth.more[cloth.classes != PINNED]
    others = {name: values for name, values in file.parameters.items() if name not in of_vertices}
    kept = np.where(np.arange(len(cloth.classes)) < len(free), cloth.classes, PINNED)
    coarse = replace(finer, garment=replace(finer.garment, classes=kept))  # the network sees no pinned cloth
    moved = on_moved_garment(others, coarse, finer, file.config)
    for name, values in own.items():
        part, rows = np.split(rows, [values[0].size], axis=1)
        moved[name] = part.reshape(-1, *values.shape[1:])
    moved["decoder.skin_offset"] = np.zeros(
        (len(moved["decoder.shapes"]), finer.rig.skin.indices.shape[1]), np.float32
    )
    return replace(file, parameters=moved), finer


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
    split = Cloth(between(cloth.points), between(cloth.lbs), between(cloth.rig), classes, between(cloth.more))
    return split, np.concatenate([np.stack(part, axis=1) for part in corners])


def _with_middles(cloth: Cloth, faces: Ints, count: int) -> tuple[Cloth, Ints]:
    """Split the first `count` triangles, or all, into three about their middles."""
    split, (a, b, c) = faces[:count], faces[:count].T
    middle = len(cloth.points) + np.arange(len(split))

    def joined(values: Floats) -> Floats:
        return np.concatenate([values, values[split].mean(axis=1)])

    classes = np.concatenate([cloth.classes, cloth.classes[split].max(axis=1)])
    thirds = [np.stack([*pair, middle], axis=1) for pair in ((a, b), (b, c), (c, a))]
    finer = Cloth(joined(cloth.points), joined(cloth.lbs), joined(cloth.rig), classes, joined(cloth.more))
    return finer, np.concatenate([*thirds, faces[count:]])


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
    kept = Cloth(points[used], cloth.lbs[used], cloth.rig[used], classes[used], cloth.more[used])
    return kept, compact.reshape(-1, 3)


def _garbed(scene: Scene, cloth: Cloth, faces: Ints, influences: int | None = INFLUENCES) -> Scene:
    path = scene.garment.mesh.path
    skin, rig = (SkinWeights.from_dense(path, values, influences) for values in (cloth.lbs, cloth.rig))
    garment = Garment(Mesh(path, cloth.points, faces), skin, cloth.classes)
    return Scene(scene.character, garment, replace(scene.rig, skin=rig))
