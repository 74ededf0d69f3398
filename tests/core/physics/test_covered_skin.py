# SPDX-License-Identifier: Apache-2.0
"""The share of covered skin that shows: against a closed form, and rays against a slow reference in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from ssilk_core.physics.collision import RayCaster, ray_casting
from ssilk_core.physics.refine.clearing import POINTS
from ssilk_core.physics.skin.covered_points import SEED, CoveredPoints, SkinStates, spread_points
from ssilk_core.physics.skin.covered_skin import CoveredSkin, ShownCounts
from ssilk_core.scene.assets import Body, Garment, Mesh, ProxyRig, Scene, SkinWeights

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
CPU = torch.device("cpu")
RADIUS, GAP, CAP = 0.2, 0.02, 0.6  # of a ball and the shell around it [m]; cosine of the angle of a cap of the shell


def one_joint(path: str, count: int, joint: int = 0) -> SkinWeights:
    return SkinWeights(path, np.full((count, 1), joint), np.ones((count, 1)))


def shell_of(scene: Scene, keep: slice = slice(None)) -> Scene:
    """A ball, its upper half on the second joint, in a shell: as a whole, or its faces below or in the cap."""
    ball, shell = (trimesh.creation.icosphere(subdivisions=4, radius=radius) for radius in (RADIUS, RADIUS + GAP))
    skin = replace(one_joint("/ball", len(ball.vertices)), indices=(ball.vertices[:, 2:] > 0).astype(int))
    faces = shell.faces[np.argsort(shell.triangles_center[:, 2], kind="stable")][keep]
    garment = Garment(
        Mesh("/shell", shell.vertices, faces),
        one_joint("/shell", len(shell.vertices)),
        np.full(len(shell.vertices), 2),
    )
    rig = ProxyRig("/rig", (), [], np.zeros((0, 4, 4)), one_joint("/rig", len(shell.vertices)))
    character = replace(scene.character, bodies=(Body(Mesh("/ball", ball.vertices, ball.faces), skin),))
    return Scene(character, garment, rig)


def still(frames: int) -> torch.Tensor:
    return torch.eye(3, 4, device=DEVICE)[None, :, :, None].repeat(3, 1, 1, frames)


def posed(points: np.ndarray) -> torch.Tensor:
    return torch.tensor(points, dtype=torch.float32, device=DEVICE)[:, :, None]


def below_cap(scene: Scene) -> int:
    centres = scene.garment.mesh.points[scene.garment.mesh.faces].mean(axis=1)
    return int((centres[:, 2] < CAP * np.linalg.norm(centres, axis=1)).sum())


def test_a_cap_of_a_shell_covers_or_shows_its_share_of_the_sphere(scene):
    whole = shell_of(scene)
    skin = CoveredSkin(whole, device=DEVICE)
    assert len(skin) == 8000
    open_shell = CoveredSkin(shell_of(scene, slice(below_cap(whole))), device=DEVICE)
    cap = (1 - CAP) / 2  # share of the sphere, 2 pi R^2 (1 - cos) / 4 pi R^2
    assert len(open_shell) / 8000 == pytest.approx(1 - cap, abs=3e-3)

    # The cap sinks beneath the skin; the cloth that joins it to the rest is the shell's.
    points = whole.garment.mesh.points
    sunk = np.where(points[:, 2:] > CAP * (RADIUS + GAP), (RADIUS - 0.01) / (RADIUS + GAP), 1.0) * points
    deep = np.where(points[:, 2:] > CAP * (RADIUS + GAP), (RADIUS - 0.05) / (RADIUS + GAP), 1.0) * points
    x = torch.cat([posed(points), posed(sunk), posed(deep)], dim=-1)
    states = skin.states(x, still(3))
    shows = states.shows
    shares = shows.double().mean(0).tolist()
    assert shares[0] == 0
    assert shares[1] == pytest.approx(cap, abs=6e-3)
    assert shares[2] < 0.2 * cap  # beyond the reach, but for the slope at its border
    counts = ShownCounts.of(states)
    calm = SkinStates(shows[:, :1], states.bare[:, :1])
    found = skin.figures([("calm", ShownCounts.of(calm)), ("rough", counts)])
    assert (found.covered, found.clip, found.frame) == (8000, "rough", 1)
    assert found.worst == shares[1] and found.mean == pytest.approx(sum(shares) / 4)
    assert found.regions == {"Spine": 1.0}
    assert int(counts.points.sum()) == int(shows.sum())
    bare = states.bare.double().mean(0).tolist()
    assert bare[:2] == [0, 0] and bare[2] == pytest.approx(cap, rel=0.2)
    assert found.worst_bare == bare[2] and found.bare == pytest.approx(bare[2] / 4)


def test_cloth_that_is_thrown_off_leaves_skin_bare_and_shows_nothing(scene):
    whole = shell_of(scene)
    skin, points = CoveredSkin(whole, device=DEVICE), whole.garment.mesh.points
    thrown = posed(points) + torch.tensor([0.0, 3.0, 0.0], device=DEVICE)[None, :, None]
    found = skin.figures([("flip", ShownCounts.of(skin.states(torch.cat([posed(points), thrown], -1), still(2))))])
    assert (found.mean, found.worst, found.bare, found.worst_bare) == (0, 0, 0.5, 1)
    assert str(found).endswith("50.00% is bare (100.00% at most)") and found.summary()["bare"] == "50.00%"
    assert "worst frame" not in str(found) and "in the worst frame" not in found.summary()  # no frame is worse
    lost = skin.states(torch.full_like(thrown, torch.nan), still(1))
    assert lost.shows.all() and not lost.bare.any()  # what is nowhere is no garment that was lifted


def test_points_move_with_the_skin(scene):
    skin = CoveredSkin(shell_of(scene), device=DEVICE)
    points = shell_of(scene).garment.mesh.points
    sunk = np.where(points[:, :1] > 0.1, 0.9 * RADIUS / (RADIUS + GAP), 1.0) * points
    turn = still(1)
    turn[:, :, :3, 0] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], device=DEVICE)
    turn[:, :, 3, 0] = torch.tensor([0.1, 0.2, 0.3], device=DEVICE)
    shows = skin.states(posed(sunk), still(1)).shows
    moved = np.stack([0.1 - sunk[:, 1], 0.2 + sunk[:, 0], 0.3 + sunk[:, 2]], axis=1)
    assert 0.1 < shows.double().mean() < 0.5
    assert (skin.states(posed(moved), turn).shows != shows).double().mean() < 1e-3  # but for rounding
    assert not torch.equal(skin.states(posed(sunk), turn).shows, shows)


@pytest.mark.parametrize("seed", [None, SEED])
def test_points_are_spread_evenly(scene, seed):
    ball = shell_of(scene).character.merged_body().mesh
    faces, weights = spread_points(ball, 8000, seed)
    assert (weights >= 0).all() and np.allclose(weights.sum(1), 1)
    points = (ball.points[ball.faces[faces]] * weights[..., None]).sum(1)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    inside = points @ (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T > CAP * RADIUS
    chance = np.sqrt((1 - CAP) / 2 * (1 + CAP) / 2 / 8000)
    assert np.std(inside.mean(axis=0) - (1 - CAP) / 2) < 0.5 * chance  # twice as even as points at random


def test_skin_is_judged_at_other_points_than_refinement_lifts_cloth_at(scene):
    """As near to those as points at random are: what lies between them counts as much as what lies on them."""
    ball = shell_of(scene).character.merged_body().mesh

    def places(*asked):
        faces, weights = spread_points(ball, *asked)
        return (ball.points[ball.faces[faces]] * weights[..., None]).sum(1)

    lifted = places(POINTS)
    near = cKDTree(lifted).query(places(8000, SEED))[0]
    random = np.random.default_rng(2).normal(size=(8000, 3))
    random *= RADIUS / np.linalg.norm(random, axis=1, keepdims=True)
    np.testing.assert_allclose(
        np.quantile(near, (0.1, 0.5, 0.9)), np.quantile(cKDTree(lifted).query(random)[0], (0.1, 0.5, 0.9)), rtol=0.06
    )


def test_rays_that_last_find_what_rays_anew_find(scene):
    """Cloth that crosses the skin to and fro, then leaves it; and a frame that is lost between others."""
    whole = shell_of(scene)
    points = whole.garment.mesh.points
    sway = np.random.default_rng(3).normal(0, 0.02, (6, 3))
    x = torch.cat([posed(points * (1 - 0.03 * frame) + off) for frame, off in enumerate(sway)], -1).cpu()
    x[..., 3] = torch.nan
    body = torch.from_numpy(whole.character.merged_body().mesh.points.copy())
    lasting, anew = (
        CoveredPoints(whole.character.merged_body().mesh, whole.garment.mesh, device=CPU) for _ in range(2)
    )
    at = body[lasting.vertices][:, :, None]
    together = lasting.states(x, at.expand(-1, -1, 6))
    for frame in reversed(range(6)):
        alone = anew.states(x[..., frame, None], at)
        assert torch.equal(together.shows[:, frame, None], alone.shows)
        assert torch.equal(together.bare[:, frame, None], alone.bare)
    corners = at[torch.from_numpy(np.searchsorted(lasting.vertices, whole_faces(whole)[lasting.faces]))].float()
    weights = torch.from_numpy(lasting.weights).float()[..., None, None]
    start = (corners * weights).sum(1)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=1)
    normal /= normal.norm(dim=1, keepdim=True)
    caster = RayCaster(whole.garment.mesh, device=CPU)
    finite = [0, 1, 2, 4, 5]
    asked = (each.expand(-1, -1, 5) for each in (start, normal))
    hits = caster.cast(*asked, x[..., finite].float(), above=0.08, beneath=0.03)
    shows = together.shows[:, finite]
    assert 0.02 < shows.double().mean() < 0.9
    assert ((hits.beneath & ~hits.above) != shows).double().mean() < 1e-4  # but for rounding
    assert together.shows[:, 3].all() and not together.bare[:, 3].any()


def whole_faces(scene: Scene) -> np.ndarray:
    return scene.character.merged_body().mesh.faces


def test_a_garment_that_covers_nothing_has_no_figure(scene):
    far = shell_of(scene)
    mesh = far.garment.mesh
    far = replace(far, garment=replace(far.garment, mesh=replace(mesh, points=mesh.points + [2, 0, 0])))
    skin = CoveredSkin(far, device=DEVICE)
    states = skin.states(posed(mesh.points), still(1))
    assert states.shows.shape == (0, 1)
    assert skin.figures([("clip", ShownCounts.of(states))]) is None


@pytest.mark.parametrize("limit", [400, 1 << 20])  # two rays at once; all of several frames
def test_rays_meet_what_a_slow_search_finds(monkeypatch, limit):
    monkeypatch.setattr(ray_casting, "MAX_RAY_PAIRS", (limit, limit))
    compared, search = [], ray_casting._reachable
    monkeypatch.setattr(
        ray_casting,
        "_reachable",
        lambda start, *rest: compared.append(len(start) * start.shape[1] * rest[1].shape[1]) or search(start, *rest),
    )
    random = np.random.default_rng(1)
    sheet = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    x = sheet.vertices[:, :, None] + random.normal(0, 0.02, (len(sheet.vertices), 3, 3)) + [[[0.0, 1.0, 5.0]]]
    points = random.normal(0, 1, (200, 3, 3))
    points *= random.uniform(0.2, 0.4, (200, 1, 3)) / np.linalg.norm(points, axis=1, keepdims=True)
    directions = random.normal(0, 1, points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points += [[[0.0, 1.0, 5.0]]]
    caster = RayCaster(Mesh("/sheet", sheet.vertices, sheet.faces), device=DEVICE)
    asked = [torch.as_tensor(values, dtype=torch.float32, device=DEVICE) for values in (points, directions, x)]
    found = caster.cast(*asked, above=0.08, beneath=0.03)
    outermost, triangle = (each.cpu().numpy() for each in caster.outermost(*asked, above=0.08, beneath=0.03))
    assert max(compared) <= max(limit, len(caster.patches))
    for frame in range(3):
        distance = distances_by_solving(points[..., frame], directions[..., frame], x[sheet.faces, :, frame])
        above, beneath = ((distance >= low) & (distance <= high) for low, high in ((0, 0.08), (-0.03, 0)))
        np.testing.assert_array_equal(found.above[:, frame].cpu(), above.any(axis=1))
        np.testing.assert_array_equal(found.beneath[:, frame].cpu(), beneath.any(axis=1))
        assert 10 < above.any(axis=1).sum() < 180 and 10 < beneath.any(axis=1).sum() < 180
        met = (above | beneath).any(axis=1)
        within = np.where(above | beneath, distance, -np.inf)
        np.testing.assert_allclose(outermost[met, frame], within.max(axis=1)[met], atol=1e-5)
        np.testing.assert_array_equal(triangle[met, frame], within.argmax(axis=1)[met])
        assert np.isneginf(outermost[~met, frame]).all()


def distances_by_solving(points: np.ndarray, directions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distances (P, F) at which each line meets each triangle, infinity where it does not."""
    a = triangles[None, :, 0]
    sides = np.stack(np.broadcast_arrays(triangles[:, 1] - a, triangles[:, 2] - a, -directions[:, None]), axis=-1)
    u, v, t = np.moveaxis(np.linalg.solve(sides, (points[:, None] - a)[..., None])[..., 0], -1, 0)
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1), t, np.inf)
