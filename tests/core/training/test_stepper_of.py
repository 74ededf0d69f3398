# SPDX-License-Identifier: Apache-2.0
"""A new stepper for a trained model: what is kept, what learns, and whose it may be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import _keep_all_but_the_stepper
from ssilk_core.training.settings import TrainConfig


def job(scene, base, motion) -> TrainJob:
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=ModelConfig(latent=99, feedback_points=5),
        train=TrainConfig(), fabric=FABRICS["silk"], output=Path("out.safetensors"), base=base,
    )  # fmt: skip


def test_initialiser_and_decoder_are_kept_and_the_stepper_alone_learns(scene, toy_model, toy_motion):
    base = model_file(toy_model(scene, feedback_points=0), FABRICS["silk"], {})
    asked = job(scene, base, toy_motion(scene, 9))
    assert asked.model == replace(base.config, feedback_points=5)
    assert asked.train.static_iterations == 0
    model = GarmentModel(scene, asked.model, base.joints, 7)
    _keep_all_but_the_stepper(model, base)
    for name, parameter in model.named_parameters():
        learns = name.startswith(("stepper.", "integrator."))
        assert parameter.requires_grad == learns
        if not learns:
            assert torch.equal(parameter, torch.from_numpy(base.parameters[name]))
    assert model.stepper[0].in_features == base.parameters["stepper.0.weight"].shape[1] + 15


def test_a_model_of_another_garment_is_refused(scene, toy_model, toy_scene, toy_motion):
    base = model_file(toy_model(toy_scene(proxies=0)), FABRICS["silk"], {})
    with pytest.raises(SsilkError, match="another garment, rig or skeleton"):
        job(scene, base, toy_motion(scene, 9))
