# SPDX-License-Identifier: Apache-2.0
"""Fused energies against their reference implementations in double precision, in values and in gradients.

Triton's kernels, and the loops that numba compiles for a processor.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.physics import kernels, loops
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.factors import FabricFactors
from ssilk_core.physics.energy.graded import GradedRest
from ssilk_core.physics.samples import contact_samples
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import FABRICS, Fabric

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"  # on a CPU kernels run in Triton's interpreter
STVK = Fabric("stvk", bending=1e-4, margin=0.02)
WOVEN = Fabric("woven", stretch_model="baraff_witkin", bending=1e-4)
FRAMES, MOVING = 20, 13  # all, and those with a past; no block of frames divides them
Found = list[tuple[np.ndarray, np.ndarray]]


@pytest.fixture(autouse=True, params=["kernels", "loops"])
def fused(request, monkeypatch) -> str:
    """Serve a device by one of both, kernels with several blocks of frames and several shares of each sum."""
    pytest.importorskip({"kernels": "triton", "loops": "numba"}[request.param])
    monkeypatch.setattr(kernels, "available", lambda device: request.param == "kernels")
    monkeypatch.setattr(loops, "available", lambda device: request.param == "loops")
    if request.param == "loops":
        monkeypatch.setattr(sys.modules[__name__], "DEVICE", "cpu")
        return request.param
    from ssilk_core.physics.kernels import elastic, pointwise

    for module in (elastic, pointwise):
        monkeypatch.setattr(module, "FRAMES", 16)
    monkeypatch.setattr(elastic, "ELEMENTS", 3)
    monkeypatch.setattr(pointwise, "VERTICES", 4)
    return request.param


@pytest.fixture(scope="module")
def sheet() -> Mesh:
    """A triangle with a hinge at each of its edges, bent, and a seventh vertex that no triangle uses."""
    points = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.06, 0, 0], [0.015, 0.03, 0], [0.045, 0.03, 0], [0.03, 0.06, 0]])
    points[:, 2] = 0.4 * np.abs(points[:, 0] - 0.03) + 0.002 * np.random.default_rng(0).normal(size=6)
    faces = np.array([[0, 1, 3], [1, 2, 4], [1, 4, 3], [3, 4, 5]])
    return Mesh("/sheet", np.concatenate([points, [[0.1, 0, 0]]]), faces)


def crumpled(rest: np.ndarray) -> np.ndarray:
    return rest[:, :, None] + 0.006 * np.random.default_rng(1).normal(size=(7, 3, FRAMES))


def extreme(rest: np.ndarray) -> np.ndarray:
    """Frames of every kind: crumpled, stretched, the tip turned almost onto the others, and collapsed bit by bit."""
    x, angle = crumpled(rest), np.linspace(-2.9, 2.9, 6)
    x[..., 3:6] *= [1.5, 2, 4]
    x[5, :, 6:12] = x[3:5, :, 6:12].mean(axis=0) + 0.03 * np.stack([0 * angle, np.cos(angle), np.sin(angle)])
    for start, gone in zip((12, 14, 16, 18), ([0], [4], [3, 4], range(6))):
        x[list(gone), :, start : start + 2] = x[1, :, start : start + 2]
    return x


def tensor(values: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.tensor(values.astype(np.float32), dtype=dtype, device=DEVICE)


def evaluate(
    terms: str, mesh: Mesh, fabric: Fabric, positions: np.ndarray, dtype: torch.dtype, mixed: bool = False
) -> Found:
    """Both terms that a method of `GarmentEnergy` returns, each with its gradient for a random upstream gradient.

    Args:
        mixed: whether each frame has a fabric of its own.
    """
    rng = np.random.default_rng(2)
    samples = contact_samples(mesh, fabric)
    sampled = np.einsum("sk,skcn->scn", samples.weights, positions[samples.corners])
    normal = rng.normal(size=sampled.shape)
    offset = (normal * sampled).sum(1) + 0.03 * rng.normal(0.5, size=(len(sampled), FRAMES))
    path = positions[:, :, :1] + 0.02 * rng.normal(size=(len(positions), 3, MOVING + 2)) + 0.5
    root = rng.normal([[0], [-2], [0]], 0.3, size=(3, FRAMES))
    gravity = rng.normal([[0], [-9], [0]], size=(3, FRAMES))
    shift = 0.05 * rng.normal(size=(3, MOVING))
    root, gravity, normal, offset, path, shift = (
        tensor(v, dtype) for v in (root, gravity, normal, offset, path, shift)
    )
    energy = GarmentEnergy(mesh, fabric, device=DEVICE, dtype=dtype)
    x = tensor(positions, dtype).requires_grad_()
    factors = FabricFactors.of(tensor(rng.uniform(-1, 1, (FRAMES, 5)), dtype)) if mixed else None
    moving = factors.first(MOVING) if factors else None
    call = {
        "elastic": lambda: energy.elastic(x, factors),
        "potential": lambda: energy.gravity_and_collision(
            x, root, gravity, energy.cloth.positions(x), normal, offset, factors
        ),
        "kinetic": lambda: energy.inertia_and_drag(x, path[..., 1:-1], path[..., :-2], shift, 1 / 30, moving),
    }
    found = []
    for value in call[terms]():
        upstream = tensor(rng.uniform(-2, 2, size=value.shape), dtype)
        (gradient,) = torch.autograd.grad(value, x, upstream, retain_graph=True)
        found.append((value.detach().double().cpu().numpy(), gradient.double().cpu().numpy()))
    return found


def assert_equal_to_reference(
    terms: str, mesh: Mesh, fabric: Fabric, positions: np.ndarray, mixed: bool = False
) -> None:
    fused, lbs = (evaluate(terms, mesh, fabric, positions, dtype, mixed) for dtype in (torch.float32, torch.float64))
    for (value, gradient), (expected, slope) in zip(fused, lbs):
        relative = value / expected - 1
        assert np.abs(relative).max() < 2e-6 and abs(relative.mean()) < 4e-7
        size, scale = (np.linalg.norm(v, axis=(0, 1)) for v in (gradient, slope))
        assert (np.linalg.norm(gradient - slope, axis=(0, 1)) <= 2e-6 * scale + 1e-12 * scale.max()).all()
        assert (np.sum(gradient * slope, axis=(0, 1)) >= (1 - 1e-9) * size * scale).all()
        bias = np.sum((gradient - slope) * np.sign(slope), axis=(0, 1)) / np.maximum(np.abs(slope).sum((0, 1)), 1e-9)
        assert abs(bias.mean()) < 4e-7


@pytest.mark.parametrize("mixed", [False, True], ids=["one", "mixed"])
@pytest.mark.parametrize("fabric", [STVK, WOVEN], ids=lambda fabric: fabric.name)
def test_stretch_and_bending(sheet, fabric, mixed):
    assert_equal_to_reference("elastic", sheet, fabric, extreme(sheet.points), mixed)


@pytest.mark.parametrize("terms", ["potential", "kinetic"])
def test_terms_of_single_vertices_of_mixed_fabrics(sheet, terms):
    assert_equal_to_reference(terms, sheet, STVK, crumpled(sheet.points), mixed=True)


@pytest.mark.parametrize("fabric", [STVK, FABRICS["paper"]], ids=lambda fabric: fabric.contact_model)
@pytest.mark.parametrize("terms", ["potential", "kinetic"])
def test_terms_of_single_vertices(sheet, terms, fabric):
    assert_equal_to_reference(terms, sheet, fabric, crumpled(sheet.points))


def test_a_triangle_that_is_wound_the_other_way(sheet):
    faces = sheet.faces.copy()
    faces[3] = faces[3, ::-1]
    assert_equal_to_reference("elastic", Mesh("/mixed", sheet.points, faces), STVK, crumpled(sheet.points))


def test_without_hinges_only_stretch_is_left(sheet):
    one = Mesh("/one", sheet.points, sheet.faces[:1])
    for mesh, fabric in ((one, STVK), (one, WOVEN), (sheet, replace(STVK, bending=0.0))):
        energy, x = GarmentEnergy(mesh, fabric, device=DEVICE), tensor(crumpled(mesh.points)).requires_grad_()
        stretch, bending = energy.elastic(x)
        assert bending.tolist() == [0.0] * FRAMES
        found, expected = (torch.autograd.grad(v.sum(), x)[0] for v in (stretch + bending, energy.stretch(x)))
        assert (found - expected).abs().max() < 5e-6 * expected.abs().max()


def fold(angle: np.ndarray) -> np.ndarray:
    """Two triangles that share the edge 0-1, turned by each angle, shape (4, 3, N)."""
    o, i = np.zeros_like(angle), np.ones_like(angle)
    return np.array([[o, o, o], [o, o, i], [i, o, o], [-np.cos(angle), -np.sin(angle), 0.5 * i]])


def folding(rest: float, fabric: Fabric = STVK) -> GarmentEnergy:
    mesh = Mesh("/fold", fold(np.array([rest]))[..., 0], np.array([[0, 1, 2], [1, 0, 3]]))
    return GarmentEnergy(mesh, fabric, device=DEVICE)


def test_angles_all_around():
    x = tensor(fold(np.concatenate([np.linspace(-np.pi, np.pi, 80)[1:-1], [1e-6, -1e-3]])))
    turned = torch.atan2(-x[3, 1].double(), -x[3, 0].double()).cpu()
    found = folding(0.0).elastic(x)[1].double().cpu()
    np.testing.assert_allclose(found, STVK.bending / 8 * turned**2, rtol=2e-6)


@pytest.mark.parametrize("fabric", [STVK, WOVEN], ids=lambda fabric: fabric.name)
def test_collapsing_faces_count_as_flat_and_pull_nowhere(fabric):
    size, energy = 10.0 ** -np.arange(14), folding(0.5, fabric)
    thin, small = (np.repeat(fold(np.array([0.3])), 14, axis=2) for _ in range(2))
    thin[2:, :2] *= size
    x = tensor(np.concatenate([thin, small * size], axis=2)).requires_grad_()
    stretch, bending = energy.elastic(x)
    np.testing.assert_allclose(bending.tolist(), energy.bending(x).tolist(), rtol=1e-5)
    assert all(torch.autograd.grad(v.sum(), x, retain_graph=True)[0].isfinite().all() for v in (stretch, bending))
    flat = torch.autograd.grad(bending[4:14].sum(), x)[0]
    assert bending[4:14].tolist() == pytest.approx([fabric.bending / 8 * 0.5**2] * 10) and not flat.any()


def test_stitches_are_those_of_the_reference(sheet):
    over = np.concatenate([sheet.points, sheet.points[:6] * 0.4 + [0.018, 0.01, 0.002]])
    mesh = Mesh("/two", over, np.concatenate([sheet.faces, sheet.faces + 7]))
    x, found = over[:, :, None] + 0.004 * np.random.default_rng(4).normal(size=(13, 3, FRAMES)), []
    for dtype in (torch.float32, torch.float64):
        energy, at = GarmentEnergy(mesh, STVK, device=DEVICE, dtype=dtype), tensor(x, dtype).requires_grad_()
        value = energy.stitch(at)
        found += [value.detach().double().cpu(), torch.autograd.grad(value.sum(), at)[0].double().cpu()]
        assert len(energy.stitching) > 5
    torch.testing.assert_close(found[0], found[2], rtol=1e-5, atol=0)
    torch.testing.assert_close(found[1], found[3], rtol=0, atol=2e-6 * float(found[3].abs().max()))


@pytest.mark.parametrize("terms", ["elastic", "potential", "kinetic"])
def test_a_second_call_gives_the_same_bits_but_for_a_frame_that_is_not_a_number(sheet, terms):
    x = crumpled(sheet.points)
    whole = evaluate(terms, sheet, WOVEN, x, torch.float32)
    x[4, 1, 2] = np.nan
    for (value, gradient), (expected, slope) in zip(evaluate(terms, sheet, WOVEN, x, torch.float32), whole):
        assert np.flatnonzero(np.isnan(value)).tolist() == [2]
        assert np.array_equal(np.delete(value, 2), np.delete(expected, 2))
        assert np.array_equal(np.delete(gradient, 2, axis=2), np.delete(slope, 2, axis=2))


@pytest.mark.parametrize("fabric", [STVK, WOVEN], ids=["stvk", "woven"])
def test_a_rest_shape_that_moves_is_read_where_it_was_by_what_was_captured_before(sheet, fabric):
    """On a GPU energies are replayed by a graph, which was captured on another body."""
    points = sheet.points * [1.04, 1.02, 1.1] + 3e-4 * np.random.default_rng(3).normal(size=(7, 3))
    energy, own = (GarmentEnergy(mesh, fabric, device=DEVICE) for mesh in (sheet, replace(sheet, points=points)))
    rest = GradedRest(energy, sheet, (points - sheet.points)[None])
    x = torch.tensor(crumpled(points), dtype=torch.float32, device=DEVICE)
    last, before, shift = x[..., :MOVING] + 0.01, x[..., :MOVING] - 0.01, torch.ones(3, MOVING, device=DEVICE)

    def terms(of: GarmentEnergy) -> torch.Tensor:
        inertia, drag = of.inertia_and_drag(x, last, before, shift, 1 / 30)
        return torch.cat([*of.elastic(x), inertia, drag])

    replayed = terms(energy)
    if DEVICE == "cuda":
        side, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            terms(energy)
        torch.cuda.current_stream().wait_stream(side)
        with torch.cuda.graph(graph):
            replayed = terms(energy)
    for share in (0.5, 1.0):
        rest.wear(torch.full((1,), share, device=DEVICE))
    if DEVICE == "cuda":
        graph.replay()
    else:
        replayed = terms(energy)
    torch.testing.assert_close(replayed, terms(own), rtol=1e-5, atol=1e-9)
