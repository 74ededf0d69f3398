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
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import TIGHT
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.mesh import topology
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import FIRST_WEIGHT, _take_over, build_parts
from ssilk_core.training.settings import TrainConfig

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
    assert _take_over(model, base)
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
    assert _take_over(model, base)
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
    assert not _take_over(new, base)
    assert torch.equal(new.stepper[0].weight, fresh)


def test_a_model_of_another_garment_is_refused(scene, toy_model, toy_scene, toy_motion):
    base = model_file(toy_model(toy_scene(proxies=0)), FABRICS["silk"], {})
    with pytest.raises(SsilkError, match="another garment, rig or skeleton"):
        job(scene, base, toy_motion(scene, 9))


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
