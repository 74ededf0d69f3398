# SPDX-License-Identifier: Apache-2.0
"""A garment that is graded to the bodies of a family, and one that is the same on all of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.authoring.bodies.carry import dressed_family
from ssilk_core.errors import SsilkError
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, model_file, network, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.graded import GradedRest
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential
from ssilk_core.quality.evaluation.methods import EvaluationScene
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.family import BodyFamily
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run import train
from ssilk_core.training.settings import TrainConfig

from ..body_family import members_of

CPU = torch.device("cpu")
CONFIG = ModelConfig(latent=8, widths=(16, 12), shapes=4, feedback_points=6)
SCHEDULE = TrainConfig(batch=4, static_batch=2, static_fraction=0, collider_fraction=0.0)
DOUBLE = torch.float64


@pytest.fixture(scope="module")
def members(scene):
    return members_of(scene.character)


@pytest.fixture(scope="module")
def graded(scene):
    return replace(scene, garment=replace(scene.garment, graded=True))


@pytest.fixture(scope="module")
def family(scene, members):
    return dressed_family(scene, BodyFamily.of(members), members[1:])[0]


def job_of(scene, family, motion, output, **given):
    schedule = given.pop("train", SCHEDULE)
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=CONFIG, train=schedule, fabric=Fabric("toy"),
        output=output, family=family, **given,
    )  # fmt: skip


def with_pocket(mesh):
    """A strip with stiffness painted on it, and a pocket a few millimetres over it, which stitches hold."""
    picked = mesh.faces[40:48]
    rows = np.unique(picked)
    lifted = mesh.points[rows] + [0.004, 0.003, -0.003]
    faces = np.searchsorted(rows, picked) + mesh.vertex_count
    points = np.concatenate([mesh.points, lifted]) * [1.15, 1.15, 1]  # whose triangles are all divided alike
    points = points + 0.003 * np.random.default_rng(5).standard_normal(points.shape)
    stiffness = np.random.default_rng(6).uniform(0.5, 2, len(points))
    return Mesh(mesh.path, points, np.concatenate([mesh.faces, faces]), stiffness=stiffness), rows


CONTACTS = [Fabric("toy"), Fabric("paper", contact_model="vertex"), Fabric("wool", stretch_model="baraff_witkin")]


@pytest.mark.parametrize("fabric", CONTACTS, ids=["samples", "vertices", "woven"])
def test_each_term_is_that_of_a_garment_that_was_made_for_the_body(scene, fabric):
    mesh, rows = with_pocket(scene.garment.mesh)
    classes = np.concatenate([scene.classes, scene.classes[rows]])
    random = np.random.default_rng(0)
    # So small a change that triangles are still divided alike, and the pocket keeps its stitches.
    points = mesh.points * [1.02, 1.01, 0.99] + 2e-4 * random.standard_normal(mesh.points.shape)
    energy = GarmentEnergy(mesh, fabric, classes, dtype=DOUBLE)
    own = GarmentEnergy(replace(mesh, points=points), fabric, classes, dtype=DOUBLE)
    assert len(own.stitching) == len(energy.stitching) > 10
    GradedRest(energy, mesh, (points - mesh.points)[None]).wear(torch.ones(1))

    def tensor(values):
        return torch.tensor(values, dtype=DOUBLE)

    x = tensor(points[:, :, None] + 0.01 * random.standard_normal((*points.shape, 4))).requires_grad_()
    other, shift = x.detach() + 0.01, tensor(random.standard_normal((3, 4)))
    distance = tensor(random.uniform(-0.01, 0.01, (len(own.cloth.area), 4)))

    def terms(of):
        sampled = of.cloth.positions(x)
        return {
            "stretch": of.stretch(x),
            "bending": of.bending(x),
            "gravity": of.gravity(x, shift),
            "inertia and drag": torch.cat(of.inertia_and_drag(x, other, other - 0.02, shift, 1 / 30)),
            "tether": of.tether(x, other[of.tethered]),
            "stitch": of.stitch(x),
            "collision": of.collision_at(distance),
            "sampled": of.collision_at(sampled.mean(1) / 100),
        }

    found, wanted = terms(energy), terms(own)
    for name, value in wanted.items():
        assert value.abs().min() > 0, name
        torch.testing.assert_close(found[name], value, rtol=1e-9, atol=0, msg=name)
    for name in ("stretch", "bending", "stitch"):
        one, two = (torch.autograd.grad(each[name].sum(), x, retain_graph=True)[0] for each in (found, wanted))
        torch.testing.assert_close(one, two, rtol=1e-7, atol=1e-9 * float(two.abs().max()))
    for name in ("face_numbers", "corner_numbers", "hinge_numbers"):  # of fused kernels
        torch.testing.assert_close(getattr(energy.tables, name), getattr(own.tables, name), rtol=1e-5, atol=1e-7)


def test_samples_stand_for_the_area_that_the_cloth_has_on_the_body(scene):
    """Where triangles would be divided otherwise, samples stay where they are and share the new area."""
    mesh = scene.garment.mesh
    points, fabric = mesh.points * [1.9, 1.7, 1], Fabric("toy")
    energy, own = (GarmentEnergy(each, fabric) for each in (mesh, replace(mesh, points=points)))
    GradedRest(energy, mesh, (points - mesh.points)[None]).wear(torch.ones(1))
    assert len(energy.cloth.area) < len(own.cloth.area)
    torch.testing.assert_close(energy.cloth.area.sum(), own.cloth.area.sum())
    torch.testing.assert_close(energy.mass, own.mass)


def tensors_of(energy):
    operators = energy.gradient_operator, energy.hinge_operator, energy.cloth._rows
    numbers = [value for operator in operators for value in (operator.matrix.values(), operator.transposed.values())]
    own = [
        value for value in (*vars(energy).values(), *vars(energy.tables).values()) if isinstance(value, torch.Tensor)
    ]
    return [*own, *numbers, energy.cloth.area]


def test_tensors_stay_where_a_captured_graph_reads_them(graded, family, toy_motion, tmp_path):
    parts = build_parts(job_of(graded, family, toy_motion(graded, 24), tmp_path / "m.safetensors"), CPU)
    stepper = parts.stepper(SCHEDULE, 0)
    before = [(value.data_ptr(), value.clone()) for value in tensors_of(parts.energy)]
    stepper.run(0)
    after = tensors_of(parts.energy)
    assert [at for at, _ in before] == [value.data_ptr() for value in after]
    assert sum(not torch.equal(old, new) for (_, old), new in zip(before, after)) >= 8
    parts.graded.wear(torch.tensor(family.bodies.members[2]))
    assert parts.stepper(SCHEDULE, 0).objective.scale == stepper.objective.scale  # of a run that restarts


@torch.no_grad()
def test_a_step_is_done_on_the_energy_of_its_body(graded, members, family, toy_motion, tmp_path):
    motion = toy_motion(graded, 24)
    parts = build_parts(job_of(graded, family, motion, tmp_path / "m.safetensors"), CPU)
    stepper, random = parts.stepper(SCHEDULE, 0), torch.Generator().manual_seed(0)
    frames, down = torch.arange(6), torch.tensor([0.0, -1.0, 0.0]).expand(6, 3)
    for coordinates in family.bodies.members[[2, 1, 0]]:
        stepper.bodies.wear(coordinates.copy())
        there = family.scene_at(replace(graded, garment=replace(graded.garment, graded=False)), coordinates)
        plain = replace(there, garment=replace(there.garment, sewn=None))  # a stage of that body alone
        rest = torch.tensor(plain.garment.mesh.points, dtype=torch.float32)
        character = parts.bank.character(frames)
        x = rest[:, :, None] + 0.02 * torch.randn(*rest.shape, 6, generator=random)
        own = build_parts(job_of(plain, None, motion, tmp_path / "one.safetensors"), CPU).energy
        found = stepper.objective.quasi_static_terms(x, down, character)
        same = stepper.objective.energy
        torch.testing.assert_close(found["stretch"], own.stretch(x), rtol=2e-5, atol=1e-4)
        torch.testing.assert_close(found["bending"], own.bending(x), rtol=2e-5, atol=1e-6)
        torch.testing.assert_close(same.mass, own.mass, rtol=1e-6, atol=0)
        torch.testing.assert_close(same.tether_stiffness, own.tether_stiffness, rtol=1e-6, atol=0)


@torch.no_grad()
def test_validation_is_on_the_rest_shape_of_each_body(graded, scene, family, toy_motion, tmp_path):
    motion = toy_motion(scene, 40)
    parts = build_parts(job_of(graded, family, motion, tmp_path / "m.safetensors"), CPU)
    before = parts.validator.score(parts.model)
    stepper = parts.stepper(SCHEDULE, 0)
    stepper.bodies.wear(family.bodies.members[2].copy())
    stepper.bodies.take_off()
    parts.graded.wear(torch.tensor(family.bodies.members[2]))
    assert parts.validator.score(parts.model) == before
    same = build_parts(job_of(scene, family, motion, tmp_path / "s.safetensors"), CPU).validator.score(parts.model)
    assert same.terms == before.terms
    for one, other, member in zip(before.bodies, same.bodies, family.bodies.members[1:]):
        here = family.scene_at(graded, member)
        validated = next(each for each in parts.validator.members if each.name == one.name).validator
        wanted = GarmentEnergy(here.garment.mesh, Fabric("toy"), here.classes)
        torch.testing.assert_close(validated.energy.mass, wanted.mass)
        assert one.total < other.total and one.lbs < other.lbs  # the same garment is stretched over it


def family_file(scene, family):
    model = GarmentModel(scene, CONFIG, np.arange(3), 0, family)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.1 * torch.randn(value.shape, generator=generator))
    return model_file(model, Fabric("toy"), {})


def test_a_file_says_how_the_garment_meets_bodies_and_is_otherwise_the_same(scene, graded, family, tmp_path):
    for name, each in (("same", scene), ("graded", graded)):
        save_model(tmp_path / f"{name}.safetensors", family_file(each, family))
    same, other = (tmp_path / f"{name}.safetensors" for name in ("same", "graded"))
    assert b'"graded"' not in same.read_bytes()  # as files were before there were two
    heavy = family.bodies.members[2]
    for path, is_graded in ((same, False), (other, True)):
        file = load_model(path)
        assert file.scene.garment.graded is is_graded
        on = file.on_body(heavy)
        rest = on.scene.garment.mesh.points if is_graded else file.scene.garment.mesh.points
        np.testing.assert_array_equal(on.scene.garment.rest_mesh.points, rest)
        save_model(tmp_path / "one.safetensors", on)
        again = load_model(tmp_path / "one.safetensors").scene.garment
        np.testing.assert_allclose(again.rest_mesh.points, rest, atol=1e-6)
        assert again.graded is is_graded
    played = [network(load_model(path).on_body(heavy)) for path in (same, other)]
    z = torch.randn(3, CONFIG.latent, generator=torch.Generator().manual_seed(2))
    still = torch.eye(3, 4)[None, :, :, None].expand(3, 3, 4, 3).contiguous()
    with torch.no_grad():
        assert torch.equal(*(each.vertices(z, still) for each in played))


def test_solver_and_figures_take_the_rest_shape_of_the_body(graded, scene, family):
    heavy = family.bodies.members[2]
    on = family.scene_at(graded, heavy)
    alone = replace(on, garment=replace(on.garment, sewn=None, graded=False))
    same = family.scene_at(scene, heavy)
    x = torch.tensor(on.garment.mesh.points, dtype=DOUBLE)[:, :, None] * 1.01
    found, wanted, tight = (IncrementalPotential(each, Fabric("toy"), device=CPU) for each in (on, alone, same))
    torch.testing.assert_close(found.membrane.energy(x), wanted.membrane.energy(x), rtol=1e-12, atol=0)
    torch.testing.assert_close(found.mass, wanted.mass, rtol=1e-12, atol=0)
    assert tight.membrane.energy(x) > 10 * found.membrane.energy(x)
    found, wanted, tight = (EvaluationScene(each, Fabric("toy"), 30.0, CPU) for each in (on, alone, same))
    torch.testing.assert_close(found.energy.stretch(x.float()), wanted.energy.stretch(x.float()))
    torch.testing.assert_close(found.columns(x.float()), wanted.columns(x.float()))
    assert tight.energy.stretch(x.float()) > 10 * found.energy.stretch(x.float())


def test_what_a_graded_garment_cannot_train_with_is_refused(scene, graded, family, members, toy_motion, tmp_path):
    motion, output = toy_motion(scene, 24), tmp_path / "m.safetensors"
    with pytest.raises(SsilkError, match="graded to bodies, and one body alone"):
        job_of(graded, None, motion, output)
    with pytest.raises(SsilkError, match="newton_weight for a graded garment"):
        job_of(graded, family, motion, output, train=replace(SCHEDULE, newton_weight=1.0))
    job_of(scene, family, motion, output, train=replace(SCHEDULE, newton_weight=1.0))
    flat = np.array(family.cloth_moves)
    mesh = scene.garment.mesh
    a, b, _ = mesh.faces[7]
    end = family.bodies.members[2]
    wanted = (mesh.points + np.tensordot(end, flat, 1))[[a, b]]
    flat[:, b] += np.linalg.pinv(end[None]) * (wanted[0] - wanted[1])
    with pytest.raises(SsilkError, match=r"on /heavier: [0-9]+ of [0-9]+ triangles have no area"):
        job_of(graded, replace(family, cloth_moves=flat), motion, output)
    job_of(scene, replace(family, cloth_moves=flat), motion, output)


def test_a_run_goes_on_with_the_garment_as_it_began(scene, graded, family, toy_motion, tmp_path):
    motion, output = toy_motion(scene, 24), tmp_path / "m.safetensors"
    one, other = (job_of(each, family, motion, output).identity() for each in (scene, graded))
    assert one["family"] != other["family"] and {**one, "family": ""} == {**other, "family": ""}


@pytest.mark.slow
def test_a_trained_garment_that_is_graded_is_stretched_less_on_a_heavy_body(
    scene, graded, family, members, toy_motion, tmp_path
):
    motion = toy_motion(scene, 40)
    schedule = replace(SCHEDULE, iterations=30, static_fraction=0.5, valid_frames=20, learning_rate=2e-3)
    stretch = {}
    for name, each in (("same", scene), ("graded", graded)):
        job = job_of(each, family, motion, tmp_path / f"{name}.safetensors", train=schedule)
        train(job, silent)
        file = load_model(tmp_path / f"{name}.safetensors").on_body(family.bodies.members[2])
        own = replace(file.scene, character=members[2])
        body = network(file, own)
        parts = build_parts(job, CPU)
        heavy = next(each for each in parts.validator.members if each.name == "/heavier").validator
        with torch.no_grad():
            stretch[name] = heavy.means(body)["stretch"]
    assert 0 < stretch["graded"] < 0.5 * stretch["same"]
