# SPDX-License-Identifier: Apache-2.0
"""A model on a character with another skeleton: its cloth moves there as on its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.delivery.bake import onto
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import ModelFile, model_file
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import Character, Garment, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.posed_alike import alike, carrying

from ..humanoids import PARTS, SCHEMES, humanoid, moved, moved_alike

OWN = humanoid(SCHEMES["cmu"], axes=1)
IMAGES = np.arange(len(PARTS))
CHEST, ARM = PARTS.index("spine3"), PARTS.index("left upper arm")


def worn(scene: Scene, holds: int, blended: bool = False) -> Scene:
    """The toy's strip behind the figure, half on its chest and half on an arm, its proxies on one of its joints."""
    mesh = scene.garment.mesh
    points = mesh.points - mesh.points.mean(axis=0) + OWN.bind_transforms[CHEST, :3, 3] + [0.1, 0, -0.2]
    dense = np.zeros((len(points), OWN.joint_count + 2))
    side = points[:, 0] > 0.12
    share = 0.5 if blended else 1.0
    dense[side, ARM], dense[side, CHEST], dense[~side, CHEST] = share, 1 - share, 1.0
    plain = SkinWeights.from_dense("/strip", dense[:, :-2])
    low = ~side & (points[:, 1] < points[:, 1].mean())
    dense[low] *= 0.3
    dense[low, -2:] = [0.4, 0.3]
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[:, :3, 3] = points[low][[0, -1]]
    names = (f"{OWN.joint_names[holds]}/P0", f"{OWN.joint_names[holds]}/P0/P1")
    rig = ProxyRig(
        "/strip", names, np.array([holds, OWN.joint_count]), binds, SkinWeights.from_dense("/strip", dense)
    )
    garment = Garment(replace(mesh, points=points), plain, scene.garment.classes)
    return Scene(Character("/figure", OWN, ()), garment, rig)


@pytest.fixture
def put(scene):
    """A function: the model on its own figure, and on one that is bound otherwise, both with their motions."""

    def made(holds: int = CHEST, blended: bool = False, **bound):
        file = _random(scene, holds, blended)
        other = humanoid(SCHEMES["unreal"], axes=2, **bound)
        posed = alike(OWN, other, IMAGES)
        character = carrying(OWN, Character("/other", other, ()), IMAGES, posed)
        lies = Garment(replace(file.scene.garment.mesh, path="/other/strip"))
        theirs = onto._bound(file, lies, character, posed, file.scene.garment.mesh.points)
        motion = moved(OWN, 30)
        return (file, motion), (theirs, moved_alike(motion, OWN, other, posed.transforms, IMAGES))

    return made


def _random(scene: Scene, holds: int, blended: bool) -> ModelFile:
    """A network whose every parameter is drawn at random."""
    model = GarmentModel(
        worn(scene, holds, blended), ModelConfig(latent=8, widths=(16,), shapes=4), np.arange(OWN.joint_count), 3
    )
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for name, value in model.named_parameters():
            small = 0.05 if "shapes" in name or "integrator" in name else 0.3
            value.add_(small * torch.randn(value.shape, generator=generator))
    return model_file(model, Fabric("toy"), {})


def vertices(of):
    file, motion = of
    play = Player(file).play(motion)
    return np.array([play.vertices(frame) for frame in (0, 11, 29)])


@pytest.mark.parametrize("bound", [{}, {"arms": 0}, {"arms": 0, "turn": 180}, {"arms": 70, "turn": 90}], ids=str)
def test_cloth_moves_as_on_its_own_figure(put, bound):
    own, its = put(**bound)
    found, wanted = vertices(its), vertices(own)
    assert np.linalg.norm(wanted[1] - wanted[0], axis=1).mean() > 0.05
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    assert its[0].scene.character.skeleton.joint_names[CHEST].endswith("spine_03")


def test_where_skinning_blends_joints_that_are_bound_otherwise_it_is_near(put):
    (file, motion), (theirs, moved_theirs) = put(blended=True, arms=0)
    apart = np.linalg.norm(vertices((theirs, moved_theirs)) - vertices((file, motion)), axis=2)
    assert 0.002 < apart.max() < 0.3


def test_proxies_on_a_limb_that_is_bound_otherwise_are_refused(put):
    put(holds=ARM, arms=40)
    with pytest.raises(SsilkError, match=r"'upperarm_l', from which proxies hang, is bound 45 degrees .* 12 degrees"):
        put(holds=ARM, arms=0)


def test_a_graded_garment_counts_from_its_shape_on_the_first_body_there(scene):
    file = _random(scene, CHEST, False)
    shape = file.scene.garment.mesh.points * 1.1
    garment = replace(file.scene.garment, graded=True, sewn=shape)
    file = replace(file, scene=replace(file.scene, garment=garment))
    other = humanoid(SCHEMES["unreal"], axes=2, arms=0)
    posed = alike(OWN, other, IMAGES)
    character = carrying(OWN, Character("/other", other, ()), IMAGES, posed)
    lies = Garment(replace(file.scene.garment.mesh, path="/other/strip"))
    there = onto._bound(file, lies, character, posed, file.scene.garment.mesh.points).scene.garment
    np.testing.assert_array_equal(there.rest_mesh.points, shape)
    told = onto._told(file, character, IMAGES, posed, None)
    assert any("it was graded to bodies" in event.text for event in told)


def test_a_map_of_few_joints_is_warned_of(scene):
    file, other = _random(scene, CHEST, False), humanoid(SCHEMES["unreal"], axes=2)
    posed = alike(OWN, other, IMAGES)
    few = np.where(np.arange(len(IMAGES)) < len(IMAGES) // 3, IMAGES, -1)
    levels = [
        onto._told(file, Character("/other", other, ()), images, posed, None)[0].level for images in (IMAGES, few)
    ]
    assert levels == ["info", "warning"]
