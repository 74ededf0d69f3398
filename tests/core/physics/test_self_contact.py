# SPDX-License-Identifier: Apache-2.0
"""Contact of cloth with cloth: pairs, sides and forces against slow references, and folds that stay apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.captured import Captured
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.intersections.pairs import self_intersections
from ssilk_core.physics.kernels import conjugate_gradient
from ssilk_core.physics.kernels.conjugate_gradient import solve_kernel
from ssilk_core.physics.kernels.separations import separations_kernel
from ssilk_core.physics.kernels.slopes import SlopeTable
from ssilk_core.physics.self_contact import ClothContacts, ClothNeighbours, SelfContact, TouchingCloth
from ssilk_core.physics.self_contact.neighbours import near_pairs
from ssilk_core.physics.self_contact.pairs import Separations, between_edges, over_faces
from ssilk_core.physics.self_contact.self_contact import KnownPairs
from ssilk_core.physics.simulate import SimulationOptions, Simulator
from ssilk_core.physics.simulate.blocks import BlockMatrix, BlockPattern
from ssilk_core.physics.simulate.conjugate_gradient import CHECK_EVERY, inverse_blocks
from ssilk_core.physics.simulate.contact_stiffness import ContactStiffness
from ssilk_core.physics.simulate.friction import Friction
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import Search, SolverOptions, minimise_from, newton_step
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    Body,
    Character,
    Garment,
    Mesh,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import local_transforms, quaternion_from_matrix

CPU = torch.device("cpu")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")  # on a CPU kernels run in an interpreter
FABRIC = Fabric("plain")
START = FABRIC.thickness + 0.5 * FABRIC.margin  # [m] at which cloth begins to touch cloth


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def dressed(scene: Scene, points: np.ndarray, faces: np.ndarray, pinned: np.ndarray) -> Scene:
    skin = SkinWeights("/cloth", np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    garment = Garment(Mesh("/cloth", points, faces), skin, np.where(pinned, PINNED, LOOSE))
    return replace(
        scene, garment=garment, rig=ProxyRig("/cloth", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    )


def frames(points: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.array(points))[:, :, None]


@pytest.fixture
def layers(scene) -> tuple[Scene, SelfContact]:
    """Two sheets of one triangle each, 30 cm apart in the bind pose."""
    sheet = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]])
    points = np.concatenate([sheet, sheet + [0.0, 0.3, 0.0]])
    worn = dressed(scene, points, np.array([[0, 1, 2], [3, 4, 5]]), np.zeros(6, dtype=bool))
    return worn, SelfContact(TouchingCloth.of(worn, FABRIC), CPU, torch.float64)


def stacked(height: float) -> torch.Tensor:
    """The second sheet over the first, turned and moved so that one corner is over its inside, and edges cross."""
    first = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]])
    second = np.array([[0.03, height, 0.03], [0.13, height + 0.06, 0.05], [0.05, height + 0.06, 0.13]])
    return frames(np.concatenate([first, second]))


def test_near_pairs_are_those_of_all_distances():
    points, others = random(40, 3, 3), random(60, 3, 3, seed=1)
    reach, other_reach = 0.2 * random(40, seed=2), 0.2 * random(60, seed=3)
    far = (points[:, None] - others[None]).square().sum(2).sqrt()
    expected = (far <= (reach[:, None] + other_reach)[..., None]).permute(2, 0, 1).nonzero().T
    assert len(expected[0]) > 50
    assert torch.equal(near_pairs(points, reach, others, other_reach), expected)
    groups = torch.arange(40) % 3, torch.arange(60) % 3
    kept = expected[:, (groups[0][expected[1]] != groups[1][expected[2]]) & (expected[1] < expected[2])]
    found = near_pairs(points, reach, others, other_reach, groups=groups, ascending=True)
    assert 10 < len(kept[0]) < len(expected[0]) and torch.equal(found, kept)


@pytest.mark.parametrize("name", ["_faces", "_edges"])
def test_kernels_find_the_near_pairs_that_the_reference_finds(scene, toy_grid, monkeypatch, name):
    monkeypatch.setattr("ssilk_core.physics.self_contact.self_contact.loops.available", lambda device: False)

    def found(device: torch.device, halves: bool) -> list[torch.Tensor]:
        contact, x, _ = crumpled(toy_grid, scene, 2, device, (4, 3))
        x = (0.4 * x + 0.004 * random(*x.shape, seed=2)).to(device)
        half = (torch.arange(len(x), device=device) < 6).long() if halves else None
        pairs = getattr(contact, name).near(x, contact.reach, half)
        order = ((pairs.frame * 10**4 + pairs.first) * 10**4 + pairs.second).argsort()
        assert (pairs.frame.diff() >= 0).all()
        return [getattr(pairs, each.name)[order].cpu() for each in fields(pairs)]

    expected = [found(CPU, halves) for halves in (False, True)]
    monkeypatch.setattr("ssilk_core.physics.kernels.available", lambda device: True)
    by_kernel = [found(DEVICE, halves) for halves in (False, True)]
    assert len(expected[0][0]) > len(expected[1][0]) > 10
    for own, other in zip(by_kernel, expected):
        for mine, theirs in zip(own, other, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["_faces", "_edges"])
def test_compiled_loops_find_the_pairs_that_the_reference_finds(scene, toy_grid, monkeypatch, name):
    contact, x, _ = crumpled(toy_grid, scene, 3)
    kind, x = getattr(contact, name), 0.4 * x + 0.004 * random(*x.shape, seed=2)
    step, moved = 0.02 * (random(*x.shape, seed=3) - 0.5), torch.full_like(x[:, 0], 0.004)
    half = (torch.arange(len(x)) < len(x) // 2).long()

    def found() -> list[torch.Tensor]:
        pairs = kind.near(x, contact.reach)
        others = kind.near(x, contact.reach, half)
        nearer = x + 0.004 * torch.nn.functional.normalize(random(*x.shape, seed=4) - 0.5, dim=1)
        rows = [kind.close(nearer, pairs, moved, START, ahead) for ahead in (None, step)]
        return [pairs.frame, pairs.first, pairs.second, pairs.distance, others.first, others.second, *rows]

    compiled = found()
    monkeypatch.setattr("ssilk_core.physics.self_contact.self_contact.loops.available", lambda device: False)
    expected = found()
    lengths = [len(each) for each in expected]
    assert lengths[0] > lengths[4] > 10 and lengths[0] > lengths[7] > lengths[6] > 10
    order = (compiled[0] * 10**4 + compiled[1]) * 10**4 + compiled[2]
    by_key = order.argsort()
    compiled[:4] = [each[by_key] for each in compiled[:4]]
    places = by_key.argsort()
    compiled[6:] = [places[rows].sort()[0] for rows in compiled[6:]]
    assert {*zip(*(each.tolist() for each in compiled[4:6]))} == {*zip(*(each.tolist() for each in expected[4:6]))}
    for own, other in zip([*compiled[:4], *compiled[6:]], [*expected[:4], *expected[6:]]):
        torch.testing.assert_close(own, other, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["_faces", "_edges"])
def test_kernels_find_what_the_reference_finds(scene, toy_grid, monkeypatch, name):
    contact, x, _ = crumpled(toy_grid, scene, 3)
    kind, x = getattr(contact, name), 0.4 * x + 0.004 * random(*x.shape, seed=2)
    monkeypatch.setattr("ssilk_core.physics.self_contact.self_contact.loops.available", lambda device: False)
    pairs = kind.near(x, contact.reach)
    own = [each.to(DEVICE) for each in (kind.first, kind.second, pairs.frame, pairs.first, pairs.second)]
    for places in (x, x[..., :1]):
        (expected,) = kind.at([places], pairs)
        found = Separations(*separations_kernel(places.to(DEVICE), *own))
        assert expected.facing.any() and not expected.facing.all()
        for field in fields(Separations):
            value = getattr(found, field.name).cpu()
            torch.testing.assert_close(value, getattr(expected, field.name), rtol=0, atol=1e-11, msg=field.name)


def on_device(known: ClothNeighbours, device: torch.device) -> ClothNeighbours:
    faces, edges = (
        KnownPairs(*(getattr(pairs, each.name).to(device) for each in fields(pairs)))
        for pairs in (known.faces, known.edges)
    )
    return ClothNeighbours(known.last.to(device), known.at.to(device), faces, edges)


def two_kinds(
    toy_grid, scene, count: int, device: torch.device = CPU, size: tuple[int, int] = (3, 3)
) -> tuple[SelfContact, torch.Tensor]:
    """Two crumpled sheets, of which one lies over the other and is thicker, stiffer and tight in part."""
    points, faces = toy_grid(*size, height=0.05 * (size[0] - 1), width=0.05 * (size[1] - 1))
    one = TouchingCloth.of(dressed(scene, points, faces, np.zeros(len(points), dtype=bool)), FABRIC)
    other = replace(one, points=points + [0, 0, 0.012], start=1.5 * one.start, stiffness=3 * one.stiffness,
                    loose=np.arange(len(points)) % 2 == 0, pinned=np.arange(len(points)) % 4 == 1)  # fmt: skip
    _, x, _ = crumpled(toy_grid, scene, count, device, size)
    x = torch.cat([x, x + torch.tensor([[0.001], [0.002], [0.004]])])
    return SelfContact(TouchingCloth.joined([one, other]), device, torch.float64), x


@pytest.mark.parametrize("several", [False, True])
def test_kernels_find_the_contacts_that_the_reference_finds(scene, toy_grid, monkeypatch, several):
    def cloth(device: torch.device = CPU) -> tuple[SelfContact, torch.Tensor]:
        return two_kinds(toy_grid, scene, 2, device) if several else crumpled(toy_grid, scene, 2, device, (5, 3))[:2]

    contact, x = cloth()
    monkeypatch.setattr("ssilk_core.physics.self_contact.self_contact.loops.available", lambda device: False)
    x = 0.4 * x + 0.004 * random(*x.shape, seed=2)
    known = contact.neighbours(x, x)
    _, before = contact.moved(x + 1e-3 * random(*x.shape, seed=5), known)
    step = 0.02 * (random(*x.shape, seed=3) - 0.5)
    tried = x + 6e-3 * torch.nn.functional.normalize(random(*x.shape, seed=4) - 0.5, dim=1)

    def found(device: torch.device) -> list[torch.Tensor]:
        own = cloth(device)[0]
        around = on_device(known, device)
        there, pressed = own.moved(tried.to(device), around)
        others = own.contacts((0.3 * x + 0.7 * tried).to(device), there)
        ahead = own._touching(there, there.last, 0 * there.last[:, 0], START, step=step.to(device))[1]
        rows = []
        for each in (pressed, others, ahead):
            at, towards = tried.to(device), step.to(device)
            rows += [each.frame, each.vertices, each.coefficients, each.second, each.direction, each.start, each.area]
            rows += [each.slack, each.energy(at), each.gradient(at), each.slopes(at).values, each.along(towards)]
            rows += [each.allowed(at, towards), each.without_passing(at, towards, 1e-3)]
        return [value.cpu() for value in [there.faces.side, there.edges.side, *rows]]

    expected = found(CPU)
    monkeypatch.setattr("ssilk_core.physics.kernels.available", lambda device: True)
    by_kernel = found(DEVICE)
    assert len(before.frame) > 50 and all(len(expected[n]) > 50 for n in (2, 16, 30))
    assert expected[0].any() and expected[1].any() and (expected[14] < 1).any()
    for own, other in zip(by_kernel, expected, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["_faces", "_edges"])
def test_close_pairs_are_all_that_are_close_or_meet(scene, toy_grid, name):
    contact, x, _ = crumpled(toy_grid, scene, 2)
    kind, x, step = getattr(contact, name), 0.4 * x, 0.01 * (random(*x.shape, seed=3) - 0.5)
    pairs, moved = kind.near(x, contact.reach), 0.002 * random(*x.shape, seed=4)
    (now,) = kind.at([x + moved], pairs)
    close = torch.zeros(len(now.distance), dtype=torch.bool)
    close[kind.close(x + moved, pairs, moved.norm(dim=1), START, step)] = True
    along = (now.direction * step[kind.vertices(pairs), :, pairs.frame].movedim(-1, 1)).sum(1)
    count = kind.first.shape[1]
    meets = along[count:].amax(0) - along[:count].amin(0) > 0.8 * now.distance
    assert meets.any() and not close.all()
    assert close[meets | (now.distance < START)].all()


@pytest.mark.parametrize("shape", [over_faces, between_edges])
def test_distances_are_those_of_many_points(shape):
    corners = random(4, 3, 300, seed=4)
    share = torch.linspace(0, 1, 101, dtype=torch.float64)
    a, b, c, d = corners[..., None]
    if shape is over_faces:
        v, w = (part.flatten() for part in torch.meshgrid(share, share, indexing="ij"))
        v, w = v[v + w <= 1], w[v + w <= 1]
        far = (a - (b + v * (c - b) + w * (d - b))).norm(dim=0)
    else:
        one, other = a + share * (b - a), c + share * (d - c)
        far = (one[..., None] - other[..., None, :]).norm(dim=0).flatten(1)
    found = shape(corners)
    assert ((found.distance - far.amin(1)).abs() < 0.02).all()
    assert (found.distance <= far.amin(1) + 1e-12).all()
    assert found.facing.any() and not found.facing.all()
    torch.testing.assert_close(found.height.abs()[found.facing], found.distance[found.facing])


@pytest.mark.parametrize("shape", [over_faces, between_edges])
def test_directions_are_the_slopes_of_distances(shape):
    corners = random(4, 3, 200, seed=5).requires_grad_()
    (slope,) = torch.autograd.grad(shape(corners).distance.sum(), corners)
    found = shape(corners.detach())
    _, direction = found.gaps(torch.zeros(200, dtype=torch.float64))
    torch.testing.assert_close(found.coefficients[:, None] * direction, slope, rtol=0, atol=1e-10)


def test_a_vertex_over_a_face_has_the_energy_of_the_law(layers):
    worn, contact = layers
    height = 0.003
    x = stacked(height)
    touching = contact.contacts(x, contact.neighbours(x, x))
    own = (touching.gap(x) - height).abs() < 1e-12
    area = 0.5 * worn.garment.mesh.points[1, 0] ** 2 / 2 / 3  # half of a vertex's third of its triangle
    law = ContactLaw(FABRIC.loose_contact, START, 0.5 * FABRIC.margin)
    depth = START - height
    expected = area * law.stiffness * depth**3 / (6 * law.ramp)
    assert own.sum() == 1
    assert touching.energy(x).item() == pytest.approx(expected, rel=1e-9)


def test_forces_are_minus_the_slope_of_the_energy(layers):
    _, contact = layers
    x = stacked(0.002) + 1e-4 * random(6, 3, 1, seed=6)
    known = contact.neighbours(x, x)
    gradient = contact.contacts(x, known).gradient(x)
    step = 1e-7
    for vertex, axis in np.ndindex(6, 3):
        moved = torch.zeros_like(x)
        moved[vertex, axis] = step
        more, less = (contact.contacts(x + sign * moved, known).energy(x + sign * moved) for sign in (1, -1))
        slope = float(more - less) / (2 * step)
        assert gradient[vertex, axis].item() == pytest.approx(slope, rel=1e-4, abs=1e-9)
    assert gradient.abs().max() > 1e-4
    assert gradient.sum(0).abs().max() < 1e-12  # it moves nothing as a whole


def test_what_has_passed_through_is_pushed_back(layers):
    _, contact = layers
    before, after = stacked(0.004), stacked(-0.002)
    sided = contact.contacts(after, contact.neighbours(before, after))
    assert sided.gap(after).min().item() == pytest.approx(-0.002)
    assert sided.gradient(after)[3, 1, 0] < 0  # the force on the corner points up, to where it came from
    fresh = contact.contacts(after, contact.neighbours(after, after))
    assert fresh.gap(after).min() > 0 and fresh.gradient(after)[3, 1, 0] > 0


def test_a_side_is_kept_for_later_steps_but_not_far_inside(layers):
    _, contact = layers
    known = contact.neighbours(stacked(0.004), stacked(-0.002))
    x = stacked(-0.003)
    assert contact.moved(x, known)[1].gap(x).min().item() == pytest.approx(-0.003)
    deep, nearer = stacked(-START - 0.002), stacked(-START + 0.001)
    there, touching = contact.moved(deep, known)
    assert not len(touching.frame)
    assert contact.contacts(nearer, there).gap(nearer).min().item() == pytest.approx(START - 0.001)


def test_sides_are_found_again_whatever_the_order_of_pairs(scene, toy_grid):
    contact, x, _ = crumpled(toy_grid, scene, 2)
    pairs = contact.neighbours(x, x).edges
    side = random(len(pairs.frame), seed=3).mul(8).floor().sub(1).clamp_max(1) * (random(len(pairs.frame)) < 0.1)
    order, other = random(len(side), seed=4).argsort(), random(len(side), seed=5).argsort()[: len(side) // 2]
    assert {*side.tolist()} == {-1, 0, 1}
    assert torch.equal(replace(pairs, side=side).kept(order).sides_of(pairs.kept(other)), side[other])


def test_pinned_and_tight_cloth_does_not_touch_itself(layers):
    worn, _ = layers
    held = dressed(worn, worn.garment.mesh.points, worn.garment.mesh.faces, np.ones(6, dtype=bool))
    contact = SelfContact(TouchingCloth.of(held, FABRIC), CPU, torch.float64)
    x = stacked(0.003)
    assert not len(contact.contacts(x, contact.neighbours(x, x)).frame)


def crumpled(
    toy_grid, scene, count: int, device: torch.device = CPU, size: tuple[int, int] = (9, 4)
) -> tuple[SelfContact, torch.Tensor, np.ndarray]:
    """A sheet in zigzag folds 8 mm apart, in frames that are folded more or less."""
    points, faces = toy_grid(*size, height=0.05 * (size[0] - 1), width=0.05 * (size[1] - 1))
    worn = dressed(scene, points, faces, np.zeros(len(points), dtype=bool))
    rows = np.round(-points[:, 1] / 0.05).astype(int)
    found = []
    for n in range(count):
        folded = points.copy()
        folded[:, 1], folded[:, 2] = -0.008 * (1 + 0.1 * n) * rows, np.where(rows % 2, 0.049, 0.0)
        found.append(folded)
    return (
        SelfContact(TouchingCloth.of(worn, FABRIC), device, torch.float64),
        torch.as_tensor(np.stack(found, axis=-1)),
        faces,
    )


def test_no_step_passes_through_folds(scene, toy_grid):
    contact, x, faces = crumpled(toy_grid, scene, 3)
    known, crossed = contact.neighbours(x, x), 0
    for seed in range(8):
        step = 0.04 * (random(*x.shape, seed=seed) - 0.5)
        held = x + kept_apart(contact, step, known)
        for n in range(3):
            crossed += len(self_intersections((x + step)[..., n].numpy(), faces))
            assert not len(self_intersections(held[..., n].numpy(), faces))
        assert (held - x).abs().max() > 1e-4
    assert crossed > 50
    alike = torch.full_like(x, 0.004)  # what all move alike is not slowed
    torch.testing.assert_close(kept_apart(contact, alike, known), alike)


def kept_apart(contact: SelfContact, step: torch.Tensor, known: ClothNeighbours) -> torch.Tensor:
    """A step from the last positions, in which no cloth passes through cloth."""
    known, step, met = contact.ahead(step, known)
    return met.without_passing(known.last, step)


def test_layers_that_are_not_known_to_be_near_do_not_meet_in_a_step(layers):
    _, contact = layers
    x = stacked(contact.reach + 1e-3)
    x[4:, 1] += 0.1
    known = contact.neighbours(x, x)
    step = torch.zeros_like(x)
    step[:3, 1], step[3:, 1] = 0.05, -0.03
    _, cut, _ = contact.ahead(step, known)
    assert 0 < float(cut[0, 1] / step[0, 1]) < 1
    torch.testing.assert_close(cut, cut[0, 1] / step[0, 1] * step)  # as a whole, so that nothing stretches
    held = kept_apart(contact, step, known)
    assert not len(known.faces.frame) and not len(known.edges.frame)
    assert 1e-3 < float((held[0] - held[3])[1, 0]) < contact.reach


def test_a_garment_goes_its_way_alike_beside_others(scene, toy_grid):
    points, faces = toy_grid(9, 4, height=0.4, width=0.15)
    potential = IncrementalPotential(
        dressed(scene, points, faces, np.zeros(len(points), dtype=bool)), FABRIC, device=CPU
    )
    _, x, _ = crumpled(toy_grid, scene, 2)
    target = x + torch.tensor([0.002, 0.03], dtype=torch.float64) * (random(*x.shape[:2], 1, seed=3) - 0.5)
    inputs = StepInputs(None, torch.zeros(3, 2, dtype=torch.float64))
    together, _ = potential.approach(x, target, inputs, None)
    for n in range(2):
        alone, _ = potential.approach(
            x[..., n : n + 1], target[..., n : n + 1], inputs.select(torch.tensor([n])), None
        )
        torch.testing.assert_close(together[..., n : n + 1], alone, rtol=0, atol=1e-12)


def test_a_garment_turns_with_what_is_pinned(scene, toy_grid):
    points, faces = toy_grid(9, 4, height=0.4, width=0.15)
    pinned = points[:, 1] > -1e-9
    potential = IncrementalPotential(dressed(scene, points, faces, pinned), FABRIC, device=CPU)
    _, x, _ = crumpled(toy_grid, scene, 2)
    turned = torch.stack([frame @ _about_z(angle).T for frame, angle in zip(x.unbind(-1), (0.7, 2.5))], dim=-1)
    still = StepInputs(None, torch.zeros(3, 2, dtype=torch.float64))
    arrived, _ = potential.approach(x, turned, still, None)
    torch.testing.assert_close(arrived, turned, rtol=0, atol=1e-9)
    stays = torch.where(torch.as_tensor(pinned)[:, None, None], turned, x)  # the rest would stay where it was
    held, inputs = potential.approach(x, stays, still, None)
    assert (held - turned)[pinned].norm(dim=1).max() < 5e-3
    _, _, met = potential.self_contact.ahead(0.02 * (random(*held.shape) - 0.5), inputs.neighbours)
    assert met.gap(held).min() > 0


def _about_z(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


def test_frames_are_independent(scene, toy_grid):
    contact, x, _ = crumpled(toy_grid, scene, 3)
    x = x + 0.002 * random(*x.shape, seed=9)
    known = contact.neighbours(x, x)
    whole = contact.contacts(x, known)
    for frames_of in (
        whole.select(torch.tensor([0, 2])),
        contact.contacts(x[..., [0, 2]], known.select(torch.tensor([0, 2]))),
    ):
        torch.testing.assert_close(frames_of.energy(x[..., [0, 2]]), whole.energy(x)[[0, 2]])
    parts = [(torch.tensor(rows), known.select(torch.tensor(rows))) for rows in ([0, 2], [1])]
    joined = known.joined([parts[1], parts[0]])
    for kind in ("faces", "edges"):
        for name in ("frame", "first", "second", "distance", "side"):
            assert torch.equal(getattr(getattr(joined, kind), name), getattr(getattr(known, kind), name))
    assert torch.equal(joined.at, known.at)


def random_contacts(vertices: int, count: int, frames_of: int) -> ClothContacts:
    """Contacts between random vertices, all pressed."""
    corners = torch.rand(vertices, count, generator=torch.Generator().manual_seed(3)).argsort(0)[:4]
    direction = torch.nn.functional.normalize(random(3, count, seed=1) - 0.5, dim=0)
    w = random(3, count, seed=2)
    coefficients = torch.cat([torch.ones(1, count, dtype=torch.float64), -w / w.sum(0)])
    frame = (frames_of * random(count, seed=4)).long().sort()[0]
    law = ContactLaw(1e5, 5.0, 4e-3)
    second = torch.tensor([[False], [True], [True], [True]]).expand(4, count)
    start, area = torch.full((count,), 5.0, dtype=torch.float64), 1e-4 * random(count, seed=5)
    rows = frame, corners, coefficients, second, direction, start, area, torch.zeros_like(start)
    return ClothContacts(law, frames_of, *rows)


@pytest.mark.parametrize("frames_of", [1, 3])
def test_stiffness_is_that_of_dense_algebra(frames_of):
    contacts, vertices = random_contacts(12, 20, frames_of), 12
    x = random(vertices, 3, frames_of, seed=7)
    free = np.array([0, 1, 2, 4, 5, 7, 8, 9, 11])
    place = torch.full((vertices,), -1)
    place[free] = torch.arange(len(free))
    found = ContactStiffness.of(contacts.slopes(x), frames_of, place, len(free))
    for n in range(frames_of):
        dense = torch.zeros(3 * vertices, 3 * vertices, dtype=torch.float64)
        for p in torch.nonzero(contacts.frame == n)[:, 0].tolist():
            row = torch.zeros(vertices, 3, dtype=torch.float64)
            for i in range(4):
                row[contacts.vertices[i, p]] += contacts.coefficients[i, p] * contacts.direction[:, p]
            dense += contacts.stiffness(x)[p] * torch.outer(row.flatten(), row.flatten())
        kept = (3 * torch.as_tensor(free)[:, None] + torch.arange(3)).flatten()
        dense = dense[kept][:, kept]
        vectors, image = random(len(free), 3, frames_of, seed=8).float(), torch.zeros(len(free), 3, frames_of)
        found.add_product(vectors, image)
        expected = (dense @ vectors[..., n].double().flatten()).view(-1, 3)
        torch.testing.assert_close(image[..., n].double(), expected, rtol=1e-4, atol=1e-4)
        for u in range(len(free)):
            block = dense[3 * u : 3 * u + 3, 3 * u : 3 * u + 3]
            torch.testing.assert_close(found.diagonal[u, ..., n].double(), block, rtol=1e-4, atol=1e-4)


def test_the_kernel_solves_with_contacts_as_dense_algebra_does(monkeypatch):
    vertices, frames_of = 12, 3
    pattern = BlockPattern(np.zeros((0, 2), dtype=int), np.arange(vertices), vertices, CPU)
    blocks = 3.0 * torch.eye(3)[:, :, None].repeat(vertices, 1, 1, frames_of)
    x, place = random(vertices, 3, frames_of, seed=7), torch.arange(vertices)
    contacts = ContactStiffness.of(random_contacts(vertices, 20, frames_of).slopes(x), frames_of, place, vertices)
    matrix = BlockMatrix(pattern, blocks, contacts)
    right = random(vertices, 3, frames_of, seed=9).float()
    inverse = inverse_blocks((blocks + contacts.diagonal).permute(3, 0, 1, 2).contiguous()).permute(1, 2, 3, 0)
    table = BlockPattern(np.zeros((0, 2), dtype=int), np.arange(vertices), vertices, DEVICE).table
    there = [each.to(DEVICE) for each in (contacts.vertices, contacts.frame, contacts.values)]
    slopes = SlopeTable.of(*there, vertices, frames_of)
    torch.testing.assert_close(slopes.diagonal().cpu(), contacts.diagonal)
    given = blocks.to(DEVICE), table, inverse.to(DEVICE), right.to(DEVICE)
    by_kernel, _ = solve_kernel(*given, 1e-6, 96, CHECK_EVERY, slopes)
    monkeypatch.setattr("ssilk_core.physics.kernels.available", lambda device: False)
    found, _ = matrix.solve(right, 1e-6, 96)
    size = 3 * vertices * frames_of
    rows, columns = contacts.matrices
    stiffness = columns.to_dense().double() @ rows.to_dense().double()
    dense = 3 * torch.eye(size, dtype=torch.float64) + stiffness
    expected = torch.linalg.solve(dense, right.double().flatten()).view_as(right).float()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(by_kernel.cpu(), expected, rtol=1e-3, atol=1e-5)


def test_graphs_of_solves_have_room_for_contacts_and_share_memory(monkeypatch):
    def as_a_graph(work: Callable[[], object], device: torch.device) -> SimpleNamespace:
        work()
        return SimpleNamespace(replay=work)

    monkeypatch.setattr(conjugate_gradient, "replays", lambda right: True)
    monkeypatch.setattr(conjugate_gradient, "captured", as_a_graph)
    monkeypatch.setattr(conjugate_gradient, "LEAST_SLOPES", 8)
    vertices = 12
    table = BlockPattern(np.zeros((0, 2), dtype=int), np.arange(vertices), vertices, DEVICE).table
    for count, frames_of in ((20, 3), (17, 2), (0, 3)):
        blocks = 3.0 * torch.eye(3)[:, :, None].repeat(vertices, 1, 1, frames_of)
        right, x = random(vertices, 3, frames_of, seed=9).float(), random(vertices, 3, frames_of, seed=7)
        slopes = random_contacts(vertices, count, frames_of).slopes(x)
        found = ContactStiffness.of(slopes, frames_of, torch.arange(vertices), vertices)
        rows = (each.to(DEVICE) for each in (found.vertices, found.frame, found.values))
        own = SlopeTable.of(*rows, vertices, frames_of) if count else None
        inverse = inverse_blocks((blocks + found.diagonal).permute(3, 0, 1, 2).contiguous()).permute(1, 2, 3, 0)
        given = blocks.to(DEVICE), table, inverse.to(DEVICE), right.to(DEVICE)
        solved, _ = solve_kernel(*given, 1e-3, 8, 8, own)
        image = 3 * solved.cpu()
        found.add_product(solved.cpu(), image)
        assert (image - right).norm() < 1e-2 * right.norm()
    assert [key[1] for key in table.captured] == [32, 0]
    assert len({each._own.blocks.data_ptr() for each in table.captured.values()}) == 1


def twisted(
    potential: IncrementalPotential, points: np.ndarray, pinned: np.ndarray, apart: bool, count: int = 10
) -> list[np.ndarray]:
    """A sheet whose upper edge turns by 40 degrees in each frame and shrinks, so that it becomes a rope."""
    down = torch.tensor([[0.0], [-9.81], [0.0]], dtype=torch.float64)
    pins = torch.as_tensor(np.flatnonzero(pinned))
    x = frames(points) + 1e-3 * (random(*points.shape, 1) - 0.5) * frames(~pinned[:, None])
    before, known, found = x, None, []
    for frame in range(count):
        angle, width = np.deg2rad(40 * (frame + 1)), 1 - 0.6 * min(1, (frame + 1) / 8)
        edge = points[pinned][:, :1] * width * np.array([np.cos(angle), 0, np.sin(angle)])
        inputs = StepInputs(None, down, 2 * x - before, x, 1 / 30)
        start = (2 * x - before).index_copy(0, pins, frames(edge))
        if apart:
            start, inputs = potential.approach(x, start, inputs, known)
            start = start.index_copy(0, pins, frames(edge))
        solution = minimise_from(potential, start, inputs, SolverOptions())
        before, x, known = x, solution.x, solution.neighbours
        found.append(x[..., 0].numpy())
    return found


@pytest.mark.slow
def test_a_sheet_that_is_twisted_to_a_rope_stays_apart(scene, toy_grid):
    points, faces = toy_grid(8, 8, height=0.5, width=0.5)
    pinned = points[:, 1] > -1e-9
    potential = IncrementalPotential(dressed(scene, points, faces, pinned), FABRIC, device=CPU)
    through = [len(self_intersections(x, faces)) for x in twisted(potential, points, pinned, apart=False)]
    apart = [len(self_intersections(x, faces)) for x in twisted(potential, points, pinned, apart=True)]
    assert sum(through) > 10
    assert apart == [0] * 10


def test_what_touches_is_added_to_what_a_graph_gives(scene, toy_grid, monkeypatch):
    points, faces = toy_grid(9, 4, height=0.4, width=0.15)
    potential = IncrementalPotential(
        dressed(scene, points, faces, points[:, 1] > -1e-9), replace(FABRIC, friction=0.3), device=CPU
    )
    _, x, _ = crumpled(toy_grid, scene, 2)
    x = 0.4 * x + 0.004 * random(*x.shape, seed=2)
    known = potential.self_contact.neighbours(x, x)
    friction = Friction.of_contacts(potential.self_contact.contacts(x, known), x, 0.3, 1 / 30)
    still = torch.zeros(3, 2, dtype=torch.float64)
    inputs = StepInputs(None, still, x, x, 1 / 30, neighbours=known, friction=friction)

    def found() -> list[torch.Tensor]:
        search = Search(potential, x + 1e-4 * random(*x.shape, seed=5), inputs, SolverOptions())
        step, _ = newton_step(potential, search.state, search.inputs, search.gradient, 50)
        return [search.state.energy, search.gradient, step]

    expected = found()
    monkeypatch.setattr(potential, "replays", lambda x, inputs: inputs.is_plain)
    monkeypatch.setattr(Captured, "__call__", lambda self, *given: self._function(*given))
    for own, other in zip(found(), expected):
        torch.testing.assert_close(own, other)
    assert len(potential.self_contact.contacts(x, known).frame) > 10 and expected[1].abs().max() > 1e-3


def test_pairs_are_looked_for_once_at_the_same_positions(scene, toy_grid, monkeypatch):
    points, faces = toy_grid(8, 8, height=0.5, width=0.5)
    pinned = points[:, 1] > -1e-9
    potential = IncrementalPotential(dressed(scene, points, faces, pinned), FABRIC, device=CPU)
    looked, neighbours = [], SelfContact.neighbours

    def counted(self, last, at, before=None):
        looked.append((last.numpy().tobytes(), at.numpy().tobytes()))
        return neighbours(self, last, at, before)

    monkeypatch.setattr(SelfContact, "neighbours", counted)
    twisted(potential, points, pinned, apart=True, count=3)
    assert len(looked) > 20
    assert len(set(looked)) == len(looked)


def test_shots_of_different_lengths_go_on_with_it(scene, toy_motion, monkeypatch):
    monkeypatch.setattr("ssilk_core.physics.simulate.simulator.WAY_APART", (2, 5))  # the first pose is near
    at_rest = SolverOptions(tolerance=1e-4, iterations=300)  # what the tolerance leaves a rest state is millimetres
    simulator = Simulator(scene, FABRIC, SimulationOptions(self_contact=True, quasi_static_solver=at_rest))
    motions = [toy_motion(scene, 3), toy_motion(scene, 2)]  # the second one is the beginning of the first
    found = {(frame.shot, frame.number): frame for frame in simulator.frames(motions)}
    assert sorted(found) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]
    for (_, number), frame in found.items():
        np.testing.assert_allclose(frame.points, found[0, number].points, atol=1e-4)
        assert frame.residual < 1e-2


def skirt_over_legs() -> tuple[Scene, np.ndarray]:
    """A tube that hangs from hips over two legs, each a capsule with a joint; and the joints."""
    joints = np.array([[0.0, 1.0, 0.0], [-0.09, 0.95, 0.0], [0.09, 0.95, 0.0]])
    binds = np.tile(np.eye(4), (3, 1, 1))
    binds[:, :3, 3] = joints
    parents = [-1, 0, 0]
    skeleton = Skeleton("/legs", ("Hips", "Hips/L", "Hips/R"), parents, binds, local_transforms(binds, parents))
    solids = [trimesh.creation.capsule(height=0.05, radius=0.13, count=(8, 8)).apply_translation([0, 1.02, -0.02])]
    for joint in joints[1:]:
        leg = trimesh.creation.capsule(height=0.42, radius=0.075, count=(10, 10))
        leg.vertices = leg.vertices[:, [0, 2, 1]] * [1, -1, 1]
        solids.append(leg.apply_translation(joint - [0, leg.vertices[:, 1].max() - 0.06, 0]))
    body = trimesh.util.concatenate(solids)
    owner = np.repeat(np.arange(3), [len(solid.vertices) for solid in solids])[:, None]
    columns, heights = 12, np.linspace(0.08, -0.42, 6)
    angle, radius = np.arange(columns) * 2 * np.pi / columns, np.linspace(0.16, 0.22, 6)[:, None]
    around = np.stack(
        [radius * np.cos(angle), np.repeat(heights[:, None] + 1, columns, 1), radius * np.sin(angle)], -1
    )
    here, right = np.arange(60), np.arange(60) // columns * columns + (np.arange(60) + 1) % columns
    faces = np.concatenate([np.c_[here, right, here + columns], np.c_[right, right + columns, here + columns]])
    skin = SkinWeights("/skirt", np.zeros((72, 1), dtype=int), np.ones((72, 1)))
    garment = Garment(
        Mesh("/skirt", around.reshape(-1, 3), faces), skin, np.where(np.arange(72) < columns, PINNED, LOOSE)
    )
    dressed_body = Body(Mesh("/body", body.vertices, body.faces), SkinWeights("/body", owner, np.ones(owner.shape)))
    rig = ProxyRig("/skirt", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    return Scene(Character("/legs", skeleton, (dressed_body,)), garment, rig), joints


@pytest.mark.slow
def test_thighs_that_rise_do_not_leave_a_skirt_on_the_way_to_the_first_pose():
    scene, joints = skirt_over_legs()
    angle = np.deg2rad(110)
    raised = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
    turns = np.stack([np.eye(3), raised, raised])
    options = SimulationOptions(self_contact=True, quasi_static_solver=SolverOptions(iterations=10))
    simulator = Simulator(scene, FABRIC, options)
    places = scene.character.skeleton.rest_transforms[None, :, :3, 3]
    _, found = simulator.at_rest(quaternion_from_matrix(turns)[None], places)
    skirt = trimesh.Trimesh(found.x[..., 0].double().numpy(), scene.garment.mesh.faces, process=False)
    hips, thigh = joints[1:] - joints[0], raised @ [0, -0.42, 0]
    met, ray, _ = skirt.ray.intersects_location(hips, np.tile(thigh, (2, 1)))
    assert not (np.linalg.norm(met - hips[ray], axis=1) < 0.42).any()
