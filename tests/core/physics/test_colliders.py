# SPDX-License-Identifier: Apache-2.0
"""Colliders of many frames at once against all their triangles in each of them, and who needs to vote on sides."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from ssilk_core.physics import loops
from ssilk_core.physics.world import colliders as world
from ssilk_core.physics.world.colliders import ColliderPoser
from ssilk_core.physics.world.surface import CollisionSurface, PosedSurface
from ssilk_core.scene.assets import Collider, ShotWorld
from ssilk_core.scene.kinematics import matrix_from_quaternion, rigid

FPS, FRAMES, POINTS = 30.0, 7, 40
BALL, RING = trimesh.creation.icosphere(subdivisions=2, radius=0.5), trimesh.creation.torus(1.0, 0.3, 12, 8)
ROOM = trimesh.creation.box((3.0, 4.0, 3.0))
EVERY = np.ones(1, dtype=bool)


def hills(rng) -> tuple[np.ndarray, np.ndarray]:
    """A patch of uneven ground that faces up."""
    side = np.linspace(-2, 2, 9)
    x, z = np.meshgrid(side, side, indexing="ij")
    points = np.stack([x, 0.2 * rng.normal(size=x.shape), z], axis=-1).reshape(-1, 3)
    row, column = (part.reshape(-1) for part in np.mgrid[:8, :8])
    a = 9 * row + column
    return points, np.concatenate([np.c_[a, a + 1, a + 9], np.c_[a + 1, a + 10, a + 9]])


def turning(rng) -> np.ndarray:
    """Placements (F, 4, 4) that turn and move from frame to frame."""
    turns = rng.normal(size=(FRAMES, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return rigid(matrix_from_quaternion(turns), rng.normal(size=(FRAMES, 3)))


def around(rng) -> dict[str, Collider]:
    """Colliders that keep still, turn, bend, come and go."""
    ground, faces = hills(rng)
    bent = BALL.vertices * rng.uniform(0.7, 1.3, (FRAMES, 1, 3)) + rng.normal(size=(FRAMES, 1, 3))
    waves = ground + 0.3 * rng.normal(size=(FRAMES, 1, 3)) + 0.05 * rng.normal(size=(FRAMES, *ground.shape))
    comes = np.arange(FRAMES) % 3 != 1
    return {
        "ground": Collider("/ground", faces, ground[None], np.eye(4)[None], EVERY),
        "ceiling": Collider("/ceiling", faces, ground[None] + [0, 2.5, 0], np.eye(4)[None], EVERY),
        "ring": Collider("/ring", RING.faces, RING.vertices[None], turning(rng), EVERY),
        "waves": Collider("/waves", faces, waves, np.eye(4)[None], EVERY),
        "mirrored": Collider(
            "/mirrored",
            BALL.faces,
            bent * [-1, 1, 1] ** (np.arange(FRAMES) > 2)[:, None, None],
            np.eye(4)[None],
            EVERY,
        ),
        "ball": Collider("/ball", BALL.faces, bent, np.eye(4)[None], comes),
        "room": Collider("/room", ROOM.faces, ROOM.vertices[None], np.eye(4)[None], EVERY),
    }


def expected(collider: Collider, frame: int, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of a collider nearest to queries (M, 3) in the world, (M, 3), and whether these are inside, (M,)."""
    place = collider.placements[min(frame, len(collider.placements) - 1)]
    points = collider.points[min(frame, len(collider.points) - 1)] @ place[:3, :3].T + place[:3, 3]
    found = np.stack(
        [
            trimesh.triangles.closest_point(np.repeat(triangle[None], len(queries), axis=0), queries)
            for triangle in points[collider.faces]
        ]
    )
    best = np.linalg.norm(found - queries, axis=2).argmin(axis=0)
    mesh = trimesh.Trimesh(points, collider.faces)
    inside = mesh.contains(queries) if mesh.is_watertight else np.zeros(len(queries), dtype=bool)
    return found[best, np.arange(len(queries))], ~inside if collider.path == "/room" else inside


@pytest.mark.parametrize(
    "name, compiled",
    [(name, False) for name in ("ground", "ceiling", "ring", "room", "waves", "mirrored", "ball", "all")]
    + [(name, True) for name in ("waves", "mirrored", "ball", "all")],
)
def test_frames_at_once_have_the_distances_of_all_triangles_in_each(name: str, compiled: bool, monkeypatch) -> None:
    if compiled and not loops.installed():
        pytest.skip("numba is not installed")
    monkeypatch.setattr(world, "COMPILED_FROM", 0 if compiled else np.inf)
    rng = np.random.default_rng(4)
    own = around(rng)
    colliders = tuple(own.values()) if name == "all" else (own[name],)
    queries = rng.uniform([-1, 0.8, -1], [1, 1.6, 1], (FRAMES, POINTS, 3))
    garment = rng.uniform([-1, 0.8, -1], [1, 1.6, 1], (FRAMES, 30, 3))
    seconds, within = np.arange(FRAMES) / FPS, 1.2
    distance, normal = ColliderPoser().nearest(ShotWorld(FPS, colliders), seconds, queries, garment, within)
    nearest, gradient = np.full((FRAMES, POINTS), np.inf), np.zeros((FRAMES, POINTS, 3))
    for frame in range(FRAMES):
        for collider in colliders:
            if not collider.is_there(FPS, frame / FPS):
                continue
            on, inside = expected(collider, frame, queries[frame])
            length = np.linalg.norm(queries[frame] - on, axis=1)
            signed = np.where(inside, -length, length)
            closer = (signed <= within) & (signed < nearest[frame])
            nearest[frame, closer] = signed[closer]
            away = (queries[frame] - on) / signed[:, None]
            gradient[frame, closer] = away[closer]
    np.testing.assert_allclose(distance, nearest, atol=1e-12)
    np.testing.assert_allclose(normal, gradient, atol=1e-9)
    assert np.isfinite(distance).any()
    assert name not in ("ring", "ball") or (distance < 0).any()
    assert name != "ball" or np.isinf(distance).all(axis=1).any()


@pytest.mark.parametrize("kind", ["ground", "ground upside down", "ground and ball", "room"])
def test_who_needs_no_vote_would_have_voted_for_the_same_sides(kind: str, monkeypatch) -> None:
    rng = np.random.default_rng(5)
    points, faces = (ROOM.vertices, ROOM.faces) if kind == "room" else hills(rng)
    if kind == "ground upside down":
        faces = faces[:, ::-1]
    if kind == "ground and ball":
        points, faces = np.concatenate([points, BALL.vertices]), np.concatenate([faces, BALL.faces + len(points)])
    surface = CollisionSurface("/prop", points, faces).at(points)
    heights = np.linspace(-4, 4, 41)
    garments = rng.uniform(-0.4, 0.4, (len(heights), 20, 3)) + heights[:, None, None] * [0, 1, 0]
    decided = surface.needs_no_vote(garments.min(axis=1), garments.max(axis=1))
    found = [surface.outside(each) for each in garments]
    monkeypatch.setattr(PosedSurface, "needs_no_vote", lambda *_: False)
    np.testing.assert_array_equal(found, [surface.outside(each) for each in garments])
    assert decided.any() and not decided.all()
    assert (np.array(found) < 0).any()
