# SPDX-License-Identifier: Apache-2.0
"""Steps along orthogonalised momentum, against singular value decompositions in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ssilk_core.errors import SsilkError
from ssilk_core.training.muon import MOMENTUM, STEP_SIZE, Muon, orthogonalised
from ssilk_core.training.settings import TrainConfig


def matrix_of(singular: list[float], rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return U diag(singular) V', U and V with random orthonormal columns, float64."""
    generator = torch.Generator().manual_seed(3)
    u, v = (
        torch.linalg.qr(torch.randn(size, len(singular), generator=generator, dtype=torch.float64))[0]
        for size in (rows, columns)
    )
    return (u * torch.tensor(singular, dtype=torch.float64)) @ v.T, u, v


@pytest.mark.parametrize(("rows", "columns"), [(40, 12), (12, 40), (12, 12)])
def test_singular_vectors_stay_and_singular_values_become_about_one(rows, columns):
    spread = np.geomspace(3e-5, 1e-3, 12).tolist()
    matrix, u, v = matrix_of(spread, rows, columns)
    found = u.T @ orthogonalised(matrix[None])[0] @ v
    np.testing.assert_allclose(found - torch.diag(found.diagonal()), 0, atol=1e-6)
    assert float(found.diagonal().min()) > 0.5 and float(found.diagonal().max()) < 1.5


def test_nothing_is_made_of_nothing():
    assert orthogonalised(torch.zeros(2, 4, 3)).abs().max() == 0


def stepped(optimiser: Muon, matrix: nn.Parameter, gradient: Tensor, skip: float = 0.0) -> None:
    matrix.grad, optimiser.found_inf = gradient, torch.tensor(skip)
    optimiser.step()


def test_steps_are_as_long_as_adam_s_and_follow_the_momentum():
    matrix = nn.Parameter(torch.zeros(6, 24, dtype=torch.float64))
    optimiser = Muon([{"params": [matrix], "lr": 0.01}])
    first, second = (torch.randn(6, 24, generator=torch.Generator().manual_seed(n)).double() for n in (1, 2))
    stepped(optimiser, matrix, first)
    moved = -matrix.detach().clone()
    np.testing.assert_allclose(moved, 0.01 * STEP_SIZE * math.sqrt(24) * orthogonalised(first[None])[0], atol=1e-9)
    assert float(moved.square().mean().sqrt()) == pytest.approx(0.01 * STEP_SIZE, rel=0.3)
    stepped(optimiser, matrix, second)
    momentum = MOMENTUM * (1 - MOMENTUM) * first + (1 - MOMENTUM) * second
    ahead = MOMENTUM * momentum + (1 - MOMENTUM) * second
    change = 0.01 * STEP_SIZE * math.sqrt(24) * orthogonalised(ahead[None])[0]
    np.testing.assert_allclose(-matrix.detach() - moved, change, atol=1e-9)


def test_weights_decay_by_the_learning_rate_before_each_step():
    decaying, plain = (nn.Parameter(torch.full((4, 6), 2.0)) for _ in range(2))
    gradient = torch.randn(4, 6, generator=torch.Generator().manual_seed(3))
    stepped(Muon([{"params": [decaying], "lr": 0.1, "weight_decay": 0.5}]), decaying, gradient.clone())
    stepped(Muon([{"params": [plain], "lr": 0.1}]), plain, gradient)
    np.testing.assert_allclose(decaying.detach(), plain.detach() - 0.1 * 0.5 * 2.0, atol=1e-6)


def test_a_skipped_step_changes_nothing_whatever_its_gradient():
    matrix = nn.Parameter(torch.ones(3, 5))
    optimiser = Muon([{"params": [matrix], "lr": 0.1, "weight_decay": 0.5}])
    stepped(optimiser, matrix, torch.ones(3, 5))
    before, momentum = matrix.detach().clone(), optimiser.state[matrix]["momentum"].clone()
    stepped(optimiser, matrix, torch.full((3, 5), math.nan), skip=1.0)
    assert torch.equal(matrix, before) and torch.equal(optimiser.state[matrix]["momentum"], momentum)


def test_matrices_of_one_shape_are_stepped_each_by_itself():
    gradients = [
        torch.randn(*shape, generator=torch.Generator().manual_seed(7)) for shape in ((5, 3), (3, 5), (5, 3))
    ]
    gradients[2] *= 100
    together = [nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for matrix, gradient in zip(together, gradients):
        matrix.grad = gradient.clone()
    Muon([{"params": together, "lr": 0.1}]).step()
    for matrix, gradient in zip(together, gradients):
        alone = nn.Parameter(torch.zeros_like(gradient))
        stepped(Muon([{"params": [alone], "lr": 0.1}]), alone, gradient)
        np.testing.assert_allclose(matrix.detach(), alone.detach(), atol=1e-6)


def test_soft_directions_converge_as_fast_as_stiff_ones():
    """On 1/2 (X - Y)' H (X - Y) with curvatures H from 1 to 1,000,000, of which a garment's energy has as many."""
    root, u, _ = matrix_of(np.geomspace(1, 1000, 12).tolist(), 12, 12)
    stiffness = root @ root.T
    target = torch.randn(12, 12, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    left = {}
    for name, build in (
        ("muon", lambda value: Muon([{"params": [value], "lr": 0.0}])),
        ("adam", lambda value: torch.optim.Adam([value], 0.0)),
    ):
        matrix = nn.Parameter(torch.zeros(12, 12, dtype=torch.float64))
        optimiser = build(matrix)
        for step in range(300):
            matrix.grad = stiffness @ (matrix.detach() - target)
            optimiser.param_groups[0]["lr"] = 0.1 * (1 - step / 300)
            optimiser.step()
        left[name] = float((u.T @ (matrix.detach() - target))[0].norm())  # along the softest direction
    assert left["muon"] < 0.5 * left["adam"]


def test_another_optimiser_is_refused():
    with pytest.raises(SsilkError, match="optimiser 'sgd'; it is one of adam, muon"):
        TrainConfig(optimiser="sgd")


def test_a_decay_that_would_turn_weights_over_is_refused():
    assert TrainConfig(weight_decay=499, static_learning_rate=2e-3).weight_decay == 499
    with pytest.raises(
        SsilkError, match=r"weight_decay 500 at a learning rate of 0\.002; their product must be less"
    ):
        TrainConfig(weight_decay=500, static_learning_rate=2e-3)
