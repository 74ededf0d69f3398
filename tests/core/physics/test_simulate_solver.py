# SPDX-License-Identifier: Apache-2.0
"""The parts of the reference simulator against autograd, dense algebra and generic minimisers, in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from ssilk_core.errors import SsilkError
from ssilk_core.physics import captured, loops
from ssilk_core.physics.collision import CollisionBody, PosedBody, SmoothedDistance
from ssilk_core.physics.energy import TERMS, GarmentEnergy
from ssilk_core.physics.energy.bending import dihedral_angles
from ssilk_core.physics.energy.stitching import Stitching
from ssilk_core.physics.energy.stretch import stretch_density
from ssilk_core.physics.simulate import newton
from ssilk_core.physics.simulate.conjugate_gradient import CHECK_EVERY, inverse_blocks, solve
from ssilk_core.physics.simulate.hinges import Hinges
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.membrane import Membrane, outer, project_psd
from ssilk_core.physics.simulate.newton import SolverOptions, State, line_search, minimise_from, newton_step
from ssilk_core.scene.assets import LOOSE, PINNED, Scene
from ssilk_core.scene.fabrics import Fabric

CPU = torch.device("cpu")
DOWN = torch.tensor([[0.0], [-9.81], [0.0]], dtype=torch.float64)
FABRICS = {
    "stvk": Fabric("stvk", bending=1e-3, margin=0.02),
    "baraff_witkin": Fabric("bw", stretch_model="baraff_witkin", bending=1e-3, margin=0.02),
}


def crumpled(scene: Scene, frames: int = 2, size: float = 0.004) -> torch.Tensor:
    rest = torch.as_tensor(scene.garment.mesh.points.copy())[:, :, None]
    return rest + size * torch.randn(len(rest), 3, frames, generator=torch.Generator().manual_seed(5)).double()


def body_of(scene: Scene, frames: int) -> PosedBody:
    joints = scene.character.skeleton.joint_count
    identity = torch.eye(4)[:3, :, None].expand(joints, 3, 4, frames)
    posed = CollisionBody(scene.character.merged_body(), joints, device=CPU).pose(identity.contiguous())
    return replace(posed, faces=None)  # planes alone: smoothing has its own tests


def moving(scene: Scene, frames: int = 2) -> tuple[torch.Tensor, StepInputs]:
    """A crumpled strip on its way, touching the ball."""
    x = crumpled(scene, frames) + torch.tensor([0.0, 0.0, 0.03], dtype=torch.float64)[:, None]
    past, air = crumpled(scene, frames, 0.01), crumpled(scene, frames, 0.02)
    return x, StepInputs(
        body_of(scene, frames), DOWN.expand(3, frames), past, air, 1 / 30, crumpled(scene, frames, 0.006)
    )


@pytest.fixture(scope="session")
def scene(patched_scene: Scene) -> Scene:
    return patched_scene


@pytest.fixture(params=FABRICS)
def potential(request: pytest.FixtureRequest, scene: Scene) -> IncrementalPotential:
    return IncrementalPotential(scene, FABRICS[request.param], device=CPU)


def test_the_energy_is_that_of_training(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene)
    energy = GarmentEnergy(scene.garment.mesh, potential.fabric, scene.classes, dtype=torch.float64)
    body = PosedBody(inputs.body.points.double(), inputs.body.normals.double(), inputs.body.rings)
    terms = {
        "stretch": energy.stretch(x),
        "bending": energy.bending(x),
        "gravity": energy.gravity(x, DOWN),
        "inertia": energy.inertia(x, inputs.predicted, inputs.dt),
        "drag": energy.drag(x, inputs.advected, inputs.dt),
        "collision": energy.collision(x, body),
        "tether": energy.tether(x, inputs.skinned[energy.tethered]),
        "stitch": energy.stitch(x),
    }
    assert terms.keys() == {*TERMS, "drag"}, "a new term is part of the simulator too"
    numbers = {name: value for name, value in vars(potential.fabric).items() if isinstance(value, float)}
    assert numbers.pop("friction") == 0  # training does not know it
    assert all(numbers.values()), f"the parameter of a new term is tried here: {numbers}"
    assert min(float(term.abs().min()) for term in terms.values()) > 0
    found = potential.energy(x, inputs, potential.body_distance(x, inputs))
    torch.testing.assert_close(found, sum(terms.values()), rtol=1e-6, atol=1e-9)


def test_the_gradient_is_that_of_autograd(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene)
    body_distance = potential.body_distance(x, inputs)
    at = x.clone().requires_grad_(True)
    (expected,) = torch.autograd.grad(potential.energy(at, inputs, body_distance).sum(), at)
    torch.testing.assert_close(potential.gradient(x, inputs, body_distance), expected, rtol=1e-9, atol=1e-11)


def test_frames_may_have_time_steps_of_their_own(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene)
    steps = torch.tensor([1 / 30, 1 / 120], dtype=torch.float64)
    together = replace(inputs, dt=steps)
    distance = potential.body_distance(x, together)
    energy, gradient = (getattr(potential, name)(x, together, distance) for name in ("energy", "gradient"))
    blocks = potential.hessian(x, together, distance).blocks
    for number, dt in enumerate(steps.tolist()):
        row = torch.tensor([number])
        alone = together.select(row)
        assert torch.equal(alone.dt, steps[row])
        alone, own = replace(alone, dt=dt), distance.select(row)
        torch.testing.assert_close(energy[row], potential.energy(x[..., row], alone, own))
        torch.testing.assert_close(gradient[..., row], potential.gradient(x[..., row], alone, own))
        torch.testing.assert_close(blocks[..., row], potential.hessian(x[..., row], alone, own).blocks)


def test_lengths_that_are_tried_at_once_give_what_one_after_the_other_gives(
    potential: IncrementalPotential, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, inputs = moving(scene, frames=4)
    state = newton.State.at(potential, x, inputs)
    gradient = potential.gradient(x, inputs, state.body_distance)
    # Steepest descents of several lengths: some are taken whole, some in small parts, and one not at all.
    step = -gradient * torch.tensor([1e-3, 0.05, 1.0, 1e4], dtype=torch.float64)
    monkeypatch.setattr(newton, "OBSTRUCTING", 1e-9)  # so that any contact obstructs
    expected = newton.line_search(potential, state, inputs, gradient, step)
    assert len(set(expected[1].tolist())) == 4 and expected[2].any()
    monkeypatch.setattr(newton, "kernels", SimpleNamespace(available=lambda device: True))
    found = newton.line_search(potential, state, inputs, gradient, step)
    for own, other in zip((*found[0].tensors(), *found[1:]), (*expected[0].tensors(), *expected[1:])):
        torch.testing.assert_close(own, other)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="graphs are CUDA's")
def test_graphs_give_what_is_computed_task_by_task(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    x, inputs = moving(scene, frames=3)
    inputs = replace(inputs, body=replace(inputs.body, rings=None, groups=None, patches=None))
    inputs = captured._like(inputs, (leaf.cuda() for leaf in captured._leaves(inputs)))
    from ssilk_core.physics.kernels import conjugate_gradient

    potential = IncrementalPotential(scene, FABRICS["stvk"], device=torch.device("cuda"))
    found = minimise_from(potential, x.cuda(), inputs, SolverOptions(tolerance=1e-6))
    assert all(vars(potential.captured)[name]._graphs for name in ("state", "gradient", "hessian"))
    assert potential.block_pattern.table.captured
    potential.in_graphs = False
    monkeypatch.setattr(conjugate_gradient, "replays", lambda x: False)
    expected = minimise_from(potential, x.cuda(), inputs, SolverOptions(tolerance=1e-6))
    torch.testing.assert_close(found.x, expected.x, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.energy, expected.energy)


def in_the_fold(scene: Scene) -> tuple[IncrementalPotential, torch.Tensor, StepInputs]:
    """A strip that stands, crumpled, between two walls that press on its vertices from both sides."""
    walls = torch.tensor([[0.0, 0, 0], [-0.06, 0, 0.06], [0.06, 0, 0.06]])
    points = torch.cat([walls + torch.tensor([0, y, 0]) for y in torch.arange(0.0, 2.0, 0.05)])
    rows = 3 * torch.arange(39)[:, None]
    faces = torch.cat([rows + torch.tensor(f) for f in ([0, 3, 4], [0, 4, 1], [0, 2, 5], [0, 5, 3])])
    normals = torch.tensor([[0.0, 0, 1], [0.7, 0, 0.7], [-0.7, 0, 0.7]]).repeat(40, 1)
    body = PosedBody(points[..., None], normals[..., None], faces=faces)
    classes = np.where(scene.classes == PINNED, PINNED, LOOSE)  # tight cloth would meet its patch of the ball alone
    loose = replace(scene, garment=replace(scene.garment, classes=classes))
    potential = IncrementalPotential(loose, replace(FABRICS["stvk"], margin=0.02), device=CPU)
    generator = torch.Generator().manual_seed(8)
    x = torch.as_tensor(scene.garment.mesh.points.copy())[:, :, None]
    x[:, 2] = 0.012 + 0.003 * torch.rand(len(x), 1, generator=generator)
    x[:, 0] = 1e-4 * torch.randn(len(x), 1, generator=generator)
    return potential, x, StepInputs(body, DOWN, x, x, 1 / 30)


def test_on_a_crease_the_hessian_of_contact_is_the_derivative_of_its_force(scene: Scene) -> None:
    potential, x, inputs = in_the_fold(scene)
    with_body = dense_hessian(potential, x, inputs, potential.body_distance(x, inputs))
    alone = dense_hessian(potential, x, inputs, None)
    contact, free, step = (with_body - alone).double(), potential.free, 1e-7

    def force(x: torch.Tensor) -> torch.Tensor:
        touched, none = (
            potential.gradient(x, inputs, body_distance)
            for body_distance in (potential.body_distance(x, inputs), None)
        )
        return (touched - none)[free, :, 0]

    own = contact.sum(2)  # all free vertices move together
    for axis in range(3):
        move = torch.zeros_like(x)
        move[free, axis] = step
        difference = (force(x + move) - force(x - move)) / (2 * step)
        torch.testing.assert_close(own[:, axis], difference, rtol=0.1, atol=0.1 * float(own.abs().max()))
    assert own[:, 0, 0].median() > 10 * potential.fabric.collision  # the crease is far stiffer than one wall


def test_taut_cloth_in_a_fold_comes_to_rest_on_the_crease(scene: Scene) -> None:
    potential, x, inputs = in_the_fold(scene)
    pressed = replace(inputs, predicted=x - torch.tensor([0, 0, 0.005]).double()[:, None])
    found = minimise_from(potential, x, pressed, SolverOptions(tolerance=1e-3))
    assert (found.residual <= 1e-3).all() and not found.fixed.any()


def test_the_membrane_has_the_hessian_of_autograd_where_it_is_stretched(scene: Scene) -> None:
    # Under tension nothing is clamped, so the positive Hessian is the Hessian.
    for fabric in FABRICS.values():
        membrane = Membrane(scene.garment.mesh, fabric, CPU, torch.float64)
        w_u, w_v = torch.randn(2, 1, 3, generator=torch.Generator().manual_seed(1)).double() * 0.1
        w_u, w_v = w_u + torch.tensor([1.3, 0, 0]), w_v + torch.tensor([0, 1.4, 0])
        if fabric.stretch_model == "baraff_witkin":
            w_v = w_v - 0.9 * (w_u * w_v).sum() / (w_u * w_u).sum() * w_u  # little shear, which has no sign
        columns = torch.cat([w_u, w_v])
        expected = torch.autograd.functional.hessian(
            lambda f, fabric=fabric: stretch_density(f[:, :, None], fabric).sum(), columns
        ).reshape(6, 6)
        membrane.operator = lambda x: x
        membrane.area = torch.ones(1, 1)
        blocks = membrane.stiffness(columns[:, :, None])[..., 0].reshape(2, 2, 3, 3)
        found = blocks.permute(0, 2, 1, 3).reshape(6, 6)
        torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-4)


def test_the_whole_hessian_of_the_membrane_is_that_of_autograd_under_compression_too() -> None:
    """Frame 0 asks for it, frame 1 for the positive one."""
    fabric = FABRICS["stvk"]
    columns = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1]]).double()
    membrane = Membrane.__new__(Membrane)
    membrane.fabric, membrane.operator, membrane.area = fabric, lambda x: x, torch.ones(1, 1)
    expected = torch.autograd.functional.hessian(lambda f: stretch_density(f[:, :, None], fabric).sum(), columns)
    blocks = membrane.stiffness(columns[:, :, None].repeat(1, 1, 2), torch.tensor([True, False]))
    found = blocks.reshape(2, 2, 3, 3, 2).permute(4, 0, 2, 1, 3).reshape(2, 6, 6)
    torch.testing.assert_close(found[0], expected.reshape(6, 6).float(), rtol=1e-5, atol=1e-4)
    assert torch.linalg.eigvalsh(found[0])[0] < -1 and torch.linalg.eigvalsh(found[1])[0] > -1e-4


def test_two_by_two_matrices_lose_their_negative_eigenvalues_only() -> None:
    entries = torch.randn(3, 500, generator=torch.Generator().manual_seed(2)).double()
    dense = torch.stack([entries[0], entries[1], entries[1], entries[2]], -1).reshape(-1, 2, 2)
    values, vectors = torch.linalg.eigh(dense)
    expected = vectors @ torch.diag_embed(values.clamp_min(0)) @ vectors.transpose(1, 2)
    uu, uv, vv = project_psd(*entries)
    torch.testing.assert_close(torch.stack([uu, uv, uv, vv], -1).reshape(-1, 2, 2), expected)


def dense_hessian(
    potential: IncrementalPotential, x: torch.Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None
) -> torch.Tensor:
    """The positive Hessian (U, 3, U, 3) of the first frame, from its products with unit vectors."""
    matrix, count = potential.hessian(x, inputs, body_distance), len(potential.free)
    units = torch.eye(3 * count).reshape(-1, count, 3)
    return torch.stack([(matrix @ unit[None])[0] for unit in units]).reshape(count, 3, count, 3)


def test_the_assembled_hessian_is_the_gauss_newton_hessian(potential: IncrementalPotential, scene: Scene) -> None:
    """Against the same parts summed densely: faces through the operator, hinges through autograd's angle."""
    x, inputs = moving(scene, 1)
    x = x * 1.15  # stretched everywhere
    body_distance = potential.body_distance(x, inputs)
    count, free = len(x), potential.free
    weights = potential.membrane.operator.matrix.to_dense().double()
    faces = weights.shape[0] // 2
    k = potential.membrane.stiffness(x)[..., 0].double().reshape(2, 2, faces, 3, 3)
    w = weights.reshape(2, faces, count)
    expected = torch.einsum("kfi,klfab,lfj->iajb", w, k, w)
    slopes = torch.autograd.functional.jacobian(
        lambda x: _angles(potential.hinges, x), x
    )[:, :, :, 0] * (2 * potential.hinges.stiffness[:, :, None]).sqrt()  # fmt: skip
    expected += torch.einsum("hia,hjb->iajb", slopes, slopes)
    inertia = potential.mass[:, 0] * (900 + potential.fabric.drag / potential.fabric.density * 30)
    inertia = inertia + potential.tether[:, 0]
    contact = potential.cloth.area * potential.law.curvature(body_distance.distance(potential.cloth.positions(x)))
    corners, shares = (
        torch.as_tensor(part) for part in (potential.cloth.samples.corners, potential.cloth.samples.weights)
    )
    mixed = torch.zeros(len(shares), count, dtype=torch.float64).scatter_add_(1, corners, shares)
    n = body_distance.normal[..., 0]
    expected += torch.einsum("s,si,sa,sb,sj->iajb", contact[:, 0], mixed, n, n, mixed)
    own = inertia[:, None, None] * torch.eye(3)
    for v in range(count):
        expected[v, :, v] += own[v]
    springs = potential.stitching
    held = torch.autograd.functional.jacobian(lambda x: _stretched(springs, x), x)[..., 0]
    expected += torch.einsum("scia,scjb->iajb", held, held)
    assert (contact > 0).any() and len(springs) > 9
    found = dense_hessian(potential, x, inputs, body_distance)
    torch.testing.assert_close(found, expected[free][:, :, free].float(), rtol=1e-3, atol=2e-3)


def _angles(hinges: Hinges, x: torch.Tensor) -> torch.Tensor:
    return dihedral_angles(*hinges.operator(x).chunk(3))[:, 0]


def _stretched(springs: Stitching, x: torch.Tensor) -> torch.Tensor:
    arm, first, second = springs.arms(x)
    return (springs.stiffness.sqrt()[:, None] * (arm - springs.height * springs.normal(first, second)[0]))[..., 0]


def test_no_hessian_has_a_negative_eigenvalue(potential: IncrementalPotential, scene: Scene) -> None:
    _, inputs = moving(scene, 1)
    still = replace(inputs, predicted=None, advected=None, dt=1e9)
    squeezed = 0.7 * crumpled(scene, 1, 0.01)
    matrix = dense_hessian(potential, squeezed, still, potential.body_distance(squeezed, still))
    side = 3 * len(potential.free)
    values = torch.linalg.eigvalsh(matrix.reshape(side, side).double())
    assert values[0] > -1e-6 * values[-1]


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("size", [1.15, 0.7])  # stretched, and squeezed
def test_loops_assemble_the_hessian_of_the_reference_in_double_precision(
    potential: IncrementalPotential, scene: Scene, size: float, whole: bool
) -> None:
    pytest.importorskip("numba")
    from ssilk_core.physics.loops.block_products import block_product_loop

    x, inputs = moving(scene)
    x = size * x
    distance = potential.body_distance(x, inputs)
    exact = torch.tensor([whole, False])
    expected = potential.hessian(x, inputs, distance, exact_hessian=exact).blocks
    single = IncrementalPotential(scene, potential.fabric, device=CPU, dtype=torch.float32)
    assert distance is not None and loops.supports(x.float())
    found = single.hessian(x.float(), inputs, distance.to(torch.float32), exact_hessian=exact).blocks
    assert float((found - expected).norm()) < 2e-5 * float(expected.norm())
    jacobian = torch.randn(2, 3 * len(potential.free), 7, generator=torch.Generator().manual_seed(1))
    weight = torch.rand(len(potential.free), generator=torch.Generator().manual_seed(2))
    product, squares = block_product_loop(found, single.block_pattern.block_rows, jacobian, weight)
    rows = single.block_pattern.rows(found).to_dense().double()
    wanted = (rows @ jacobian.double().flatten(0, 1)).view_as(jacobian)
    torch.testing.assert_close(product.double(), wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))
    torch.testing.assert_close(squares, weight.repeat_interleave(3) @ jacobian.square())


@pytest.mark.parametrize("paper", [False, True])
def test_loops_add_up_energies_and_forces_of_points_as_the_reference_in_double_precision(
    scene: Scene, paper: bool
) -> None:
    pytest.importorskip("numba")
    law = {"contact_model": "vertex"} if paper else {}
    fabric = Fabric("toy", bending=1e-3, margin=0.02, tether=500.0, drag=0.3, **law)
    both = [IncrementalPotential(scene, fabric, device=CPU, dtype=dtype) for dtype in (torch.float64, torch.float32)]
    x, inputs = moving(scene)
    distance = both[0].body_distance(x, inputs)
    assert distance is not None and float(both[0].collision(x, distance).sum()) > 1e-4
    names = "gravity", "predicted", "advected", "skinned"
    single = replace(inputs, **{name: getattr(inputs, name).float() for name in names})
    given = [(x, inputs, distance), (x.float(), single, distance.to(torch.float32))]
    expected, found = (made.energy(*each) for made, each in zip(both, given))
    torch.testing.assert_close(found.double(), expected, rtol=2e-6, atol=0)
    expected, found = (made.gradient(*each) for made, each in zip(both, given))
    assert float((found - expected).norm()) < 1e-5 * float(expected.norm())  # positions are rounded, too
    broken = x.float()
    broken[3, 1, 0] = torch.nan
    assert both[1].energy(broken, *given[1][1:]).isnan().tolist() == [True, False]


def test_blocks_are_inverted() -> None:
    roots = torch.randn(40, 3, 3, generator=torch.Generator().manual_seed(3)).double()
    blocks = roots @ roots.transpose(1, 2) + 0.1 * torch.eye(3)
    torch.testing.assert_close(inverse_blocks(blocks), torch.linalg.inv(blocks))


def test_indefinite_blocks_have_definite_inverses() -> None:
    axes = torch.linalg.qr(torch.randn(60, 3, 3, generator=torch.Generator().manual_seed(3)).double())[0]
    for values in ([-1.0, 2.0, 3.0], [-1.0, -2.0, 3.0], [-1.0, -2.0, -3.0]):
        blocks = axes @ torch.diag(torch.tensor(values).double()) @ axes.transpose(1, 2)
        found = torch.linalg.eigvalsh(inverse_blocks(blocks.float()).double())
        assert found.isfinite().all() and (found > 0.01).all()


def test_under_compression_the_whole_hessian_gives_finite_steps(
    potential: IncrementalPotential, scene: Scene
) -> None:
    x, inputs = moving(scene, 3)
    squeezed, fixed = 0.3 * x, torch.zeros_like(x[:, 0], dtype=torch.bool)
    fixed[potential.free[::5]] = True
    state = State.at(potential, squeezed, inputs)
    gradient = potential.gradient(squeezed, inputs, state.body_distance)
    step, _ = newton_step(potential, state, inputs, gradient, 50, fixed, torch.tensor([True, True, False]))
    assert step.isfinite().all() and step[potential.free[::5]].abs().max() == 0
    assert (step[..., 2] * gradient[..., 2]).sum() < 0


def test_blocks_at_slivers_are_inverted_in_single_precision() -> None:
    axes = torch.linalg.qr(torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(3)).double())[0]
    blocks = axes @ torch.diag(torch.tensor([1e13, 1e9, 1.0]).double()) @ axes.transpose(1, 2)
    found = torch.linalg.eigvalsh(inverse_blocks(blocks.float()).double())
    assert found.isfinite().all() and (found > 0).all()


def test_a_matrix_that_rounding_left_indefinite_keeps_what_it_has_found() -> None:
    matrix, right = torch.diag(torch.tensor([4.0, 1.0, -1e-3])), torch.tensor([[[1.0, 1.0, 1.0]]])
    z, count = solve(lambda v: v @ matrix, lambda r: r, right, 1e-6, iterations=50)
    assert count == CHECK_EVERY and z.isfinite().all() and (z * right).sum() > 0
    before, _ = solve(lambda v: v @ matrix, lambda r: r, right, 1e-6, iterations=2)
    assert torch.equal(z, before)  # the third direction is the one that curves down


def test_conjugate_gradients_solve_each_frame_by_itself() -> None:
    generator = torch.Generator().manual_seed(4)
    roots = torch.randn(3, 12, 12, generator=generator).double()
    matrices = roots @ roots.transpose(1, 2) + torch.tensor([0.1, 1.0, 100.0])[:, None, None] * torch.eye(12)
    right = torch.randn(3, 4, 3, generator=generator).double()
    z, _ = solve(
        lambda v: (matrices @ v.reshape(3, 12, 1)).reshape(3, 4, 3), lambda r: r, right, 1e-9, iterations=200
    )
    expected = torch.linalg.solve(matrices, right.reshape(3, 12, 1)).reshape(3, 4, 3)
    torch.testing.assert_close(z, expected, rtol=1e-6, atol=1e-8)


def test_a_line_search_accepts_no_worse_state(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 3)
    state = State.at(potential, x, inputs)
    gradient = potential.gradient(x, inputs, state.body_distance)
    step, _ = newton_step(potential, state, inputs, gradient, 50)
    wild = step * torch.tensor([1.0, 300.0, -1.0], dtype=torch.float64)
    found, length, _ = line_search(potential, state, inputs, gradient, wild)
    assert (length > 0).tolist() == [True, True, False]  # uphill, no step is good enough
    share = (found.x - x).abs().sum((0, 1)) / wild.abs().sum((0, 1))
    assert 0 < share[1] < 1 and share[2] == 0
    torch.testing.assert_close(share, length, rtol=1e-9, atol=1e-12)
    fresh = State.at(potential, found.x, inputs)  # the energy is that of the body points nearest to where it ends
    torch.testing.assert_close(found.energy, fresh.energy, rtol=1e-12, atol=0)
    assert (found.energy[:2] < state.energy[:2]).all() and found.energy[2] == state.energy[2]


def test_no_step_is_longer_than_a_tenth_of_the_garment(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 2)
    state = State.at(potential, x, inputs)
    gradient = potential.gradient(x, inputs, state.body_distance) * torch.tensor([1e-6, 1e9], dtype=torch.float64)
    step, _ = newton_step(potential, state, inputs, gradient, 50)
    short, long = step.norm(dim=1).amax(0).tolist()
    assert 0 < short < 1e-3 < long == pytest.approx(0.1 * np.linalg.norm(np.ptp(scene.garment.mesh.points, axis=0)))


def test_more_iterations_never_end_higher(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 4)
    budgets = [SolverOptions(tolerance=1e-9, iterations=n) for n in (1, 2, 3, 4, 6, 8, 12, 16)]
    energies = [State.at(potential, x, inputs).energy]
    energies += [minimise_from(potential, x, inputs, options).energy for options in budgets]
    assert (torch.stack(energies).diff(dim=0) <= 0).all() and (energies[1] < energies[0]).all()


def test_the_solver_is_as_low_as_a_generic_minimiser(potential: IncrementalPotential, scene: Scene) -> None:
    """One step of implicit Euler, without the body, by L-BFGS-B."""
    x, inputs = moving(scene, 1)
    inputs = replace(inputs, body=None)
    found = minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-6))
    assert found.residual < 1e-6
    shape, free = x[potential.free].shape, potential.free

    def at(values: np.ndarray) -> torch.Tensor:
        return x.index_copy(0, free, torch.as_tensor(values.reshape(shape)))

    def value(values: np.ndarray) -> tuple[float, np.ndarray]:
        gradient = potential.gradient(at(values), inputs, None)[free]
        return float(potential.energy(at(values), inputs, None)), gradient.numpy().reshape(-1)

    start = found.x[free].numpy().reshape(-1) + 1e-3 * np.random.default_rng(0).standard_normal(len(free) * 3)
    options = {"maxiter": 3000, "maxfun": 6000, "ftol": 1e-16, "gtol": 1e-10}
    by_bfgs = minimize(value, start, jac=True, method="L-BFGS-B", options=options)
    assert abs(float(found.energy) - by_bfgs.fun) < 1e-8
    np.testing.assert_allclose(found.x[free].numpy().reshape(-1), by_bfgs.x, atol=2e-5)


def test_frames_of_a_batch_do_not_see_each_other(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 3)
    options = SolverOptions(tolerance=1e-5)
    together = minimise_from(potential, x, inputs, options)
    for frame in range(3):
        one = torch.tensor([frame])
        alone = minimise_from(potential, x[..., one], inputs.select(one), options)
        torch.testing.assert_close(together.x[..., one], alone.x, rtol=0, atol=1e-6)
        torch.testing.assert_close(together.energy[one], alone.energy, rtol=0, atol=1e-9)


def test_pinned_vertices_stay_and_the_solution_is_in_balance(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 2)
    found = minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-3))
    pinned = scene.classes == 0
    assert torch.equal(found.x[pinned], x[pinned])
    gradient = potential.gradient(found.x, inputs, potential.body_distance(found.x, inputs))[potential.free]
    force = (gradient.norm(dim=1) / potential.mass[potential.free] / 9.81).square().mean(0).sqrt()
    assert (found.residual <= 1e-3).all() and (force < 3e-3).all()
    before = potential.energy(x, inputs, potential.body_distance(x, inputs))
    assert (found.energy < before).all()


def creased(
    potential: IncrementalPotential, vertex: int, at: float
) -> Callable[[torch.Tensor, StepInputs], SmoothedDistance]:
    """What finds distances where one vertex stands between two walls that both push it, 1 cm deep in either."""

    def body_distance(x: torch.Tensor, inputs: StepInputs) -> SmoothedDistance:
        normal, offset = torch.zeros_like(x), torch.full_like(x[:, 0], -1e6)
        side = torch.where(
            x[vertex, 0] < at, -1.0, 1.0
        ).double()  # pushed over the middle, where the other one pushes
        normal[vertex, 0] = -side
        offset[vertex] = -side * at + 0.01
        curvature = 1e4 * torch.eye(3)[None, :, :, None].repeat(len(x), 1, 1, x.shape[2])  # as on a crease
        return SmoothedDistance(normal, offset, curvature)

    return body_distance


def test_a_vertex_on_a_crease_does_not_keep_the_others_from_coming_to_rest(
    monkeypatch, potential: IncrementalPotential, toy_scene: Callable[[], Scene]
) -> None:
    scene = toy_scene()
    x, inputs = moving(scene, 2)
    potential = IncrementalPotential(scene, replace(potential.fabric, contact_model="vertex", tether=0.0), device=CPU)
    vertex = int(potential.free[len(potential.free) // 2])
    monkeypatch.setattr(potential, "body_distance", creased(potential, vertex, float(x[vertex, 0, 0])))
    options = SolverOptions(tolerance=1e-3)
    found = minimise_from(potential, x, inputs, options)
    assert (found.residual <= 1e-3).all()
    monkeypatch.setattr(newton, "OBSTRUCTING", torch.inf)
    stuck = minimise_from(potential, x, inputs, options)
    assert (stuck.residual[0] > 1) and found.energy[0] <= stuck.energy[0]


def test_fixed_vertices_are_released_once_when_the_others_have_converged(
    potential: IncrementalPotential, scene: Scene
) -> None:
    x, inputs = moving(scene, 2)
    start = minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-5)).x
    vertex = int(potential.free[-1])
    start[vertex, 1] += 2e-3

    def left(released: bool) -> newton.Solution:
        search = newton.Search(potential, start, inputs, SolverOptions(tolerance=1e9))
        fixed = search.course.fixed.index_put((torch.tensor(vertex),), torch.tensor([True, False]))
        search.course = replace(search.course, fixed=fixed, released=torch.full((2,), released))
        ((frames, found),) = search.leave()
        assert frames.tolist() == [0, 1] and not len(search)
        return found

    assert not left(False).fixed.any() and (left(False).residual > 0.1).all()  # fixed vertices count again
    assert left(True).fixed.tolist() == [1, 0]


def test_frames_that_join_a_search_find_what_they_find_alone(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 3)
    options, alone = SolverOptions(tolerance=1e-5), {}
    for frame in range(3):
        one = torch.tensor([frame])
        alone[10 + frame] = minimise_from(potential, x[..., one], inputs.select(one), options)
    first, rest = torch.tensor([0]), torch.tensor([1, 2])
    search, found = newton.Search(potential, x[..., first], inputs.select(first), options, [10]), []
    for _ in range(3):
        search.advance()
    search.join(newton.Search(potential, x[..., rest], inputs.select(rest), options, [11, 12]))
    while len(search):
        found += search.leave()
        if len(search):
            search.advance()
    for numbers, solution in found:
        for number, own in zip(numbers.tolist(), solution.split()):
            assert own.iterations > 3 and float(own.energy) == pytest.approx(float(alone[number].energy), abs=1e-9)
            torch.testing.assert_close(own.x, alone[number].x, rtol=0, atol=1e-6)
    assert sorted(int(number) for numbers, _ in found for number in numbers) == [10, 11, 12]


def test_a_frame_that_the_whole_hessian_misleads_goes_on_without_it(
    monkeypatch, potential: IncrementalPotential, scene: Scene
) -> None:
    x, inputs = moving(scene, 2)
    asked = []

    def misleading(potential, state, inputs, gradient, cg_iterations, fixed=None, exact_hessian=None):
        step, count = newton_step(potential, state, inputs, gradient, cg_iterations, fixed)
        asked.append(exact_hessian)
        return torch.where(exact_hessian, 0.0, step), count  # as where the first direction already curves down

    monkeypatch.setattr(newton, "newton_step", misleading)
    found = minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-3))
    tried = torch.stack([whole[0] for whole in asked if len(whole) == 2])
    assert (found.residual <= 1e-3).all() and tried.any()
    assert not (tried[1:] & tried[:-1]).any()  # it waits before it tries again


def test_states_that_are_not_finite_are_refused(potential: IncrementalPotential, scene: Scene) -> None:
    x, inputs = moving(scene, 2)
    x[3, 1, 1] = torch.nan
    with pytest.raises(SsilkError, match=r"first state of 1 of 2 frames has no finite energy"):
        minimise_from(potential, x, inputs, SolverOptions())


def test_outer_products() -> None:
    a, b = torch.randn(2, 4, 3, 5)
    torch.testing.assert_close(outer(a, b), torch.einsum("man,mbn->mabn", a, b))
