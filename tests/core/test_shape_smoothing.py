# SPDX-License-Identifier: Apache-2.0
"""Smoothed steps of blendshapes: waves against their closed form, and steps against those of U with B = S U."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ssilk_core.assets import Mesh
from ssilk_core.config import MOST_SMOOTHED_VERTICES, TrainConfig
from ssilk_core.training import shape_smoothing
from ssilk_core.training.shape_smoothing import ShapeSmoothing
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

SPACING, LENGTH = 0.02, 0.05  # [m]


def sheet(rows: int, columns: int) -> Mesh:
    """A sheet of equilateral triangles."""
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    points = SPACING * np.stack([u + 0.5 * v, np.sqrt(0.75) * v, 0 * u], axis=-1).reshape(-1, 3)
    at = (v * columns + u)[:-1, :-1].reshape(-1)
    faces = np.concatenate([
        np.stack([at, at + 1, at + columns], axis=1), np.stack([at + 1, at + columns + 1, at + columns], axis=1)
    ])  # fmt: skip
    return Mesh("/sheet", points, faces)


def smoothing(mesh: Mesh, shapes: nn.Parameter, length: float = LENGTH) -> ShapeSmoothing:
    return ShapeSmoothing(shapes, mesh, torch.arange(mesh.vertex_count)[: len(shapes)], length)


@pytest.mark.parametrize("wavelength", [0.16, 0.32, 0.64])
def test_a_wave_is_damped_as_its_length_says(wavelength):
    """S sin(k x) = sin(k x) / (1 + (k l)^2) in the middle of a sheet, far from its borders."""
    mesh = sheet(41, 61)
    shapes = nn.Parameter(torch.zeros(mesh.vertex_count, 3, 1, dtype=torch.float64))
    x, y = mesh.points[:, 0] - mesh.points[:, 0].mean(), mesh.points[:, 1] - mesh.points[:, 1].mean()
    wave = np.cos(2 * np.pi * x / wavelength)
    found = smoothing(mesh, shapes).matrix.numpy() @ wave
    middle = np.argmin(np.hypot(x, y))
    assert found[middle] == pytest.approx(wave[middle] / (1 + (2 * np.pi * LENGTH / wavelength) ** 2), rel=0.1)


def test_a_flat_displacement_is_kept_and_one_of_the_free_fades_towards_the_others():
    mesh = sheet(9, 9)
    everywhere = nn.Parameter(torch.zeros(81, 3, 1, dtype=torch.float64))
    ones = torch.ones(81, dtype=torch.float64)
    torch.testing.assert_close(smoothing(mesh, everywhere).matrix @ ones, ones)
    some = nn.Parameter(torch.zeros(63, 3, 1, dtype=torch.float64))  # two rows are pinned
    faded = (smoothing(mesh, some).matrix @ ones[:63]).reshape(7, 9)
    assert (faded[-1] < faded[0]).all() and (faded > 0).all() and (faded < 1).all()


def test_a_vertex_without_faces_moves_by_itself():
    mesh = sheet(5, 5)
    alone = replace(mesh, points=np.concatenate([mesh.points, [[0, 0, 1.0]]]))
    matrix = smoothing(alone, nn.Parameter(torch.zeros(26, 3, 1, dtype=torch.float64))).matrix
    assert matrix[25, 25] == pytest.approx(1) and matrix[25, :25].abs().max() == 0


def test_steps_are_those_of_a_variable_that_is_smoothed():
    """Adam on U with the loss f(S U), against Adam on B with its steps turned, over several steps in float64."""
    mesh, rng = sheet(6, 7), np.random.default_rng(0)
    wish = torch.tensor(rng.normal(size=(42, 3, 2)))
    shapes, hidden = (nn.Parameter(torch.zeros(42, 3, 2, dtype=torch.float64)) for _ in range(2))
    turned = smoothing(mesh, shapes)
    adam, reference = (torch.optim.Adam([value], 0.01) for value in (shapes, hidden))
    for _ in range(20):
        for optimiser, made in ((adam, lambda: shapes), (reference, lambda: smoothed(turned.matrix, hidden))):
            optimiser.zero_grad()
            ((made() - wish) ** 4).sum().backward()
            if optimiser is adam:
                turned.before_step()
            optimiser.step()
        turned.after_step()
    torch.testing.assert_close(shapes.detach(), smoothed(turned.matrix, hidden).detach(), rtol=1e-9, atol=1e-12)
    assert shapes.abs().max() > 0.01


def smoothed(matrix: torch.Tensor, hidden: torch.Tensor) -> torch.Tensor:
    return (matrix @ hidden.flatten(1)).view_as(hidden)


def test_training_smooths_where_a_length_is_given(scene, toy_motion, toy_model, toy_objective):
    """Two steps of training: shapes differ, and all else moves as without."""
    found = []
    for length in (0.0, LENGTH):
        config = TrainConfig(
            iterations=4, static_fraction=0.5, pretraining_batch=4, batch=2, window=5, static_batch=2
        )
        config = replace(config, shape_smoothing=length)
        objective = toy_objective(scene, toy_model(scene), toy_motion(scene, 30))
        sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
        own = ShapeSmoothing.of(objective.model, config.shape_smoothing)
        assert (own is None) == (length == 0)
        before = objective.model.decoder.shapes.detach().clone()
        Stepper(objective.model, objective, sampler, config, smoothing=own).run(0)
        found.append((objective.model.decoder.shapes.detach() - before, objective.model.decoder.skin_offset.detach()))
    (rough, offset), (smooth, same) = found
    assert torch.equal(offset, same)
    assert 0 < smooth.norm() < 0.9 * rough.norm()


def test_more_vertices_than_fit_are_not_smoothed(scene, toy_model, monkeypatch):
    assert MOST_SMOOTHED_VERTICES == 10_000
    model = toy_model(scene)
    monkeypatch.setattr(shape_smoothing, "MOST_SMOOTHED_VERTICES", len(model.decoder.free) - 1)
    assert ShapeSmoothing.of(model, LENGTH) is None
