# SPDX-License-Identifier: Apache-2.0
"""The few elements that a solver in latents sums the energy over, and their weights.

Pairs of adjacent faces are spread over the garment, so that no state can hide from them. In states s of the network's
own rollouts, an element e pulls on the m latents with J' f_e. Faces that give most of the missing forces are added
after one another, as An, Kim and James do (2008, "Optimizing cubature for efficient integration of subspace
deformations"). All faces and hinges between these vertices get weights w that give the forces of the whole garment,
near those w_0 with which each stands for what lies around it:

    minimise sum_s |sum_e w_e A J' f_e - A J' f|^2 / |A J' f|^2 + S NEARNESS mean((w / w_0 - 1)^2),   A'A = H^-1

H is the reduced Hessian of one state, so that an error counts by the energy that it costs. No weight falls below
`LEAST` of its w_0. The equations of all states are mixed at random into `EQUATIONS` ones, which keeps norms. The same
motions always give the same weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.cubature import Cubature, cubature_between, spread_evenly, spread_pairs
from ...scene.assets import Floats, Ints, Scene
from .solver import LatentSolver

PAIRS = 80  # of faces that are spread
ADDED, TOGETHER = 140, 10  # faces that are added, in all and at once
CANDIDATES = 6000  # faces that may be, evenly spread where there are more
NEARNESS = 0.01
LEAST = 0.1
EQUATIONS = 2048
RIDGE = 1e-9  # of the mean diagonal


@torch.no_grad()
def choose_elements(
    scene: Scene, simulator: Simulator, solver: LatentSolver, z: Tensor, poses: PosedCharacters
) -> Cubature:
    """Return a cubature of the garment of `scene`.

    Args:
        simulator, solver: over all of the garment.
        z: latents of S states, shape (S, m).
        poses: the character in these.
    """
    mesh, potential = scene.garment.mesh, simulator.potential
    spread = cubature_between(scene, potential, spread_pairs(scene, PAIRS))
    faces = np.union1d(spread.faces, spread_evenly(len(mesh.faces), CANDIDATES))
    ((stretch, target),) = _mixed_forces(simulator, solver, z, poses, [faces])
    added = faces[_missing(stretch, target, np.searchsorted(faces, spread.faces), spread.face_weights)]
    found = cubature_between(scene, potential, np.append(spread.vertices, mesh.faces[added]))
    forces = _mixed_forces(simulator, solver, z, poses, [found.faces, found.hinges])
    weights = [found.face_weights, found.hinge_weights]
    for number, mixed in enumerate(forces):
        weights[number] = _fitted(*mixed, len(z) ** 0.5, weights[number])
    return replace(found, face_weights=weights[0], hinge_weights=weights[1])


def _missing(columns: Tensor, target: Tensor, chosen: Ints, usual: Floats) -> Ints:
    """Return which columns (EQUATIONS, E) to add to those chosen, whose sum is to be the target (EQUATIONS,).

    Args:
        chosen: columns that have weights, near their `usual` ones; shapes (C,).
    """
    lengths = columns.norm(dim=0).clamp_min(torch.finfo(columns.dtype).tiny)
    added = chosen[:0]
    for _ in range(ADDED // TOGETHER):
        rows = torch.as_tensor(np.append(chosen, added), device=columns.device)
        weights = torch.as_tensor(_fitted(columns[:, rows], target, 1.0, np.append(usual, np.ones(len(added)))))
        missing = target - columns[:, rows] @ weights.to(columns)
        score = columns.T @ missing / lengths
        score[rows] = -torch.inf
        best = score.topk(min(TOGETHER, len(score) - len(rows)))
        added = np.append(added, best.indices[best.values > 0].cpu().numpy())
    return added


def _mixed_forces(
    simulator: Simulator, solver: LatentSolver, z: Tensor, poses: PosedCharacters, rows: Sequence[Ints]
) -> list[tuple[Tensor, Tensor]]:
    """Return, for stretch and bending, mixed forces of elements `rows` (EQUATIONS, E), and of all (EQUATIONS,)."""
    generator, first = torch.Generator().manual_seed(0), torch.zeros(1, dtype=torch.long, device=z.device)
    posed = poses.select(first)
    hessian = solver.equations(z[:1], posed.matrices, simulator.inputs(posed, None)).hessian[0]
    hessian.diagonal().add_(RIDGE * hessian.diagonal().mean())
    factor = torch.linalg.cholesky(hessian)
    totals: list[tuple[Tensor, Tensor]] = []
    for state in range(len(z)):
        mixing = torch.randn(EQUATIONS, z.shape[1], generator=generator).to(factor) / EQUATIONS**0.5
        mixing = torch.linalg.solve_triangular(factor, mixing, upper=False, left=False).to(z.dtype)
        mixed = []
        for part, whole in _forces(simulator, solver, z[state : state + 1], poses.select(first + state), rows):
            target = mixing @ whole
            scale = target.norm().clamp_min(torch.finfo(z.dtype).tiny)
            mixed.append((mixing @ part.T / scale, target / scale))
        totals = [(a + c, b + d) for (a, b), (c, d) in zip(totals, mixed)] if totals else mixed
    return totals


def _forces(
    simulator: Simulator, solver: LatentSolver, z: Tensor, posed: PosedCharacters, rows: Sequence[Ints]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield, for stretch and bending, the forces J' f of the elements `rows` (E, m), and of all elements (m,)."""
    potential, decoded = simulator.potential, solver.decoder.linearise(z, posed.matrices)
    x = posed.lbs.index_copy(0, potential.free, decoded.x)
    jacobian = x.new_zeros(len(x), 3, z.shape[1])
    jacobian[potential.free] = decoded.jacobian[0].unflatten(0, (-1, 3))
    for part, kept in zip((potential.membrane, potential.hinges), rows):
        if part is None or not len(kept):
            continue
        force = part.corner_forces(x)[..., 0][torch.as_tensor(kept, device=x.device)]
        corners = torch.as_tensor(part.corners[kept], device=x.device)
        pulls = torch.einsum("eca,ecam->em", force, jacobian[corners])
        yield pulls, part.gradient(x)[..., 0].flatten() @ jacobian.flatten(0, 1)


def _fitted(columns: Tensor, target: Tensor, share: float, usual: Floats) -> Floats:
    """Return weights (E,) near the `usual` ones (E,), with which columns (EQUATIONS, E) sum to a target.

    Args:
        share: by how much the mixed equations are longer than those of one state.
    """
    scaled = columns.double() * torch.as_tensor(usual, device=columns.device)
    gram = scaled.T @ scaled
    gram.diagonal().add_(NEARNESS * share**2 / len(usual))
    right = scaled.T @ target.double() + NEARNESS * share**2 / len(usual)
    held = torch.zeros(len(usual), dtype=torch.bool, device=columns.device)
    while True:
        ratio = torch.full_like(right, LEAST)
        free = ~held
        known = right[free] - LEAST * gram[free][:, held].sum(1)
        ratio[free] = torch.linalg.solve(gram[free][:, free], known)
        low = ratio < LEAST - 1e-12
        if not bool(low.any()):
            return usual * ratio.cpu().numpy()
        held |= low
