# SPDX-License-Identifier: Apache-2.0
"""Cloth that lies on cloth: sheets over sheets, borders, folds, and which side is out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.collision import nearest_planes
from ssilk_core.physics.collision.contacts import no_planes
from ssilk_core.physics.collision.inner_cloth import DEEPEST, InnerCloth, turned_away
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.reach import reachable_cloth
from ssilk_core.physics.samples import vertex_samples
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric

CPU = torch.device("cpu")
THICKNESS = 2e-3


def sheet(size: float = 0.4, count: int = 9, height: float = 0.0) -> Mesh:
    """A square in the plane y = height about the y axis, wound towards -y."""
    x, z = (part.reshape(-1) for part in np.meshgrid(*[np.linspace(-size / 2, size / 2, count)] * 2, indexing="ij"))
    row, column = (part.reshape(-1) for part in np.mgrid[: count - 1, : count - 1])
    a = row * count + column
    b, c, d = a + 1, a + count, a + count + 1
    return Mesh("/sheet", np.c_[x, np.full(len(x), height), z], np.concatenate([np.c_[a, c, b], np.c_[b, c, d]]))


def frames(points: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.asarray(points), dtype=torch.float32)[:, :, None]


@pytest.fixture(scope="module")
def over_sheet(scene):
    """An inner sheet above the toy's ball, and the queries of the toy's garment that can be set at will."""
    inner = sheet(height=1.4)

    def cloth(mesh: Mesh = inner) -> InnerCloth:
        outer, samples = scene.garment.mesh, vertex_samples(scene.garment.mesh.vertex_count)
        every = np.ones(mesh.vertex_count, dtype=bool), np.ones(outer.vertex_count, dtype=bool)
        return InnerCloth(scene, samples, mesh, THICKNESS, *every, device=CPU)

    return cloth, inner


def distances(cloth: InnerCloth, inner: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Distances from the middle of the cloth; queries stand for the last rows, which are loose."""
    x = torch.full((60, 3, 1), 9.0)
    x[-len(queries) :] = frames(queries)
    return cloth.distance(x, frames(inner)).numpy()[-len(queries) :, 0]


def test_a_sheet_over_a_sheet_lies_at_the_heights_of_the_law(over_sheet):
    """The energy of a sheet at a height over another is that of the law there, and its force points out."""
    make, inner = over_sheet
    cloth, law = make(), ContactLaw.of(Fabric("toy", margin=0.01, thickness=1e-3))
    for height in (0.02, 0.009, 0.004, -0.003, -0.03):
        x = torch.full((60, 3, 1), 9.0)
        x[-20:] = frames(np.c_[np.linspace(-0.1, 0.1, 20), np.full(20, 1.4 + height), np.linspace(-0.07, 0.1, 20)])
        normal, offset = cloth.deeper(no_planes(x), x, frames(inner.points))
        at = (normal * x).sum(1) - offset
        np.testing.assert_allclose(at[-20:, 0], height - THICKNESS / 2, atol=2e-6)
        np.testing.assert_allclose(normal[-20:, :, 0], np.tile([0, 1, 0], (20, 1)), atol=1e-4)
        expected = law.energy(torch.tensor(height - THICKNESS / 2))
        np.testing.assert_allclose(law.energy(at[-20:, 0]), expected, rtol=2e-3, atol=1e-9)
        assert (law.pressure(at[-20:, 0]) > 0).all() == (height < 0.011)


def test_past_a_hem_there_is_nothing_to_come_out_of(over_sheet):
    make, inner = over_sheet
    past = [[0.22, 1.39, 0.03], [0.203, 1.393, 0.0], [0.25, 1.38, 0.25], [0.0, 1.385, -0.21]]
    assert (distances(make(), inner.points, past) > 0.005).all()
    beneath = [[0.198, 1.39, 0.03], [0.17, 1.38, 0.1], [0.0, 1.36, 0.0], [0.1999, 1.395, 0.199]]
    np.testing.assert_allclose(distances(make(), inner.points, beneath), [-0.01, -0.02, -0.04, -0.005], atol=3e-4)


def test_deep_beneath_nothing_is_pushed(over_sheet):
    make, inner = over_sheet
    found = distances(make(), inner.points, [[0, 1.4 - DEEPEST - 1e-3, 0], [0, 1.4 - DEEPEST + 1e-3, 0]])
    assert found[0] > 1e3 and found[1] == pytest.approx(-DEEPEST + 1e-3, abs=1e-5)


def test_the_deepest_of_body_and_cloth_counts_alone(over_sheet):
    make, inner = over_sheet
    x = torch.full((60, 3, 2), 9.0)
    x[-1] = torch.tensor([0.0, 1.395, 0.0])[:, None]
    body = torch.zeros(60, 3, 2), torch.full((60, 2), 8.9)
    body[0][:, 0] = 1
    body[1][-1] = torch.tensor([0.002, 0.3])  # 2 mm and 30 cm inside
    normal, offset = make().deeper(body, x, frames(inner.points).expand(-1, -1, 2))
    assert normal[-1, 1, 0] == pytest.approx(1, abs=1e-5) and normal[-1, 0, 1] == 1
    worn = torch.tensor([False, True])
    assert make().deeper(body, x, frames(inner.points).expand(-1, -1, 2), worn)[0][-1, 0, 0] == 1
    assert torch.equal(normal[:-1], body[0][:-1]) and torch.equal(offset[:-1], body[1][:-1])


def test_pinned_samples_touch_no_cloth(over_sheet, scene):
    make, _ = over_sheet
    assert make().rows.tolist() == [*range(5, 60)]


@pytest.mark.parametrize("flipped", [False, True])
def test_cloth_is_turned_away_from_the_body_whatever_its_winding(scene, flipped):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    kept = ball.faces[ball.triangles_center[:, 1] < 0.12]  # open, as a garment is
    mixed = kept.copy()
    mixed[::3] = mixed[::3, ::-1]
    faces = mixed[:, ::-1] if flipped else mixed
    found = turned_away(Mesh("/shirt", ball.vertices + [0, 1.15, 0], faces), scene.character.merged_body().mesh)
    corners = ball.vertices[found]
    out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((out * corners.mean(axis=1)).sum(axis=1) > 0).all()


def test_both_layers_of_a_fold_are_turned_away(scene):
    """A hood that lies on its back shows its lining, which is out there."""
    under, upper = sheet(height=1.4), sheet(height=1.41)
    count, last = 9, 8 * 9
    joint = np.array([[last + k, 81 + last + k, last + k + 1] for k in range(count - 1)])
    upper_faces = upper.faces[:, ::-1] + under.vertex_count  # goes on around the fold, as one piece of cloth
    folded = Mesh("/hood", np.r_[under.points, upper.points], np.r_[under.faces, upper_faces, joint])
    found = turned_away(folded, scene.character.merged_body().mesh)[: 2 * len(under.faces)]
    corners = folded.points[found]
    out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (out[:, 1] > 0).all()


def test_normals_are_out_at_seams_and_where_the_sheet_moves(over_sheet):
    make, inner = over_sheet
    x = np.linspace(-0.2, 0.2, 9)
    split = np.r_[np.arange(81), np.arange(36, 45)]  # a row of vertices twice, as an exporter leaves a seam
    faces = inner.faces.copy()
    far = inner.points[faces].mean(axis=1)[:, 0] > 0
    faces[far] = np.where(np.isin(faces[far], np.arange(36, 45)), faces[far] + 45, faces[far])
    seamed = Mesh("/seamed", inner.points[split], faces)
    cloth = make(seamed)
    bent = seamed.points.copy()
    bent[:, 1] += 0.5 * bent[:, 0] ** 2
    posed = cloth.posed(frames(bent))
    inside = np.isin(np.round(bent[:, 2], 3), np.round(x[1:-1], 3)) & (np.abs(bent[:, 0]) < 0.19)
    slope = bent[:, 0]  # of y = x^2 / 2
    expected = np.c_[-slope, np.ones(len(slope)), 0 * slope] / np.hypot(1, slope)[:, None]
    np.testing.assert_allclose(posed.normals[inside, :, 0], expected[inside], atol=2e-3)
    assert nearest_planes(frames([[0.0, 1.39, 0.0]]), posed)[0][0, 1, 0] == pytest.approx(1, abs=1e-3)


def test_what_cannot_be_reached_is_left_out(scene, toy_motion):
    motions = [toy_motion(scene, 20)]
    assert reachable_cloth(scene, scene, motions).all()
    mesh = scene.garment.mesh
    far = replace(mesh, points=mesh.points + [5.0, 0, 0])
    assert not reachable_cloth(scene, replace(scene, garment=replace(scene.garment, mesh=far)), motions).any()
