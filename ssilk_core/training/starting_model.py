# SPDX-License-Identifier: Apache-2.0
"""The network that a training starts with: new, or with what a given model has learned."""

from __future__ import annotations

import torch
from torch import nn

from ..events import Message, Reporter
from ..network import fabrics as of_fabrics
from ..network.bodies import completed, joined
from ..network.checkpoint import ModelFile, state_inputs
from ..network.model.network import GarmentModel
from ..network.parameters import on_moved_garment, seeing_more
from ..scene.assets import Floats, Ints
from ..scene.fabric_range import FACTORS
from .job import TrainJob

FIRST_WEIGHT = "stepper.0.weight"


def starting_model(job: TrainJob, joints: Ints, report: Reporter) -> GarmentModel:
    """Return the network of a training, which sees some joints; of a given model it says where its stepper starts."""
    model = GarmentModel(job.scene, job.model, joints, job.train.seed, job.family, len(FACTORS) if job.fabrics else 0)
    if job.base and job.whole:
        known = _whole(job, job.base)
        model.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in known.items()})
    elif job.base:
        goes_on = take_over(model, job.base)
        start = "goes on from that of the given model" if goes_on else "starts anew: it steps otherwise, or sees less"
        report(Message(f"the stepper {start}"))
    return model


def _whole(job: TrainJob, base: ModelFile) -> dict[str, Floats]:
    """Return all parameters of a given model as those of the job's network, which may see more, or more bodies."""
    known = on_moved_garment(base.parameters, base.scene, job.scene, base.config)
    known = seeing_more(known, job.scene, base.config, job.model)
    if job.fabrics:
        learned = base.fabrics.columns if base.fabrics else of_fabrics.unseen(base.parameters)
        known = of_fabrics.joined(known, learned, state_inputs(job.model))
    if job.family:
        # To a model of one body coordinates count nothing yet.
        own = base.bodies.columns if base.bodies else {}
        known = joined(known, completed(own, known, job.family.bodies.size))
    return known


def take_over(model: GarmentModel, base: ModelFile) -> bool:
    """Give a network the initialiser and decoder of a trained one, and no gradients to them.

    The stepper starts as the trained one where it sees no less than that: what it saw comes first, and more of the
    cloth counts nothing yet.

    Returns:
        Whether it does.
    """
    learns = ("stepper.", "integrator.")
    kept = {name: torch.from_numpy(value.copy()) for name, value in base.parameters.items()}
    own, before = model.config, base.config
    alike = all(getattr(own, name) == getattr(before, name) for name in ("scheme", "descriptors", "feedback_proxies"))
    more_points = own.feedback_points - before.feedback_points
    # Proxies come after points.
    goes_on = alike and (more_points == 0 or (more_points > 0 and not own.feedback_proxies))
    if goes_on and FIRST_WEIGHT in kept:
        more = model.get_parameter(FIRST_WEIGHT).shape[1] - kept[FIRST_WEIGHT].shape[1]
        kept[FIRST_WEIGHT] = nn.functional.pad(kept[FIRST_WEIGHT], (0, more))
    model.load_state_dict(
        {name: value for name, value in kept.items() if goes_on or not name.startswith(learns)}, strict=False
    )
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name.startswith(learns))
    return goes_on
