# SPDX-License-Identifier: Apache-2.0
"""Training that goes on from a trained model: what is kept, what learns, and whose it may be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.feedback import feedback_size, feedback_vertices
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.parameters import on_moved_garment, parameter_shapes
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import TIGHT, Scene
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.mesh import topology
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.starting_model import FIRST_WEIGHT, take_over

CPU = torch.device("cpu")


def job(scene, base, motion, *, whole: bool = False, **model) -> TrainJob:
    config = ModelConfig(**{"latent": 99, "feedback_points": 5, **model})
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=config,
        train=TrainConfig(), fabric=FABRICS["silk"], output=Path("out.safetensors"), base=base, whole=whole,
        device="cpu",
    )  # fmt: skip


def test_initialiser_and_decoder_are_kept_and_the_stepper_alone_learns(scene, toy_model, toy_motion):
    base = model_file(toy_model(scene, feedback_points=0), FABRICS["silk"], {})
    asked = job(scene, base, toy_motion(scene, 9))
    assert asked.model == replace(base.config, feedback_points=5)
    assert asked.train.static_iterations == 0
    model = GarmentModel(scene, asked.model, base.joints, 7)
    assert take_over(model, base)
    for name, parameter in model.named_parameters():
        learns = name.startswith(("stepper.", "integrator."))
        assert parameter.requires_grad == learns
        if not learns:
            assert torch.equal(parameter, torch.from_numpy(base.parameters[name]))


@pytest.mark.parametrize(("before", "after", "more"), [(0, 5, 15), (3, 5, 6), (5, 5, 0)])
def test_the_stepper_goes_on_and_what_it_did_not_see_counts_nothing_yet(
    scene, toy_model, toy_motion, before, after, more
):
    trained = toy_model(scene, feedback_points=before)
    base = model_file(trained, FABRICS["silk"], {})
    asked = job(scene, base, toy_motion(scene, 9), feedback_points=after)
    model = GarmentModel(scene, asked.model, base.joints, 7)
    assert take_over(model, base)
    old, new = torch.from_numpy(base.parameters[FIRST_WEIGHT]), model.stepper[0].weight.detach()
    assert new.shape[1] == old.shape[1] + more
    assert torch.equal(new[:, : old.shape[1]], old) and not new[:, old.shape[1] :].any()
    assert torch.equal(model.integrator.beta, trained.integrator.beta)
    # The points that S sees are the first of those that it sees now.
    assert torch.equal(model.feedback.points.rows[:before], trained.feedback.points.rows)


@pytest.mark.parametrize("model", [{"feedback_points": 2}, {"scheme": "verlet", "feedback_points": 5}])
def test_a_stepper_that_sees_less_or_steps_otherwise_starts_anew(scene, toy_model, toy_motion, model):
    base = model_file(toy_model(scene, feedback_points=5), FABRICS["silk"], {})
    asked = job(scene, base, toy_motion(scene, 9), **model)
    new = GarmentModel(scene, asked.model, base.joints, 7)
    fresh = new.stepper[0].weight.detach().clone()
    assert not take_over(new, base)
    assert torch.equal(new.stepper[0].weight, fresh)


def test_a_model_of_another_garment_is_refused(scene, toy_model, toy_scene, toy_motion):
    base = model_file(toy_model(toy_scene(proxies=0)), FABRICS["silk"], {})
    with pytest.raises(SsilkError, match="another garment, rig or skeleton"):
        job(scene, base, toy_motion(scene, 9))


@pytest.mark.parametrize("whole", [True, False])
def test_a_garment_with_another_vertex_in_no_face_is_refused(scene, toy_model, toy_motion, whole):
    def longer(skin):
        return replace(skin, indices=skin.indices[rows], weights=skin.weights[rows])

    base, garment = model_file(toy_model(scene), FABRICS["silk"], {}), scene.garment
    rows = np.append(np.arange(len(scene.classes)), 0)
    mesh = replace(garment.mesh, points=garment.mesh.points[rows])
    more = replace(garment, mesh=mesh, classes=scene.classes[rows], skin=garment.skin and longer(garment.skin))
    other = replace(scene, garment=more, rig=replace(scene.rig, skin=longer(scene.rig.skin)))
    with pytest.raises(SsilkError, match="another garment, rig or skeleton"):
        job(other, base, toy_motion(scene, 9), whole=whole)


def shifted(scene: Scene, by: float, loosened: int = 0) -> Scene:
    """The garment with every other vertex moved forwards [m], and so many pinned vertices made tight."""
    mesh, classes = scene.garment.mesh, scene.classes.copy()
    classes[:loosened] = TIGHT
    points = mesh.points.copy()
    points[::2, 2] += by
    return replace(scene, garment=replace(scene.garment, mesh=replace(mesh, points=points), classes=classes))


def test_a_whole_model_goes_on_where_its_garment_was_settled(scene, toy_model, toy_motion):
    """Within 10 cm, and with fewer pinned vertices; never the other way round, and never its stepper alone."""
    base = model_file(toy_model(scene), FABRICS["silk"], {})
    assert job(shifted(scene, 0.04, 3), base, toy_motion(scene, 9), whole=True).scene.classes[2] == TIGHT
    another, classes = "another garment, rig or skeleton", "3 vertices of another class"
    for other, whole, found in (
        (shifted(scene, 0.2), True, another),
        (shifted(scene, 0.04), False, another),
        (shifted(scene, 0, 3), False, classes),
    ):
        with pytest.raises(SsilkError, match=found):
            job(other, base, toy_motion(scene, 9), whole=whole)
    base = model_file(toy_model(shifted(scene, 0, 3)), FABRICS["silk"], {})
    with pytest.raises(SsilkError, match=f"{classes}.*give --over as it was trained"):
        job(scene, base, toy_motion(scene, 9), whole=True)


def test_loosened_vertices_stay_where_they_are_until_they_learn(scene, toy_model):
    before = toy_model(scene, scale=0.05)
    file = model_file(before, FABRICS["silk"], {})
    loosened = shifted(scene, 0, 3)
    known = on_moved_garment(file.parameters, scene, loosened, file.config)
    assert {name: value.shape for name, value in known.items()} == parameter_shapes(
        loosened, file.config, file.joints
    )
    after = GarmentModel(loosened, file.config, file.joints)
    after.load_state_dict({name: torch.from_numpy(value) for name, value in known.items()})
    z, character = torch.randn(4, file.config.latent), torch.eye(4)[:3].expand(3, 4, 3, 4).permute(0, 2, 3, 1)
    torch.testing.assert_close(after.vertices(z, character), before.vertices(z, character))


def test_a_settled_garment_is_seen_at_other_points_which_stand_in_for_those_before(scene, toy_model):
    """What a network sees alike at all points counts as before, and so does all that is no point."""
    trained = toy_model(scene, scheme="verlet", feedback_points=6, proximity_points=4, feedback_proxies=True)
    file = model_file(trained, FABRICS["silk"], {})
    other = shifted(scene, 0.08)
    before, after = (feedback_vertices(each, file.config) for each in (scene, other))
    assert not np.array_equal(before, after)
    known = on_moved_garment(file.parameters, scene, other, file.config)
    states, last = SCHEMES[file.config.scheme].states * file.config.latent, feedback_size(scene, file.config)
    for name, start, count in (
        ("initialiser.0.weight", 0, 4), (FIRST_WEIGHT, states, 4), (FIRST_WEIGHT, -last, 6),
    ):  # fmt: skip
        old, new = (part[name][:, start:][:, : 3 * count].reshape(-1, count, 3) for part in (file.parameters, known))
        np.testing.assert_allclose(new.sum(axis=1), old.sum(axis=1), atol=1e-6)
    proxies = last - 18
    np.testing.assert_array_equal(known[FIRST_WEIGHT][:, -proxies:], file.parameters[FIRST_WEIGHT][:, -proxies:])
    same = on_moved_garment(file.parameters, scene, scene, file.config)
    assert all(np.array_equal(value, same[name]) for name, value in file.parameters.items())


def test_a_whole_model_goes_on_as_it_is_and_all_of_it_learns(scene, toy_model, toy_motion):
    base = model_file(toy_model(scene, feedback_points=3), FABRICS["silk"], {})
    asked = job(scene, base, toy_motion(scene, 9), whole=True)
    assert asked.model == base.config and asked.train.static_iterations == 0
    assert asked.train.static_batch == TrainConfig().static_batch  # P learns, too
    parts = build_parts(replace(asked, train=replace(asked.train, recombinations=0, perturbations=0)), CPU)
    for name, parameter in parts.model.named_parameters():
        assert parameter.requires_grad
        assert torch.equal(parameter, torch.from_numpy(base.parameters[name]))
    assert parts.smoothing


@pytest.mark.parametrize(
    ("weight", "loose", "searched"), [(0.02, True, True), (0.0, True, False), (0.02, False, False)]
)
def test_contours_are_searched_for_where_cloth_is_loose(scene, toy_motion, weight, loose, searched):
    pytest.importorskip("igl")
    classes = scene.classes if loose else np.minimum(scene.classes, TIGHT)
    worn = replace(scene, garment=replace(scene.garment, classes=classes))
    asked = job(worn, None, toy_motion(scene, 9), latent=8, widths=(8,), shapes=2)
    train = replace(asked.train, recombinations=0, perturbations=0, intersection_weight=weight)
    contours = build_parts(replace(asked, train=train), CPU).validator.contours
    assert (contours is not None) == searched
    if contours:
        mass = (
            FABRICS["silk"].density * topology.vertex_areas(worn.garment.mesh.points, worn.garment.mesh.faces)
        ).sum()
        assert contours.tension == pytest.approx(weight * 9.81 * mass, rel=1e-3)
