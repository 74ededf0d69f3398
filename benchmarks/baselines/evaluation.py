# SPDX-License-Identifier: Apache-2.0
"""Baselines as methods of `ssilk_core.quality.evaluation`, beside models of 'ssilk train'."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from ssilk_core.cli.evaluate import OpenedModel
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.quality.evaluation.methods import Network, TakeSet

from .descriptors import joint_bank
from .files import KEY, load_network
from .networks import Baseline


def method_over(model: Baseline | GarmentModel, takes: TakeSet) -> Network:
    """Return a network over takes, with the descriptors that it takes."""
    if isinstance(model, Baseline):
        inner = torch.as_tensor(
            model.scene.character.skeleton.parents[model.joints] >= 0, device=takes.bank.root.device
        )
        takes = replace(takes, bank=joint_bank(takes.bank, inner, model.config.fps))
    return Network(model, takes)


def open_network(path: Path, _: Path, device: torch.device) -> OpenedModel:
    """Open a baseline or a model of 'ssilk train', whichever the file holds; both are for one body.

    The name is "ssilk", "snug", "ncs", or "ncs*" for an NCS that was trained with rotations.
    """
    file, model = load_network(path)
    told, name = file.provenance, "ssilk"
    if KEY in told:
        rotated = told.get("train", {}).get("rotated_fraction", 0) > 0
        name = told[KEY]["method"] + "*" * rotated
    return OpenedModel(path, file, name, partial(method_over, model.to(device)))
