# SPDX-License-Identifier: Apache-2.0
"""The solver in latents on few elements, beside the one on all of them, which is the reference; in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssilk_core.demo.shipped import shipped_path
from ssilk_core.network.checkpoint import load_model
from ssilk_core.network.latent_solver import LatentOptions, elements
from ssilk_core.network.latent_solver.elements import choose_elements
from ssilk_core.network.latent_solver.shots import LatentShots
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.physics.simulate.characters import PosedCharacters
from ssilk_core.physics.simulate.cubature import (
    Cubature,
    cubature_between,
    sampled_potential,
    spread_evenly,
    spread_pairs,
)
from ssilk_core.scene.assets import LOOSE, Motion, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.mesh import topology

pytestmark = pytest.mark.usefixtures("few_contacts")

CLOTH = Fabric("toy", bending=1e-4, margin=0.02, tether=500.0, stitch=1e3)
FEW = 4  # pairs of faces, and as many faces added


@dataclass(frozen=True, eq=False)
class Whole:
    """A solver on all elements of the toy's garment, states of its network, and the character in these."""

    scene: Scene
    shots: LatentShots
    z: Tensor
    poses: PosedCharacters

    def chosen(self) -> Cubature:
        return choose_elements(self.scene, self.shots.simulator, self.shots.solver, self.z, self.poses)

    def gradients(self, cubature: Cubature) -> tuple[Tensor, Tensor]:
        """The forces on the latents (S, m) of the whole garment, and on the elements of a cubature."""
        simulator = self.shots.simulator.sampled(self.scene, cubature)
        solver = type(self.shots.solver)(self.shots.model, simulator.potential, LatentOptions(), cubature)
        place = torch.as_tensor(cubature.vertices)
        lbs = replace(self.poses, lbs=self.poses.lbs[place])
        return tuple(
            made.equations(self.z, poses.matrices, replace(sim.inputs(poses, None), body=None)).gradient
            for made, sim, poses in (
                (self.shots.solver, self.shots.simulator, self.poses),
                (solver, simulator, lbs),
            )
        )


@pytest.fixture
def whole(
    request: pytest.FixtureRequest,
    patched_scene: Scene,
    toy_model: Callable[..., GarmentModel],
    toy_motion: Callable[..., Motion],
) -> Whole:
    model, motion = toy_model(patched_scene, translations=True), toy_motion(patched_scene, 12, speed=2.0)
    made = LatentShots(model, CLOTH, LatentOptions(), precision="float64")
    poses = made.simulator.poser.pose(motion.rotations, motion.translations)
    return Whole(patched_scene, made, made._rolled(motion).double(), poses)


def error(pair: tuple[Tensor, Tensor]) -> float:
    right, found = pair
    return float((found - right).norm() / right.norm())


def test_each_strip_has_elements_and_vertices_that_stand_for_it_alone() -> None:
    """Strips of a fringe hang side by side: one without elements moves as it likes, as those of the skirt did."""
    scene = load_model(shipped_path("fringe_skirt")).scene
    mesh, loose = scene.garment.mesh, scene.classes == LOOSE
    hung = topology.edges(mesh.faces)
    strips = topology.components(hung[loose[hung].all(axis=1)], mesh.vertex_count)
    large = [number for number, size in zip(*np.unique(strips[loose], return_counts=True)) if size > 50]
    assert len(large) >= 30
    potential = SimpleNamespace(
        stitching=None, hinges=None, membrane=SimpleNamespace(area=torch.ones(len(mesh.faces), 1))
    )  # fmt: skip
    found = cubature_between(scene, potential, spread_pairs(scene, elements.PAIRS))
    own = strips[mesh.faces[found.faces]]
    assert all((own == number).all(axis=1).sum() >= 2 for number in large)
    stands_for = found.vertices[found.owners]
    assert all((strips[stands_for[strips == number]] == number).all() for number in large)


def test_all_elements_are_the_whole_garment(whole, monkeypatch) -> None:
    scene, potential = whole.scene, whole.shots.simulator.potential
    assert potential.stitching and potential.hinges
    count = scene.garment.mesh.vertex_count
    cubature = cubature_between(scene, potential, np.arange(count))
    np.testing.assert_array_equal(cubature.owners, np.arange(count))
    np.testing.assert_allclose(np.concatenate([cubature.face_weights, cubature.hinge_weights]), 1)
    assert error(whole.gradients(cubature)) < 1e-6


def test_what_vertices_stand_for_adds_up(whole, monkeypatch) -> None:
    monkeypatch.setattr(elements, "PAIRS", FEW)
    monkeypatch.setattr(elements, "ADDED", 0)
    scene, potential = whole.scene, whole.shots.simulator.potential
    cubature = whole.chosen()
    found = sampled_potential(potential, scene, cubature)
    assert len(cubature.vertices) < 0.8 * scene.garment.mesh.vertex_count
    free, kept = potential.free, found.free
    torch.testing.assert_close(found.mass[kept].sum(), potential.mass[free].sum())
    torch.testing.assert_close(found.tether[kept].sum(), potential.tether[free].sum())
    area = potential.cloth.to_vertices(potential.cloth.area[..., None])[free].sum()
    torch.testing.assert_close(found.cloth.area[kept].sum(), area)
    held = np.isin(np.arange(scene.garment.mesh.vertex_count), free.numpy())
    assert (scene.classes[cubature.vertices[cubature.owners]] == scene.classes)[held].all()
    assert set(cubature.vertices[found.free.numpy()]) <= set(free.tolist())


def test_a_garment_on_another_body_is_summed_over_few_elements_too(whole, monkeypatch) -> None:
    monkeypatch.setattr(elements, "PAIRS", FEW)
    monkeypatch.setattr(elements, "ADDED", 0)
    scene, potential, cubature = whole.scene, whole.shots.simulator.potential, whole.chosen()
    sewn = replace(scene, garment=replace(scene.garment, sewn=scene.garment.mesh.points))
    own, its = (sampled_potential(potential, each, cubature) for each in (scene, sewn))
    torch.testing.assert_close(its.mass, own.mass)


def test_weights_give_the_forces_of_the_whole_garment_better_than_those_of_areas_do(whole, monkeypatch) -> None:
    monkeypatch.setattr(elements, "PAIRS", FEW)
    monkeypatch.setattr(elements, "ADDED", FEW)
    monkeypatch.setattr(elements, "TOGETHER", 2)
    cubature = whole.chosen()
    usual = cubature_between(whole.scene, whole.shots.simulator.potential, cubature.vertices)
    assert (cubature.face_weights >= 0.99 * elements.LEAST * usual.face_weights).all()
    assert error(whole.gradients(cubature)) < 0.7 * error(whole.gradients(usual))
    again = whole.chosen()
    np.testing.assert_array_equal(again.vertices, cubature.vertices)
    np.testing.assert_array_equal(again.face_weights, cubature.face_weights)


def test_it_goes_where_the_solver_on_all_elements_goes(scene, toy_model, toy_motion, monkeypatch) -> None:
    monkeypatch.setattr(elements, "PAIRS", 12)
    model, motion = toy_model(scene), toy_motion(scene, 8, speed=3.0)
    made = {
        sampled: LatentShots(model, CLOTH, LatentOptions(iterations=3, sampled=sampled), precision="float64")
        for sampled in (True, False)
    }
    points = {}
    for sampled, shots in made.items():
        z = torch.cat([frame.solution.z for frame in shots.frames([motion])])
        poses = shots.simulator.poser.pose(motion.rotations, motion.translations)
        points[sampled] = shots.solver.decode(z, poses.matrices, shots.simulator.inputs(poses, None))
        points["lbs"] = poses.lbs
    apart = {name: float((points[name] - points[False]).square().sum(1).mean().sqrt()) for name in (True, "lbs")}
    assert apart[True] < 0.15 * apart["lbs"]


def test_no_frame_gains_the_energy_of_its_elements_in_an_iteration(scene, toy_model, toy_motion) -> None:
    model, motion = toy_model(scene), toy_motion(scene, 8, speed=3.0)
    options = LatentOptions(iterations=1, first_iterations=1, sampled=True)
    found = [frame.solution for frame in LatentShots(model, CLOTH, options, precision="float64").frames([motion])]
    assert all(bool((each.energy <= each.start_energy).all()) for each in found)
    assert sum(bool((each.energy < each.start_energy).all()) for each in found) > 4


def test_shots_of_several_lengths_have_their_elements_together(scene, toy_model, toy_motion, monkeypatch) -> None:
    monkeypatch.setattr("ssilk_core.network.latent_solver.shots.POSED", 2)
    motions = [toy_motion(scene, 5, speed=3.0), toy_motion(scene, 3), toy_motion(scene, 1)]
    made = LatentShots(toy_model(scene), CLOTH, LatentOptions(first_iterations=2, sampled=True), precision="float64")
    assert [len(frame.lost) for frame in made.frames(motions)] == [3, 2, 2, 1, 1]


@pytest.mark.parametrize(("count", "most"), [(0, 4), (1, 4), (3, 4), (4, 4), (1000, 7)])
def test_indices_are_evenly_spread(count, most) -> None:
    found = spread_evenly(count, most)
    assert len(found) == min(count, most) and (np.diff(found) > 0).all()
    assert not count or (found[0] == 0 and (found[-1] == count - 1 or most == 1 or count == 1))
