# SPDX-License-Identifier: Apache-2.0
"""The parts of a training step in their order, with what each reads and does.

Those of a phase make its whole step; what is said to be alone is a share of another part, and belongs to none.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from ssilk_core.physics import kernels
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.training.muon import ITERATIONS

from .floors import WARM, WINDOWS, Part, Tensors
from .moment import Moment

# Operations for one element in one frame, counted on the formulas.
TURN, COMPOSE, BLEND, TRANSFORM, NORMALISE = 15, 108, 24, 18, 9
BRUTE_FORCE, TRIANGLE = 8, 60  # for each body vertex, for each triangle around the nearest one
STRETCH, BENDING, POINTWISE = 50, 75, 9  # for each triangle, hinge, vertex
ADAM = 20  # for each parameter


def all_parts(at: Moment) -> list[Part]:
    """Return the parts of a step, in order."""
    return [
        *input_parts(at),
        *network_parts(at),
        *garment_parts(at),
        *contact_parts(at),
        *energy_parts(at),
        *single_energy_parts(at),
        optimiser_part(at),
    ]


def leaf(value: Tensor) -> Tensor:
    """Return a copy that gets a gradient."""
    return value.detach().clone().requires_grad_()


def input_parts(at: Moment) -> list[Part]:
    static, turns = at.bank.static_descriptor, TURN * at.bank.down.shape[1]
    made, moved = static(at.frames, at.direction), (at.sampler.latents, at.sampler.direction)
    return [
        Part(name="poses drawn", run=lambda: at.sampler.poses(at.count), reads=(), phases=(WARM,)),
        Part(name="windows and poses drawn", run=at.sample, reads=moved, phases=(WINDOWS,)),
        Part(name="descriptors of poses", run=lambda: static(at.frames, at.direction), reads=(made,),
             operations=turns * at.count, phases=(WARM,)),
        Part(name="descriptors of windows and poses", run=at.descriptors, reads=(at.static, at.pose, at.quiet),
             operations=turns * (len(at.times) + len(at.single)), phases=(WINDOWS,)),
        Part(name="character matrices", run=lambda: at.bank.character(at.frames), reads=(at.character,)),
    ]  # fmt: skip


def through(name: str, network: nn.Module, run: Callable[[], Tensor | Tensors], reads: Tensors,
            leaves: Tensors = (), phases: tuple[str, ...] = (WARM, WINDOWS), passes: int = 1) -> Part:  # fmt: skip
    """Return a part that passes rows through a network: two operations for each row and weight, in each pass."""
    weights = tuple(network.parameters())
    operations = 2 * passes * len(reads[0]) * sum(weight.numel() for weight in weights)
    return Part(name=name, run=run, reads=(*weights, *reads), operations=operations, leaves=leaves, phases=phases)


def network_parts(at: Moment) -> list[Part]:
    model, batch, first, z = at.model, at.batch, 2 * at.batch, leaf(at.z)
    before, now, rest = at.target[:-first], at.target[batch:-batch], at.target[first:]
    poses, pose = at.bank.static_descriptor(at.frames, at.direction), at.pose[first:]
    passes = 2 - model.integrator.scheme.bias  # SpringVerlet subtracts what S gives at rest
    seen, initial = at.seen(), tuple(model.initialiser.parameters())
    stepping = (*model.stepper.parameters(), *model.integrator.parameters())
    return [
        through("initialiser P", model.initialiser, lambda: model.initial(poses), (poses,), initial, (WARM,)),
        through("initialiser P of targets", model.initialiser, at.targets, (at.static,), (), (WINDOWS,)),
        through("initialiser P of single poses", model.initialiser, lambda: model.initial(at.quiet), (at.quiet,),
                initial, (WINDOWS,)),
        through("stepper S frame by frame", model.stepper, at.rolled, (rest, pose), (), (WINDOWS,), passes),
        through("what S sees of the cloth", model.output, at.seen, (before, now), (), (WINDOWS,), 3),
        through("stepper S on all frames", model.stepper, lambda: model.step(before, now, rest, pose, seen),
                (before, now, rest, pose, seen), stepping, (WINDOWS,), passes),
        through("decoder D", model.output, lambda: model.output(z), (z,), (z, *model.output.parameters())),
    ]  # fmt: skip


def garment_parts(at: Moment) -> list[Part]:
    decoder, influences = at.decoder, at.model.scene.rig.skin.indices.shape[1]
    turns, activation = leaf(at.turns), leaf(at.activation)
    offsets, matrices = leaf(at.offsets), leaf(at.matrices)
    first = (at.target[: 2 * at.batch], decoder.shapes)
    return [
        Part(name="proxies", run=lambda: decoder.matrices(turns, at.character), leaves=(turns,),
             reads=(turns, at.character), operations=COMPOSE * len(turns) * at.count),
        Part(name="blendshapes", run=lambda: at.blendshapes(activation), leaves=(activation, decoder.shapes),
             reads=(activation, decoder.shapes), operations=2 * decoder.shapes.numel() * at.count),
        Part(name="skinning", run=lambda: at.skinned(offsets, matrices), reads=(offsets, matrices),
             leaves=(offsets, matrices, decoder.skin_offset),
             operations=(influences * BLEND + TRANSFORM) * len(offsets) * at.count),
        Part(name="first two frames decoded", run=at.decoded_first, reads=first, phases=(WINDOWS,),
             operations=2 * decoder.shapes.numel() * len(first[0])),
    ]  # fmt: skip


def contact_parts(at: Moment) -> list[Part]:
    body, x, posed = at.objective.body, at.x, at.body
    assert body is not None and posed.rings is not None
    influences = at.model.scene.character.bodies[0].skin.indices.shape[1]
    placing = (influences * BLEND + 2 * TRANSFORM + NORMALISE) * posed.points.shape[0] * at.count
    pairs = at.sampled.shape[0] * at.count
    search = BRUTE_FORCE * posed.points.shape[0] * pairs
    triangles = float(posed.rings[:, 0].float().mean()) - 1  # a ring's first neighbour spans none
    return [
        Part(name="body posing", run=at.surface, reads=(at.character, body.points, body.normals), operations=placing),
        Part(name="nearest body point", run=at.planes, reads=(at.sampled, posed.points, posed.normals),
             operations=search + TRIANGLE * triangles * pairs, captured=kernels.available(x.device)),
        Part(name="nearest body vertex alone", run=lambda: at.planes(surface=False), operations=search, phases=(),
             reads=(x, posed.points, posed.normals)),
    ]  # fmt: skip


def energy_parts(at: Moment) -> list[Part]:
    energy, x, root, gravity = at.objective.energy, leaf(at.x), at.character[0, :, 3], GRAVITY * at.direction.T
    moving = at.last.shape[-1]
    moved, shift = x.shape[0] * at.count, root[:, :moving]
    elastic = (STRETCH * len(energy.area) + BENDING * len(energy.rest_angle)) * at.count
    return [
        Part(name="stretch and bending", run=lambda: energy.elastic(x), reads=(x,), leaves=(x,), energy=True,
             operations=elastic),
        Part(name="gravity and collision",
             run=lambda: energy.gravity_and_collision(
                 x, root, gravity, energy.cloth.positions(x), at.normal, at.offset),
             reads=(x, at.sampled, at.normal, at.offset), leaves=(x,), energy=True,
             operations=2 * POINTWISE * (moved + at.sampled.shape[0] * at.count)),
        Part(name="positions before", run=at.path, reads=(at.first, at.last), phases=(WINDOWS,)),
        Part(name="inertia and drag",
             run=lambda: energy.inertia_and_drag(x, at.last, at.before, shift, at.objective.dt),
             reads=(at.x[..., :moving], at.last, at.before), leaves=(x,), energy=True,
             operations=2 * POINTWISE * x.shape[0] * moving, phases=(WINDOWS,)),
    ]  # fmt: skip


def single_energy_parts(at: Moment) -> list[Part]:
    energy, x, dt, gravity = at.objective.energy, leaf(at.x), at.objective.dt, GRAVITY * at.direction.T
    moving, predicted, cloth = leaf(at.x[..., : at.last.shape[-1]]), 2 * at.last - at.before, POINTWISE * x.shape[0]

    def term(name: str, run: Callable[[], Tensor], operations: int, moved: Tensor, *reads: Tensor) -> Part:
        return Part(name=f"{name} alone", run=run, reads=(moved, *reads), leaves=(moved,), energy=True,
                    operations=operations * moved.shape[-1], phases=())  # fmt: skip

    return [
        term("stretch", lambda: energy.stretch(x), STRETCH * len(energy.area), x),
        term("bending", lambda: energy.bending(x), BENDING * len(energy.rest_angle), x),
        term("gravity", lambda: energy.gravity(x, gravity), cloth, x),
        term("collision", lambda: energy.collision_at(
            (at.normal * energy.cloth.positions(x)).sum(1) - at.offset), cloth, x, at.sampled, at.normal, at.offset),
        term("inertia", lambda: energy.inertia(moving, predicted, dt), cloth, moving, predicted),
        term("drag", lambda: energy.drag(moving, at.last, dt), cloth, moving, at.last),
    ]  # fmt: skip


def optimiser_part(at: Moment) -> Part:
    """Gradients are read for their norm, then with parameters, moments and average; all but gradients are written.

    Matrices that Muon steps have one moment, the others two; the difference is small.
    """
    parameters = tuple(at.model.parameters())
    muon = at.stepper.optimisers.get("muon")
    matrices = [value for group in muon.param_groups for value in group["params"]] if muon else []
    count = sum(value.numel() for value in parameters) - sum(value.numel() for value in matrices)
    operations = ADAM * count + sum(muon_operations(*matrix.shape) for matrix in matrices)
    update = at.update()
    return Part(name="optimiser", run=lambda: 4 * update(), reads=6 * parameters, operations=operations)


def muon_operations(rows: int, columns: int) -> int:
    """Return the operations of the products of one of Muon's steps of a matrix (`training.muon`)."""
    least, most = sorted((rows, columns))
    return ITERATIONS * (4 * least**2 * most + 2 * least**3)
