# SPDX-License-Identifier: Apache-2.0
"""Smoothed steps of blendshapes: waves against their closed form, and steps against those of U with B = S U."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
from torch import nn

from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.mesh.laplacian import laplacian
from ssilk_core.scene.mesh.topology import edges
from ssilk_core.training import shape_smoothing
from ssilk_core.training.banded_inverse import BandedInverse
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import TrainingParts, build_parts
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.shape_smoothing import ShapeSmoothing
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

SPACING, LENGTH = 0.02, 0.05  # [m]
RELATIVE = 0.1  # length, of a diagonal
CPU = torch.device("cpu")
IDENTITY = torch.eye(26, dtype=torch.float64)


def sheet(rows: int, columns: int, shape: str = "equilateral") -> Mesh:
    """A sheet of equilateral triangles, or of rectangles of 1 by 2, each cut along a diagonal."""
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = (u + 0.5 * v, np.sqrt(0.75) * v) if shape == "equilateral" else (u, 2 * v)
    points = SPACING * np.stack([x, y, 0 * u], axis=-1).reshape(-1, 3)
    at = (v * columns + u)[:-1, :-1].reshape(-1)
    faces = np.concatenate([
        np.stack([at, at + 1, at + columns], axis=1), np.stack([at + 1, at + columns + 1, at + columns], axis=1)
    ])  # fmt: skip
    return Mesh("/sheet", points, faces)


def smoothing(mesh: Mesh, shapes: nn.Parameter, length: float = LENGTH) -> ShapeSmoothing:
    return ShapeSmoothing(shapes, mesh, torch.arange(mesh.vertex_count)[: len(shapes)], length)


@pytest.mark.parametrize(
    ("shape", "axis", "wavelength"),
    [("equilateral", 0, 0.16), ("equilateral", 0, 0.32), ("equilateral", 1, 0.32), ("rectangles", 0, 0.32)]
    + [("rectangles", 1, 0.64)],
)
def test_a_wave_is_damped_as_its_length_says(shape, axis, wavelength):
    """S cos(k x) = cos(k x) / (1 + (k l)^2) in the middle of a sheet, far from its borders, whatever its mesh."""
    mesh = sheet(41, 41, shape)
    shapes = nn.Parameter(torch.zeros(mesh.vertex_count, 3, 1, dtype=torch.float64))
    away = mesh.points - mesh.points.mean(axis=0)
    middle = np.argmin(np.hypot(away[:, 0], away[:, 1]))
    wave = np.cos(2 * np.pi * (mesh.points - mesh.points[middle])[:, axis] / wavelength)
    found = smoothing(mesh, shapes).smooth(torch.tensor(wave)[:, None])[:, 0].numpy()
    assert found[middle] == pytest.approx(1 / (1 + (2 * np.pi * LENGTH / wavelength) ** 2), rel=0.08)


def test_a_flat_displacement_is_kept_and_one_of_the_free_fades_towards_the_others():
    mesh = sheet(9, 9)
    everywhere = nn.Parameter(torch.zeros(81, 3, 1, dtype=torch.float64))
    ones = torch.ones(81, 1, dtype=torch.float64)
    torch.testing.assert_close(smoothing(mesh, everywhere).smooth(ones), ones)
    some = nn.Parameter(torch.zeros(63, 3, 1, dtype=torch.float64))  # two rows are pinned
    faded = smoothing(mesh, some).smooth(ones[:63]).reshape(7, 9)
    assert (faded[-1] < faded[0]).all() and (faded > 0).all() and (faded < 1).all()


def test_a_vertex_without_faces_moves_by_itself():
    mesh = sheet(5, 5)
    alone = replace(mesh, points=np.concatenate([mesh.points, [[0, 0, 1.0]]]))
    matrix = smoothing(alone, nn.Parameter(torch.zeros(26, 3, 1, dtype=torch.float64))).smooth(IDENTITY)
    assert matrix[25, 25] == pytest.approx(1) and matrix[25, :25].abs().max() == 0


def test_steps_are_those_of_a_variable_that_is_smoothed():
    """Adam on U with the loss f(S U), against Adam on B with its steps turned, over several steps in float64."""
    mesh, rng = sheet(6, 7), np.random.default_rng(0)
    wish = torch.tensor(rng.normal(size=(42, 3, 2)))
    shapes, hidden = (nn.Parameter(torch.zeros(42, 3, 2, dtype=torch.float64)) for _ in range(2))
    turned = smoothing(mesh, shapes)
    adam, reference = (torch.optim.Adam([value], 0.01) for value in (shapes, hidden))
    for _ in range(20):
        for optimiser, made in ((adam, lambda: shapes), (reference, lambda: turned.smooth(hidden))):
            optimiser.zero_grad()
            ((made() - wish) ** 4).sum().backward()
            if optimiser is adam:
                turned.before_step()
            optimiser.step()
        turned.after_step()
    torch.testing.assert_close(shapes.detach(), turned.smooth(hidden).detach(), rtol=1e-9, atol=1e-12)
    assert shapes.abs().max() > 0.01


def one_step(scene, toy_motion, toy_model, toy_objective, relative: float) -> tuple[Stepper, dict[str, torch.Tensor]]:
    """A training that has done a step, and the parameters before."""
    config = TrainConfig(
        iterations=4, static_fraction=0.5, pretraining_batch=4, batch=2, window=5, static_batch=2,
        shape_smoothing=relative,
    )  # fmt: skip
    objective = toy_objective(scene, toy_model(scene), toy_motion(scene, 30))
    sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
    own = ShapeSmoothing.of(objective.model, config.shape_smoothing)
    assert (own is None) == (relative == 0)
    stepper = Stepper(objective.model, objective, sampler, config, smoothing=own)
    before = {name: value.detach().clone() for name, value in objective.model.named_parameters()}
    stepper.run(0)
    return stepper, before


def test_a_step_of_training_smooths_blendshapes_alone(scene, toy_motion, toy_model, toy_objective):
    moved = []
    for relative in (0.0, RELATIVE):
        stepper, before = one_step(scene, toy_motion, toy_model, toy_objective, relative)
        moved.append({name: value.detach() - before[name] for name, value in stepper.model.named_parameters()})
    rough, smooth = moved
    for name, change in rough.items():
        if name != "decoder.shapes":
            assert torch.equal(change, smooth[name])
    assert rough["decoder.skin_offset"].abs().max() > 0
    assert 0 < smooth["decoder.shapes"].norm() < 0.9 * rough["decoder.shapes"].norm()


def test_a_step_that_is_skipped_moves_nothing(scene, toy_motion, toy_model, toy_objective):
    stepper, _ = one_step(scene, toy_motion, toy_model, toy_objective, RELATIVE)
    before = stepper.model.decoder.shapes.detach().clone()
    loss = stepper.model.decoder.shapes.sum() * torch.nan
    stepper._descend(loss, {"stretch": loss}, stepper.sampler.window())
    assert torch.equal(stepper.model.decoder.shapes.detach(), before) and before.isfinite().all()
    assert int(stepper.skipped.count) == 1


def test_the_length_grows_with_the_garment(scene, toy_model):
    """Nothing depends on units: a garment of twice the size gets the same matrix."""
    mesh = scene.garment.mesh
    twice = replace(scene, garment=replace(scene.garment, mesh=replace(mesh, points=2 * mesh.points)))
    one, other = (ShapeSmoothing.of(toy_model(each), RELATIVE) for each in (scene, twice))
    values = torch.randn(one.shapes.shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(one.smooth(values), other.smooth(values))
    assert (one.smooth(values) - values).abs().max() > 0.01


def test_training_starts_from_smooth_blendshapes_and_smooths_their_steps(scene, toy_motion, tmp_path):
    def parts(relative: float) -> TrainingParts:
        job = TrainJob(
            scene=scene, motions=[toy_motion(scene, 30)], held_out=[toy_motion(scene, 30, speed=1.3)],
            model=ModelConfig(latent=6, widths=(16,), shapes=3), fabric=Fabric("toy"),
            output=tmp_path / "a.safetensors",
            train=TrainConfig(batch=2, static_batch=2, pretraining_batch=2, shape_smoothing=relative),
        )  # fmt: skip
        return build_parts(job, torch.device("cpu"))

    smooth, rough = parts(RELATIVE), parts(0.0)
    assert rough.smoothing is None
    assert smooth.stepper(TrainConfig(batch=2), 0).smoothing is smooth.smoothing is not None
    mesh, free = scene.garment.mesh, smooth.model.decoder.free.numpy()
    stiffness = laplacian(edges(mesh.faces), 1.0, mesh.vertex_count)
    own = torch.as_tensor(stiffness[free][:, free].toarray(), dtype=torch.float32)
    shapes = [each.model.decoder.shapes.detach().flatten(1) for each in (smooth, rough)]
    assert shapes[0].norm() == pytest.approx(float(shapes[1].norm()), rel=1e-5)
    bent = [float((each * (own @ each)).sum()) for each in shapes]
    assert 0 < bent[0] < 0.7 * bent[1]


def test_more_vertices_than_fit_are_not_smoothed(scene, toy_model, monkeypatch):
    model = toy_model(scene)
    monkeypatch.setattr(shape_smoothing, "MOST_SMOOTHED_VERTICES", len(model.decoder.free) - 1)
    assert ShapeSmoothing.of(model, RELATIVE) is None


def test_a_banded_inverse_is_the_inverse():
    """Of a sheet with a piece of its own, in float64 and within float32's rounding; scattered order, many blocks."""
    mesh, rng = sheet(20, 9), np.random.default_rng(1)
    pairs = rng.permutation(182)[edges(mesh.faces)]
    matrix = (laplacian(pairs, rng.uniform(0.1, 2, len(pairs)), 182) + sparse.diags(rng.uniform(0.1, 1, 182))).tocsr()
    right = torch.tensor(rng.normal(size=(182, 5)))
    expected = torch.linalg.solve(torch.tensor(matrix.toarray()), right)
    torch.testing.assert_close(BandedInverse(matrix, CPU, torch.float64)(right), expected, rtol=1e-12, atol=1e-12)
    found = BandedInverse(matrix, CPU, torch.float32)(right.float())
    assert (found - expected).abs().max() < 2e-6 * expected.abs().max()
