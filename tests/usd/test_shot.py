# SPDX-License-Identifier: Apache-2.0
"""A written shot, re-skinned by UsdSkel alone, is what the decoder computes."""

from pathlib import Path

import numpy as np
import pytest
from ssilk_usd.play import Shot
from ssilk_usd.read_polygons import triangulate
from ssilk_usd.shot import write_shot
from ssilk_usd.units import StageUnits

from ssilk_core.assets import (
    Body,
    Character,
    Deformer,
    Garment,
    GarmentPose,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.kinematics import deform, local_transforms, matrix_from_quaternion, rigid

SHARED = Path(__file__).parents[2] / ".." / "shared"
METRES_Y, CENTIMETRES_Z = StageUnits(1.0, "Y"), StageUnits(0.01, "Z")
FRAMES = 20


def quaternions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def strip(name: str, rows: int = 9, columns: int = 4) -> Mesh:
    """A hanging strip of quads, the first two merged to a hexagon, the last split into triangles."""
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    points = np.stack([0.4 * u - 0.2, 1.5 - v, 0.1 * np.sin(3 * u)], axis=-1).reshape(-1, 3)
    corner = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    a, b = quads[:2]
    polygons = [
        [a[0], a[1], a[2], b[2], b[3], a[3]],
        *quads[2:-1].tolist(),
        quads[-1][:3].tolist(),
        quads[-1][[0, 2, 3]].tolist(),
    ]
    counts, indices = np.array([len(p) for p in polygons]), np.concatenate(polygons)
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)[indices]
    return Mesh(name, points, triangulate(points, counts, indices), counts, indices, uvs)


def random_skin(rng: np.random.Generator, vertices: int, joints: int) -> SkinWeights:
    weights = rng.random((vertices, 4)) * (rng.random((vertices, 4)) > 0.4)
    weights[:, 0] += 0.1
    return SkinWeights("strip", rng.integers(0, joints, (vertices, 4)), weights)


def make_scene(rng: np.random.Generator, proxies: int) -> Scene:
    parents = np.array([-1, 0, 1])
    bind = rigid(matrix_from_quaternion(quaternions(rng, 3)), np.array([[0, 1.0, 0], [0, 1.3, 0], [0.1, 1.5, 0]]))
    rest = local_transforms(bind, parents)
    skeleton = Skeleton("hero.usda:/Hero/Rig", ("Hips", "Hips/Spine", "Hips/Spine/Head"), parents, bind, rest)
    body = strip("hero.usda:/Hero/Body")
    character = Character("hero.usda:/Hero", skeleton, (Body(body, random_skin(rng, body.vertex_count, 3)),))
    mesh = strip("cape.usda:/Cape/cape mesh")
    garment = Garment(mesh, random_skin(rng, mesh.vertex_count, 3), rng.integers(0, 3, mesh.vertex_count))
    names = ("Hips/Spine/proxy_0", "Hips/Spine/proxy_0/proxy_1")[:proxies]
    proxy_bind = rigid(matrix_from_quaternion(quaternions(rng, proxies)), rng.normal(size=(proxies, 3)))
    skin = random_skin(rng, mesh.vertex_count, 3 + proxies)
    return Scene(
        character, garment, ProxyRig("cape.usda:/Cape", names, np.array([1, 3][:proxies], int), proxy_bind, skin)
    )


def make_deformer(rng: np.random.Generator, *, proxies: int = 2, shapes: int = 3) -> Deformer:
    scene = make_scene(rng, proxies)
    offsets = 0.05 * rng.normal(size=(shapes, scene.garment.mesh.vertex_count, 3))
    offsets[:, scene.classes == 0] = 0
    return Deformer(scene, scene.rig.skin, offsets)


def make_motion(rng: np.random.Generator, *, fps: float = 30.0, away: float = 0.0) -> Motion:
    translations = np.tile(np.array([[0, 1.0, 0], [0, 0.3, 0], [0.1, 0.2, 0]]), (FRAMES, 1, 1))
    translations[:, 0] += rng.normal(size=(FRAMES, 3)) + away * np.array([0.6, 0, 0.8])
    return Motion("walk.usda:/Walk", fps, quaternions(rng, FRAMES, 3), translations)


def make_poses(
    rng: np.random.Generator, deformer: Deformer, chunks: tuple[int, ...] = (7, 8, 5)
) -> list[GarmentPose]:
    starts = np.cumsum((0, *chunks[:-1]))
    proxies, shapes = deformer.scene.rig.proxy_count, deformer.shape_count
    return [
        GarmentPose(int(start), quaternions(rng, count, proxies), rng.random((count, shapes)))
        for start, count in zip(starts, chunks)
    ]


def worst_error(path: Path, deformer: Deformer, motion: Motion, poses: list[GarmentPose]) -> float:
    """Largest distance [m] between UsdSkel's points and the decoder's, over garment and body."""
    shot = Shot(path)
    expected = np.concatenate([deform(deformer, motion, pose) for pose in poses])
    played = np.stack([shot.garment_points(time) for time in shot.frame_times])
    return float(np.linalg.norm(played - expected, axis=-1).max())


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
@pytest.mark.parametrize("proxies, shapes", [(2, 3), (0, 3), (2, 0), (0, 0)])
@pytest.mark.parametrize("fps, start", [(30.0, 0.0), (24.0, 1001.0), (60.0, -3.5)])
def test_usdskel_reproduces_the_decoder(tmp_path, units, proxies, shapes, fps, start):
    rng = np.random.default_rng(3)
    deformer, motion = make_deformer(rng, proxies=proxies, shapes=shapes), make_motion(rng, fps=fps)
    poses = make_poses(rng, deformer)
    summary = write_shot(tmp_path / "shot.usdc", deformer, motion, poses, units=units, start=start)
    assert (summary.frame_count, summary.start, summary.end, summary.fps) == (FRAMES, start, start + FRAMES - 1, fps)
    assert worst_error(tmp_path / "shot.usdc", deformer, motion, poses) < 2e-6
