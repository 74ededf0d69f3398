# SPDX-License-Identifier: Apache-2.0
"""The solver in latents on the toy world, in float64: derivatives, descent, minima, and what it reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssilk_core.errors import SsilkError
from ssilk_core.network.latent_solver import LatentOptions, LatentSolver, shots, solver
from ssilk_core.network.latent_solver.free_decoder import DecodedPoints
from ssilk_core.network.latent_solver.normal_equations import TINY, NormalEquations
from ssilk_core.network.latent_solver.shots import LatentShots
from ssilk_core.network.latent_solver.slopes import limited_slopes, mlp_slopes
from ssilk_core.network.latent_solver.warm_start import NetworkSteps
from ssilk_core.network.model.decoder import limited
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.physics import loops
from ssilk_core.physics.collision import SmoothedDistance, contacts
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.scene.assets import Motion, Scene
from ssilk_core.scene.fabrics import Fabric

pytestmark = pytest.mark.usefixtures("few_contacts")

CLOTH = Fabric("toy", bending=1e-4, margin=0.02)
EXACT = LatentOptions(iterations=200, first_iterations=200, tolerance=1e-6, exact_contact=True)
KINDS = {
    "turning": {},
    "moving": {"translations": True},
    "reduced": {"activations": 6, "translations": True},
    "no shapes": {"shapes": 0},
    "no tanh": {"tanh": False},
}


@dataclass(frozen=True, eq=False)
class Frames:
    """Two frames of the toy's motion, on their way: a solver, latents, characters and inputs."""

    model: GarmentModel
    solver: LatentSolver
    z: Tensor
    character: Tensor
    inputs: StepInputs

    @property
    def potential(self) -> IncrementalPotential:
        return self.solver.potential

    def energy(self, z: Tensor) -> Tensor:
        """Energies (N,), with a query of the body for each state."""
        x = self.solver.decode(z, self.character, self.inputs)
        return self.potential.energy(x, self.inputs, self.potential.body_distance(x, self.inputs))


@pytest.fixture
def frames(
    scene: Scene, toy_model: Callable[..., GarmentModel], toy_motion: Callable[..., Motion]
) -> Callable[..., Frames]:
    def build(options: LatentOptions = EXACT, **sizes: object) -> Frames:
        model, motion = toy_model(scene, **sizes), toy_motion(scene, 6)
        made = LatentShots(model, CLOTH, options, precision="float64")
        z = torch.randn(2, model.config.latent, generator=torch.Generator().manual_seed(7)).double() * 0.5
        pose = made.simulator.poser.pose
        last, now = (pose(motion.rotations[i : i + 2], motion.translations[i : i + 2]) for i in (2, 3))
        inputs = made.simulator.inputs(now, StepHistory(last.lbs.double() + last.root, None, last.root, last.lbs))
        return Frames(model, made.solver, z, now.matrices, inputs)

    return build


@pytest.mark.parametrize("kind", KINDS)
def test_it_decodes_as_the_model_does_and_its_jacobian_is_that_of_autograd(frames, scene, kind) -> None:
    found = frames(**KINDS[kind])
    decoder, free = found.solver.decoder, found.potential.free
    expected = found.model.double().vertices(found.z, found.character)[free]
    torch.testing.assert_close(decoder.positions(found.z, found.character), expected, rtol=0, atol=1e-12)
    decoded = decoder.linearise(found.z, found.character)
    torch.testing.assert_close(decoded.x, expected, rtol=0, atol=1e-12)

    def vertices(z: Tensor) -> Tensor:
        return found.model.vertices(z, found.character)[free].permute(2, 0, 1).flatten(1).sum(0)

    jacobian = torch.autograd.functional.jacobian(vertices, found.z)  # (3 U, N, m): frames do not mix
    torch.testing.assert_close(decoded.jacobian, jacobian.transpose(0, 1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_loops_decode_and_add_up_forces_as_their_reference_in_double_precision(frames, kind) -> None:
    pytest.importorskip("numba")
    exact = frames(**KINDS[kind])
    single = LatentShots(exact.model, CLOTH, EXACT, precision="float32")
    decoder, potential = single.solver.decoder, single.simulator.potential
    z, character = exact.z.float(), exact.character.float()
    assert loops.supports(z)
    for reach in (decoder.reach, 1e-3):  # far enough for all displacements, and for none
        decoder.reach = exact.solver.decoder.reach = reach
        expected, found = exact.solver.decoder.linearise(exact.z, exact.character), decoder.linearise(z, character)
        torch.testing.assert_close(found.x.double(), expected.x, rtol=0, atol=2e-6)
        scale = float(expected.jacobian.abs().max())
        torch.testing.assert_close(found.jacobian.double(), expected.jacobian, rtol=0, atol=2e-5 * scale)
        torch.testing.assert_close(decoder.positions(z, character).double(), expected.x, rtol=0, atol=2e-6)
    x = exact.solver.decode(exact.z, exact.character, exact.inputs)
    inputs = replace(
        exact.inputs,
        body=None,
        gravity=exact.inputs.gravity.float(),
        **{name: getattr(exact.inputs, name).float() for name in ("predicted", "advected", "skinned")},
    )
    energy = exact.potential.energy(x, replace(exact.inputs, body=None), None)
    torch.testing.assert_close(potential.energy(x.float(), inputs, None).double(), energy, rtol=1e-4, atol=1e-6)
    gradient = exact.potential.gradient(x, replace(exact.inputs, body=None), None)
    apart = (potential.gradient(x.float(), inputs, None).double() - gradient).norm()
    assert apart < 1e-4 * gradient.norm()


def test_displacements_are_held_back_with_their_slopes() -> None:
    generator = torch.Generator().manual_seed(1)
    moved, direction = torch.randn(2, 5, 3, 2, generator=generator).double()
    assert 0 < (moved.norm(dim=1) > 1).sum() < 10
    value, slopes = limited_slopes(moved, direction[..., None], 1.0)
    expected, tangent = torch.func.jvp(lambda v: limited(v, 1.0), (moved,), (direction,))
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(slopes[..., 0], tangent)


def test_a_layer_of_another_kind_is_refused() -> None:
    with pytest.raises(TypeError, match="ReLU"):
        mlp_slopes(torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.ReLU()), torch.zeros(1, 3))


def test_its_forces_are_the_slopes_of_the_energy(frames) -> None:
    found = frames(translations=True)
    gradient = found.solver.equations(found.z, found.character, found.inputs).gradient
    step = 1e-6
    for latent in range(found.z.shape[1]):
        ahead, behind = found.z.clone(), found.z.clone()
        ahead[:, latent] += step
        behind[:, latent] -= step
        slope = (found.energy(ahead) - found.energy(behind)) / (2 * step)
        torch.testing.assert_close(gradient[:, latent], slope, rtol=1e-4, atol=1e-6)


def test_its_hessian_is_that_of_the_simulator_seen_by_the_latents(frames) -> None:
    found = frames(translations=True)
    x = found.solver.decode(found.z, found.character, found.inputs)
    distance = found.potential.body_distance(x, found.inputs)
    dense = found.potential.hessian(x, found.inputs, distance).rows.to_dense().double()
    jacobian = found.solver.decoder.linearise(found.z, found.character).jacobian
    model = found.solver.equations(found.z, found.character, found.inputs)
    rows = jacobian.shape[1]
    for frame in range(2):
        own = slice(frame * rows, (frame + 1) * rows)
        expected = jacobian[frame].T @ dense[own, own] @ jacobian[frame]
        torch.testing.assert_close(model.hessian[frame], expected, rtol=1e-5, atol=1e-6)
        inertia = found.potential.mass[found.potential.free, 0].repeat_interleave(3) * 900
        mean = (jacobian[frame].T @ (inertia[:, None] * jacobian[frame])).diagonal().mean()
        torch.testing.assert_close(model.inertia[frame], mean)
    assert torch.linalg.eigvalsh(model.hessian).min() > 0


def test_steps_are_those_of_dense_algebra_and_promise_what_the_model_says() -> None:
    generator = torch.Generator().manual_seed(3)
    roots = torch.randn(3, 9, 9, generator=generator).double()
    hessian, gradient = roots @ roots.mT, torch.randn(3, 9, generator=generator).double()
    hessian[2] -= 100 * torch.eye(9)  # no step of the last frame lowers it
    held = torch.rand(3, 9, generator=generator) < 0.3
    dampings, inertia = torch.tensor([[0.1] * 3, [3.0] * 3]).double(), torch.tensor([1.0, 2.0, 1.0]).double()
    steps, promised = NormalEquations(gradient, hessian, inertia).steps(dampings, held)
    for frame in range(2):
        free, own = ~held[frame], hessian[frame]
        for trial in range(2):
            shift = dampings[trial, frame] * inertia[frame] + TINY * own.diagonal().mean()
            damped = own[free][:, free] + shift * torch.eye(int(free.sum()))
            step = torch.zeros(9).double()
            step[free] = -torch.linalg.solve(damped, gradient[frame][free])
            torch.testing.assert_close(steps[trial, frame], step)
            torch.testing.assert_close(promised[trial, frame], -gradient[frame] @ step - 0.5 * step @ own @ step)
    assert not steps[:, 2].any() and not promised[:, 2].any()


@pytest.mark.parametrize(("exact", "precision"), [(True, "float64"), (False, "float32")])
def test_no_frame_gains_energy(scene, toy_model, toy_motion, exact, precision) -> None:
    model, motion = toy_model(scene), toy_motion(scene, 8, speed=3.0)
    options = LatentOptions(iterations=2, first_iterations=9, exact_contact=exact)
    found = [frame.solution for frame in LatentShots(model, CLOTH, options, precision=precision).frames([motion])]
    assert all(bool((each.energy <= each.start_energy).all()) for each in found)
    assert sum(bool((each.energy < each.start_energy).all()) for each in found) > 4
    assert all(bool((each.z.abs() <= model.config.latent_bound).all()) for each in found)


@pytest.mark.parametrize("exact", [True, False])
def test_more_iterations_find_less_energy(frames, exact) -> None:
    energies = []
    for iterations in (1, 3, 9):
        found = frames(LatentOptions(iterations=iterations, exact_contact=exact), translations=True)
        result = found.solver.solve([found.z], found.character, found.inputs)
        torch.testing.assert_close(result.energy, found.energy(result.z))  # with a query of its own
        energies.append(result.energy)
    assert bool((energies[2] < energies[1]).all()) and bool((energies[1] < energies[0]).all())


@pytest.mark.parametrize("exact", [True, False])
def test_with_many_iterations_nothing_pulls_any_more(frames, exact) -> None:
    """With states that hardly pass through the body, inside of which the energy jumps."""
    options = replace(EXACT, tolerance=1e-5, exact_contact=exact)
    found = frames(options, translations=True, scale=0.1, feedback_points=0)
    before = found.solver.equations(found.z, found.character, found.inputs).gradient
    result = found.solver.solve([found.z], found.character, found.inputs)
    distance = found.potential.body_distance(result.x, found.inputs)
    assert float(found.potential.collision(result.x, distance).sum()) > 1e-5
    after = found.solver.equations(result.z, found.character, found.inputs).gradient
    assert bool(result.converged.all()) and not bool(result.failed.any())
    assert float(after.abs().max()) < 1e-6 * float(before.abs().max())
    assert bool((result.left_share < 1e-9).all())


@pytest.mark.parametrize("moved", [1e-4, 3e-3, 0.05])
def test_distances_found_nearby_give_the_same_energy_and_derivatives(frames, monkeypatch, moved) -> None:
    found = frames()
    potential, inputs = found.potential, found.inputs
    at = inputs.skinned + torch.tensor([0.0, 0.0, 0.02]).double()[:, None]  # it touches the ball
    known = potential.body_distance(at, inputs)
    x = at + moved * torch.randn(at.shape, generator=torch.Generator().manual_seed(4)).double()
    queried, query = [], contacts.smoothed_planes

    def counted(x: Tensor, *args: object, **options: object) -> SmoothedDistance:
        queried.append(len(x))
        return query(x, *args, **options)

    monkeypatch.setattr(contacts, "smoothed_planes", counted)
    near, full = potential.body_distance_nearby(x, inputs, known, at), potential.body_distance(x, inputs)
    assert moved > 0.01 or sum(queried[:-2]) < 0.8 * sum(queried[-2:])
    assert float(potential.collision(x, full).sum()) > 1e-6
    torch.testing.assert_close(potential.energy(x, inputs, near), potential.energy(x, inputs, full))
    torch.testing.assert_close(potential.gradient(x, inputs, near), potential.gradient(x, inputs, full))
    blocks = (potential.hessian(x, inputs, distance).blocks for distance in (near, full))
    torch.testing.assert_close(*blocks)


class LinearDecoder:
    """Every coordinate of every free vertex is a latent."""

    def __init__(self, start: Tensor) -> None:
        self.start = start

    def positions(self, z: Tensor, character: Tensor) -> Tensor:
        return self.start[..., : len(z)] + z.unflatten(1, (-1, 3)).permute(1, 2, 0)

    def linearise(self, z: Tensor, character: Tensor) -> DecodedPoints:
        jacobian = torch.eye(z.shape[1], dtype=z.dtype).expand(len(z), -1, -1)
        return DecodedPoints(self.positions(z, character), jacobian)


def test_over_all_vertices_it_finds_what_the_simulator_finds(frames, monkeypatch) -> None:
    found = frames(replace(EXACT, tolerance=1e-5))
    potential, free = found.potential, found.potential.free
    start = found.inputs.skinned
    monkeypatch.setattr(found.solver, "decoder", LinearDecoder(start[free][..., :1]))
    inputs, character = found.inputs.select(torch.tensor([0])), found.character[..., :1]
    result = found.solver.solve([start.new_zeros(1, 3 * len(free))], character, inputs)
    expected = minimise_from(potential, start[..., :1], inputs, SolverOptions(tolerance=1e-5, iterations=200))
    assert bool(result.converged.all()) and float(expected.residual) < 1e-5
    torch.testing.assert_close(result.x, expected.x, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.energy, expected.energy, rtol=0, atol=1e-9)


def held(motion: Motion, frames: int) -> Motion:
    return replace(
        motion,
        rotations=np.repeat(motion.rotations[:1], frames, axis=0),
        translations=np.repeat(motion.translations[:1], frames, axis=0),
    )


def test_a_garment_at_rest_in_a_held_pose_stays_put(scene, toy_model, toy_motion) -> None:
    still = held(toy_motion(scene, 1), 6)
    made = LatentShots(toy_model(scene, scale=0.1), CLOTH, replace(EXACT, iterations=4), precision="float64")
    found = [frame.solution for frame in made.frames([still])]
    assert bool(found[0].converged.all())
    for each in found[1:]:
        torch.testing.assert_close(each.x, found[0].x, rtol=0, atol=1e-6)


def test_it_solves_under_the_gravity_that_each_motion_feels(scene, toy_model, toy_motion) -> None:
    motion = toy_motion(scene, 4)
    made = LatentShots(toy_model(scene, scale=0.1), CLOTH, replace(EXACT, iterations=4), precision="float64")
    usual, aside = np.array([0.0, -GRAVITY, 0.0]), np.array([3 * GRAVITY, 0.0, 0.0])
    said = [replace(motion, gravity=np.tile(each, (4, 1))) for each in (usual, aside)]
    for plain, both in zip(made.frames([motion]), made.frames(said)):
        torch.testing.assert_close(both.solution.x[..., 0], plain.solution.x[..., 0], rtol=0, atol=1e-6)
        moved = both.solution.x[..., 1] - both.solution.x[..., 0]
        assert moved[:, 0].mean() > 1e-3


def test_shots_that_are_solved_together_come_out_as_each_by_itself(scene, toy_model, toy_motion) -> None:
    model, options = toy_model(scene), LatentOptions(iterations=2, first_iterations=3)
    motions = [toy_motion(scene, 5, speed=3.0), toy_motion(scene, 5), toy_motion(scene, 3, speed=2.0)]
    made = LatentShots(model, CLOTH, options, precision="float64")
    together = list(made.frames(motions))
    assert [len(frame.lost) for frame in together] == [3, 3, 3, 2, 2]
    for shot, motion in enumerate(motions):
        for alone, frame in zip(made.frames([motion]), together):
            torch.testing.assert_close(frame.solution.x[..., shot], alone.solution.x[..., 0], rtol=0, atol=1e-5)


def test_a_garment_without_a_stepper_is_solved_for_too(scene, toy_model, toy_motion) -> None:
    made = LatentShots(toy_model(scene, scheme="quasi_static"), CLOTH, LatentOptions(), precision="float32")
    found = [frame.solution for frame in made.frames([toy_motion(scene, 4)])]
    assert all(bool((each.energy < each.start_energy).all()) for each in found)


def test_a_state_presses_against_the_bound_and_does_not_pass_it(frames) -> None:
    found = frames(latent_bound=0.3)
    result = found.solver.solve([found.z], found.character, found.inputs)
    on_bound = result.z.abs() == 0.3
    assert 0 < int(on_bound.sum()) < on_bound.numel() and bool((result.z.abs() <= 0.3).all())
    gradient = found.solver.equations(result.z, found.character, found.inputs).gradient
    free = torch.where(on_bound & (gradient * result.z < 0), 0, gradient)
    assert float(free.abs().max()) < 1e-4 and bool(result.converged.all())


def test_what_has_not_converged_says_so(frames, monkeypatch) -> None:
    few = frames(LatentOptions(iterations=1, tolerance=1e-4))
    result = few.solver.solve([few.z], few.character, few.inputs)
    assert not bool(result.converged.any()) and not bool(result.failed.any())
    assert bool((result.left > result.allowed).all()) and bool((result.left_share > 1e-3).all())
    monkeypatch.setattr(solver, "TRIALS", ((1.0, -0.01),))  # uphill
    stuck = few.solver.solve([few.z], few.character, few.inputs)
    assert bool(stuck.failed.all()) and not bool(stuck.iterations.any())
    torch.testing.assert_close(stuck.z, few.z)
    torch.testing.assert_close(stuck.left_share, torch.ones(2).double())


def test_a_lost_state_rests_and_then_goes_on(scene, toy_model, toy_motion, monkeypatch) -> None:
    monkeypatch.setattr(shots, "RECOVERY_FRAMES", 2)
    options = LatentOptions(first_iterations=2)
    made = LatentShots(toy_model(scene), CLOTH, options, precision="float64")
    inputs, calls = made.simulator.inputs, []

    def broken(*given: object) -> StepInputs:
        calls.append(given)
        right = inputs(*given)
        return replace(right, gravity=right.gravity * np.nan) if len(calls) == 4 else right

    monkeypatch.setattr(made.simulator, "inputs", broken)
    found = list(made.frames([toy_motion(scene, 7)]))
    assert [bool(frame.lost) for frame in found] == [False, False, False, True, True, False, False]
    assert all(bool(frame.solution.x.isfinite().all()) for frame in found)
    assert not bool(found[3].solution.converged)


def test_motions_of_another_rate_or_order_are_refused(scene, toy_model, toy_motion) -> None:
    made = LatentShots(toy_model(scene), CLOTH, LatentOptions(), precision="float64")
    with pytest.raises(SsilkError, match="the model steps at 30"):
        next(made.frames([toy_motion(scene, 3, fps=24.0)]))
    with pytest.raises(SsilkError, match="longest must come first"):
        next(made.frames([toy_motion(scene, 3), toy_motion(scene, 4)]))


@pytest.mark.parametrize("settings", [{"iterations": 0}, {"tolerance": -1.0}, {"damping": 0.0}])
def test_settings_that_make_no_sense_are_refused(settings) -> None:
    with pytest.raises(SsilkError, match="latent solver"):
        LatentOptions(**settings)


def test_the_network_steps_in_its_own_precision_and_sees_the_cloth(scene, toy_model, toy_body) -> None:
    model = toy_model(scene)
    static = model.initialiser[0].in_features
    pose = model.stepper[0].in_features - 3 * model.config.latent - 3 * model.feedback.count
    rest = model.initial(torch.zeros(1, static)).detach()
    steps, body, now = NetworkSteps(model), toy_body(scene, 3, 1), rest + 0.1
    pose = torch.zeros(1, pose)
    seen = steps.described(rest, pose)

    def step(body: BodyFrames) -> Tensor:
        course = tuple(steps.decoded(z.double(), body.matrices[at].double()) for at, z in enumerate((rest, now)))
        return steps.step(rest.double(), now.double(), course, seen, body[2:])

    found = step(body)
    assert found.dtype == torch.float64
    expected = model.roll([rest, now], rest[None], pose[None], body)[-1]
    torch.testing.assert_close(found, expected.double())
    held = step(BodyFrames(body.matrices[:1].expand(3, -1, -1, -1, -1), 0 * body.bend))
    assert (found - held).abs().max() > 1e-4
