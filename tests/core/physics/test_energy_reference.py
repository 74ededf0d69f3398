# SPDX-License-Identifier: Apache-2.0
"""Every energy against a slow reference in float64 numpy, element by element, with gradients written out by hand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from ssilk_core.physics.collision import PosedBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.samples import MAX_DIVISIONS, MAX_SPACING
from ssilk_core.scene.assets import LOOSE, TIGHT, Mesh
from ssilk_core.scene.fabrics import Fabric

DT, FRAMES = 1 / 30, 3
STVK = Fabric("stvk", bending=2e-3, collision=30.0, margin=0.02)
WOVEN = Fabric("woven", stretch_model="baraff_witkin", density=0.3, drag=0.7)
TERMS = ("stvk", "woven", "bending", "gravity", "inertia", "drag", "collision", "tether")
Twin = Callable[["Case", np.ndarray, int], tuple[float, np.ndarray]]


@dataclass(frozen=True)
class Case:
    """A crumpled sheet, half tight and half loose, in motion near a body: positions (V, 3, N) and (B, 3, N)."""

    mesh: Mesh
    classes: np.ndarray
    x: np.ndarray
    last: np.ndarray
    predicted: np.ndarray
    down: np.ndarray
    points: np.ndarray
    normals: np.ndarray

    def energy_of(self, term: str, x: torch.Tensor) -> torch.Tensor:
        """The fast path of a term, in the precision of `x`."""
        fabric = WOVEN if term in ("woven", "drag") else STVK
        energy = GarmentEnergy(self.mesh, fabric, self.classes, dtype=x.dtype)
        last, predicted, down, points, normals = (
            torch.tensor(v, dtype=x.dtype) for v in (self.last, self.predicted, self.down, self.points, self.normals)
        )
        calls = {
            "stvk": lambda: energy.stretch(x),
            "woven": lambda: energy.stretch(x),
            "bending": lambda: energy.bending(x),
            "gravity": lambda: energy.gravity(x, down),
            "inertia": lambda: energy.inertia(x, predicted, DT),
            "drag": lambda: energy.drag(x, last, DT),
            "collision": lambda: energy.collision(x, PosedBody(points, normals)),
            "tether": lambda: energy.tether(x, predicted[energy.tethered]),
        }
        return calls[term]()


def build(points: np.ndarray, faces: np.ndarray, seed: int) -> Case:
    rng = np.random.default_rng(seed)
    rest = points + 0.005 * rng.normal(size=points.shape)
    noise = 0.01 * rng.normal(size=(3, *points.shape, FRAMES))
    x = 1.05 * rest[:, :, None] + noise[0]
    last = x + noise[1]
    normals = rng.normal(size=(60, 3, FRAMES))
    return Case(
        Mesh("/crumpled", rest, faces),
        np.where(points[:, 0] > 0, LOOSE, TIGHT),
        x,
        last,
        last + noise[2],
        9.81 * rng.normal(size=(3, FRAMES)),
        rng.uniform([-0.1, -0.55, -0.05], [0.1, 0, 0.05], size=(FRAMES, 60, 3)).transpose(1, 2, 0),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
    )


@pytest.fixture(scope="module")
def case(toy_grid) -> Case:
    return build(*toy_grid(12, 7), seed=5)


def area_of(mesh: Mesh, face: np.ndarray) -> float:
    a, b, c = mesh.points[face]
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a)))


def masses(mesh: Mesh, density: float) -> np.ndarray:
    mass = np.zeros(len(mesh.points))
    for face in mesh.faces:
        for corner in face:
            mass[corner] += density * area_of(mesh, face) / 3
    return mass


def threads(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Weft and warp of a rest triangle as rows: warp is the part of the upright that lies in it."""
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    warp = np.array([0, 1, 0]) - normal * normal[1]
    warp /= np.linalg.norm(warp)
    return np.stack([np.cross(warp, normal), warp])


def membrane(
    case: Case, x: np.ndarray, stress: Callable[[np.ndarray], tuple[float, np.ndarray]]
) -> tuple[float, np.ndarray]:
    """Sum area times density over triangles; `stress` gives a density and its derivative in F (3, 2)."""
    total, gradient = 0.0, np.zeros_like(x)
    for face in case.mesh.faces:
        a, b, c = case.mesh.points[face]
        inverse = np.linalg.inv(threads(a, b, c) @ np.stack([b - a, c - a], axis=1))
        f = np.stack([x[face[1]] - x[face[0]], x[face[2]] - x[face[0]]], axis=1) @ inverse
        density, piola = stress(f)
        total += area_of(case.mesh, face) * density
        at_edges = area_of(case.mesh, face) * piola @ inverse.T
        gradient[face[1]] += at_edges[:, 0]
        gradient[face[2]] += at_edges[:, 1]
        gradient[face[0]] -= at_edges.sum(1)
    return total, gradient


def stvk(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    def stress(f: np.ndarray) -> tuple[float, np.ndarray]:
        green = (f.T @ f - np.eye(2)) / 2
        second = 2 * STVK.lame_mu * green + STVK.lame_lambda * np.trace(green) * np.eye(2)
        return STVK.lame_mu * np.sum(green**2) + STVK.lame_lambda / 2 * np.trace(green) ** 2, f @ second

    return membrane(case, x, stress)


def woven(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    def stress(f: np.ndarray) -> tuple[float, np.ndarray]:
        lengths, skew = np.linalg.norm(f, axis=0), f[:, 0] @ f[:, 1]
        pull = 2 * WOVEN.stretch * (lengths - 1) * f / lengths
        return WOVEN.stretch * np.sum((lengths - 1) ** 2) + WOVEN.shear * skew**2, pull + 2 * WOVEN.shear * skew * f[
            :, ::-1
        ]

    return membrane(case, x, stress)


def hinges_of(faces: np.ndarray) -> list[tuple[int, int, int, int]]:
    across = {(face[i], face[(i + 1) % 3]): face[(i + 2) % 3] for face in faces for i in range(3)}
    return [(i, j, across[i, j], across[j, i]) for i, j in across if i < j and (j, i) in across]


def normals_of(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.cross(p[1] - p[0], p[2] - p[0]), np.cross(p[3] - p[0], p[1] - p[0])


def signed_angle(p: np.ndarray) -> float:
    left, right = (n / np.linalg.norm(n) for n in normals_of(p))
    return float(np.arccos(np.clip(left @ right, -1, 1)) * (1 if left @ (p[3] - p[0]) < 0 else -1))


def angle_gradient(p: np.ndarray) -> np.ndarray:
    """Derivative of the angle in (x0, x1, left, right): tips turn about the edge, ends take up the reaction."""
    edge, gradient = p[1] - p[0], np.zeros((4, 3))
    for tip, normal in zip((2, 3), normals_of(p)):
        own = -np.linalg.norm(edge) * normal / (normal @ normal)
        along = (p[tip] - p[0]) @ edge / (edge @ edge)
        gradient[tip] += own
        gradient[0] -= (1 - along) * own
        gradient[1] -= along * own
    return gradient


def bending(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    total, gradient = 0.0, np.zeros_like(x)
    for corners in hinges_of(case.mesh.faces):
        rest, now = case.mesh.points[list(corners)], x[list(corners)]
        areas = sum(np.linalg.norm(n) / 2 for n in normals_of(rest))
        stiffness = STVK.bending * np.sum((rest[1] - rest[0]) ** 2) / (8 * areas)
        change = signed_angle(now) - signed_angle(rest)
        total += stiffness * change**2
        gradient[list(corners)] += 2 * stiffness * change * angle_gradient(now)
    return total, gradient


def gravity(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    force = masses(case.mesh, STVK.density)[:, None] * case.down[:, frame]
    return -float(np.sum(force * x)), -force


def inertia(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    weight = masses(case.mesh, STVK.density)[:, None] / DT**2
    offset = x - case.predicted[..., frame]
    return float(np.sum(weight * offset**2) / 2), weight * offset


def drag(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    weight = WOVEN.drag * masses(case.mesh, 1.0)[:, None] / DT
    offset = x - case.last[..., frame]
    return float(np.sum(weight * offset**2) / 2), weight * offset


def contact_of_a_point(case: Case, point: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    """Energy and gradient for each area, by the pressure integrated over the depth."""
    nearest = np.argmin(np.linalg.norm(case.points[..., frame] - point, axis=1))
    away, m = point - case.points[nearest, :, frame], STVK.margin
    length = np.linalg.norm(away)
    normal = case.normals[nearest, :, frame] if length < 0.08 else away / length  # further away, nothing is touched
    depth = max(m + STVK.thickness / 2 - normal @ (point - case.points[nearest, :, frame]), 0)
    soft, deep = min(depth, m), max(depth - m, 0)
    energy = STVK.contact * (soft**3 / (6 * m) + m * deep / 2 + deep**2 / 2)
    return energy, -STVK.contact * (soft**2 / (2 * m) + deep) * normal


def collision(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    """A part of each triangle's area is at its corners, the rest in the middles of equal parts."""
    total, gradient = 0.0, np.zeros_like(x)
    for face in case.mesh.faces:
        a, b, c = case.mesh.points[face]
        area = np.linalg.norm(np.cross(b - a, c - a)) / 2
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        n = min(max(int(np.ceil(longest / np.sqrt(3) / MAX_SPACING)), 1), MAX_DIVISIONS)
        inner = area * 3 * n**2 / (1 + 3 * n**2)
        parts = [(weights, (area - inner) / 3) for weights in np.eye(3)]
        for i in range(n):
            for j in range(n - i):
                thirds = [(1, 1)] if i + j == n - 1 else [(1, 1), (2, 2)]
                parts += [
                    (np.array([n - i - j - (s + t) / 3, i + s / 3, j + t / 3]) / n, inner / n**2) for s, t in thirds
                ]
        for weights, share in parts:
            energy, slope = contact_of_a_point(case, weights @ x[face], frame)
            if weights @ (case.classes[face] == LOOSE) >= 0.5:
                share *= STVK.loose_contact / STVK.contact
            total += share * energy
            gradient[face] += share * weights[:, None] * slope
    return total, gradient


def tether(case: Case, x: np.ndarray, frame: int) -> tuple[float, np.ndarray]:
    tight = (case.classes == TIGHT)[:, None]
    weight = tight * STVK.tether * masses(case.mesh, 1.0)[:, None]
    offset = x - case.predicted[..., frame]
    return float(np.sum(weight * offset**2) / 2), weight * offset


TWINS: dict[str, Twin] = dict(zip(TERMS, (stvk, woven, bending, gravity, inertia, drag, collision, tether)))


def fast(case: Case, term: str, dtype: torch.dtype) -> tuple[np.ndarray, np.ndarray]:
    x = torch.tensor(case.x, dtype=dtype, requires_grad=True)
    value = case.energy_of(term, x)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach().double().numpy(), gradient.double().numpy()


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize(
    "dtype, tolerance", [(torch.float32, 2e-4), (torch.float64, 1e-10)], ids=["single", "double"]
)
def test_fast_path_equals_its_slow_reference(case, term, dtype, tolerance):
    slow = [TWINS[term](case, case.x[..., frame], frame) for frame in range(FRAMES)]
    value, gradient = np.array([v for v, _ in slow]), np.stack([g for _, g in slow], axis=-1)
    found, slope = fast(case, term, dtype)
    assert found.shape == (FRAMES,)
    np.testing.assert_allclose(found, value, rtol=tolerance)
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(slope, gradient, atol=tolerance * scale)
    cosine = np.sum(slope * gradient) / np.linalg.norm(slope) / np.linalg.norm(gradient)
    bias = np.sum((slope - gradient) * np.sign(gradient)) / np.sum(np.abs(gradient))
    assert 1 - cosine < tolerance**2 + 1e-12
    assert abs(bias) < tolerance / 10


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("seed", [0, 1])
def test_gradcheck(toy_grid, term, seed):
    small = build(*toy_grid(3, 3), seed=seed)
    x = torch.tensor(small.x, requires_grad=True)
    assert small.energy_of(term, x).abs().min() > 0
    assert torch.autograd.gradcheck(lambda x: small.energy_of(term, x), (x,), eps=1e-7, atol=1e-5, rtol=1e-4)
