# SPDX-License-Identifier: Apache-2.0
"""What a scene does not need is not computed: pinned garments, bodies out of reach, vertices that nothing moves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssilk_core.events import Event, Message
from ssilk_core.network.checkpoint import load_model, network
from ssilk_core.network.rollout import garment_poses, roll
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.collision import nearest_planes, signed_distance
from ssilk_core.physics.reach import reachable_body
from ssilk_core.scene.assets import LOOSE, PINNED, TIGHT, Character, ProxyRig, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import deform, motion_transforms, skin_points, skinning_matrices
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run import train
from ssilk_core.training.settings import TrainConfig

CPU = torch.device("cpu")


def classed(scene: Scene, classes: np.ndarray) -> Scene:
    """The scene with other vertex classes; without proxies where nothing is loose."""
    garment = replace(scene.garment, classes=classes)
    if (classes == LOOSE).any():
        return replace(scene, garment=garment)
    none = ProxyRig("/none", (), np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4)), scene.lbs_skin)
    return Scene(scene.character, garment, none)


def job_of(scene: Scene, motion, output: Path = Path("none.safetensors")) -> TrainJob:
    config = TrainConfig(
        iterations=40, batch=2, window=4, pretraining_batch=4, static_batch=2, recombinations=0, valid_frames=9
    )
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=ModelConfig(latent=8, widths=(16,), shapes=4),
        train=config, fabric=Fabric("toy"), output=output, device="cpu",
    )  # fmt: skip


def moved_away(scene: Scene) -> Scene:
    bodies = [
        replace(body, mesh=replace(body.mesh, points=body.mesh.points + [50.0, 0, 0]))
        for body in scene.character.bodies
    ]
    return replace(scene, character=Character("/away", scene.character.skeleton, tuple(bodies)))


def test_a_pinned_garment_has_nothing_to_learn(scene, toy_motion, tmp_path):
    pinned = classed(scene, np.full(len(scene.classes), PINNED))
    output, told = tmp_path / "pinned.safetensors", []

    def report(event: Event) -> None:
        told.append(event)

    done = train(job_of(pinned, toy_motion(scene, 30), output), report)
    assert (done.iterations, done.finished) == (1, True)
    assert done.score.total == pytest.approx(done.lbs.total, rel=1e-4)
    assert any(isinstance(event, Message) and "nothing to learn" in event.text for event in told)
    file = load_model(output)
    assert sum(value.size for value in file.parameters.values()) < 500
    model, motion = network(file, pinned), toy_motion(scene, 12)
    (pose,) = garment_poses(model, motion, 30.0)
    world = motion_transforms(motion, pinned.character.skeleton.parents)
    matrices = skinning_matrices(world, pinned.character.skeleton.bind_transforms)
    lbs = skin_points(pinned.garment.mesh.points, pinned.lbs_skin, matrices)
    np.testing.assert_allclose(deform(model.deformer(), motion, pose), lbs, atol=1e-6)
    assert Player(file).play(motion).vertices(5) == pytest.approx(lbs[5], abs=1e-5)
    assert reachable_body(pinned, [toy_motion(scene, 30)]).vertices.size == 0


def test_a_garment_with_anything_free_learns_as_asked(scene, toy_motion):
    asked = job_of(scene, toy_motion(scene, 30))
    assert asked.is_trainable and asked.model.latent == 8 and asked.train.iterations == 40


def test_a_body_out_of_reach_costs_no_collisions_and_no_posing(scene, toy_motion):
    parts = build_parts(job_of(moved_away(scene), toy_motion(scene, 30)), CPU)
    assert parts.body is None and parts.reached == 0
    stepper = parts.stepper(TrainConfig(batch=2, window=4, static_batch=2, static_fraction=0.0), 0)
    stepper.run(0)
    assert float(stepper.terms["collision"]) == 0 < float(stepper.terms["stretch"])


def test_only_what_is_not_pinned_meets_the_body(scene, toy_motion):
    """The others stand where they stand: their planes are far away, and their collisions have no gradient."""
    classes, clearance = np.where(np.arange(len(scene.classes)) % 2, PINNED, LOOSE), 0.004
    parts = build_parts(job_of(classed(scene, classes), toy_motion(scene, 30)), CPU)
    config = TrainConfig(batch=2, window=4, static_batch=2, clearance=clearance)
    objective = parts.stepper(config, 0).objective
    character = parts.bank.character(torch.arange(5))
    x = parts.model.vertices(torch.zeros(5, 8), character).detach()
    cloth = objective.energy.cloth
    x = cloth.positions(x)
    normal, offset = objective._planes(x, character)
    posed = parts.body.pose(character)
    expected = nearest_planes(x, posed)
    kinds = torch.tensor(cloth.samples.classes(classes))
    distance = (normal * x).sum(1) - offset + clearance
    near = (kinds == LOOSE) & (distance.abs() < 0.07).all(dim=1)
    assert near.sum() > 100
    torch.testing.assert_close(normal[near], expected[0][near])
    torch.testing.assert_close(offset[near], expected[1][near] + clearance)
    torch.testing.assert_close(distance[near], signed_distance(x, posed)[near])
    assert distance[kinds == PINNED].min() > 1e5


def test_the_body_is_reached_by_what_is_free_alone(scene, toy_motion):
    motions = [toy_motion(scene, 30)]
    height = scene.garment.mesh.points[:, 1]
    half = np.where(height > np.median(height), PINNED, TIGHT)
    few, all_of_it = (
        reachable_body(classed(scene, classes), motions).vertices for classes in (half, np.full(len(half), TIGHT))
    )
    assert set(few) < set(all_of_it)


def initialiser_learns_from_windows(job: TrainJob) -> bool:
    parts = build_parts(job, CPU)
    stepper = parts.stepper(job.train, 0)
    frames, direction, _ = stepper.sampler.poses(2)
    dynamic, *_ = stepper.objective.window(stepper.sampler, stepper.sampler.noise(), frames, direction)
    dynamic["stretch"].sum().backward()
    gradient = parts.model.initialiser[0].weight.grad
    return gradient is not None and bool(gradient.any())


def test_a_garment_with_nothing_loose_has_no_stepper(scene, toy_motion, tmp_path):
    """It is where its initialiser says, in training, in bakes and in the runtime, which is no matter of frames."""
    tight, output = classed(scene, np.full(len(scene.classes), TIGHT)), tmp_path / "tight.safetensors"
    asked, loose = (job_of(world, toy_motion(scene, 40), output) for world in (tight, scene))
    assert asked.model.scheme == "quasi_static" and loose.model.scheme == "spring_verlet"
    chosen = replace(loose, model=replace(loose.model, scheme="quasi_static"))
    assert [(job.train.state_reuse, job.train.noise) for job in (asked, chosen)] == [
        (0, 0)
    ] * 2 and loose.train.noise > 0
    assert initialiser_learns_from_windows(asked) and not initialiser_learns_from_windows(loose)
    done = train(
        replace(asked, train=replace(asked.train, static_fraction=0.3, learning_rate_warmup=2)), lambda event: None
    )
    assert done.score.total < done.lbs.total
    file = load_model(output)
    assert not [name for name in file.parameters if name.startswith(("stepper", "integrator"))]
    model, motion = network(file, tight).eval(), toy_motion(scene, 30, speed=2.0)
    whole = torch.cat([step.activation for step in roll(model, motion)], dim=1)
    for frame in (0, 7, 29):
        (alone,) = roll(model, motion.clip(frame, frame + 1))
        torch.testing.assert_close(whole[:, frame : frame + 1], alone.activation, atol=1e-5, rtol=0)
    (pose,) = garment_poses(model, motion, 30.0)
    mine = Player(file).play(motion)
    np.testing.assert_allclose(mine.vertices(11), deform(model.deformer(), motion, pose)[11], atol=1e-5)
