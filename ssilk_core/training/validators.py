# SPDX-License-Identifier: Apache-2.0
"""What a training is validated on: its held-out motions, and further bodies of a family and fabrics of a range."""

from __future__ import annotations

import torch
from torch import Tensor

from ..physics.collision import CollisionBody, limb_axes
from ..physics.constants import GRAVITY
from ..physics.energy import GarmentEnergy
from ..physics.intersections.cloth import ClothIntersections
from ..physics.intersections.contours import IntersectionContours
from ..scene.assets import Ints
from ..scene.fabric_range import FACTORS, ends, factors_of, inputs_of
from ..scene.family import motion_on, spread_points
from .inner_garments import InnerGarments
from .job import TrainJob
from .memory import searches_contours
from .motion_bank import MotionBank, build_bank, usable_spans
from .parallel import ProcessGroup
from .validation import ValidatedBody, ValidatedFabric, Validator

VALIDATED = 4  # members of a family, beside its first, that models are validated on


def build_validator(
    job: TrainJob, held: MotionBank, energy: GarmentEnergy, rest: Tensor, joints: Ints, inner: InnerGarments | None,
    device: torch.device, group: ProcessGroup,
) -> Validator:  # fmt: skip
    """Return what measures models of a job.

    Args:
        held: the held-out motions.
        energy: that steps are done with.
        rest: of the decoder, on the first body.
        joints: that the network sees.
        inner: garments beneath.
    """
    scene, skeleton, fps, frames = job.scene, job.scene.character.skeleton, job.model.fps, job.train.valid_frames
    # The whole body, to detect collisions with parts that training leaves out.
    body = scene.character.merged_body()
    whole = CollisionBody(body, skeleton.joint_count, limbs=limb_axes(scene), device=device)
    contours = None
    if searches_contours(scene, job.train):
        tension = job.train.intersection_weight * GRAVITY * float(energy.mass.sum())
        contours = IntersectionContours(ClothIntersections.of(scene), scene.classes, tension, device)
    members = _validated_members(job, energy, joints, frames, device, group) if job.family else []
    fabrics = _validated_fabrics(job, held, whole, frames, device, group) if job.fabrics else []
    if job.family and scene.garment.graded:
        # Steps move its rest shape about, and what is validated on the first body needs that body's.
        energy = GarmentEnergy(scene.garment.rest_mesh, job.fabric, scene.classes, device=device)
    spans = usable_spans(job.held_out, skeleton, fps)
    return Validator(
        held, energy, whole, scene, rest, fps, frames, group, spans, contours, inner, [*members, *fabrics]
    )


def _validated_members(
    job: TrainJob, energy: GarmentEnergy, joints: Ints, frames: int, device: torch.device, group: ProcessGroup
) -> list[ValidatedBody]:
    """Return those members of a family, its first left out, that models are validated on as well.

    They are the ones farthest apart, and together they have as many frames as the first.
    """
    assert job.family
    bodies, base, found = job.family.bodies, job.scene.character.skeleton, []
    chosen = [row for row in spread_points(bodies.members, 1 + VALIDATED) if row]
    for row in chosen:
        coordinates = bodies.members[row]
        scene = job.family.scene_at(job.scene, coordinates)
        skeleton, ratio = scene.character.skeleton, bodies.height_ratio(coordinates)
        motions = [motion_on(motion, base, skeleton, ratio) for motion in job.held_out]
        bank = build_bank(motions, skeleton, joints, job.model.fps, device)
        body = CollisionBody(
            scene.character.merged_body(), skeleton.joint_count, limbs=limb_axes(scene), device=device
        )
        rest = torch.tensor(scene.garment.mesh.points, dtype=torch.float32, device=device)
        part = max(1, frames // len(chosen))
        place = torch.tensor(coordinates, dtype=torch.float32, device=device)
        if scene.garment.graded:
            energy = GarmentEnergy(scene.garment.rest_mesh, job.fabric, scene.classes, device=device)
        validator = Validator(bank, energy, body, scene, rest, job.model.fps, part, group)
        found.append(ValidatedBody(bodies.names[row], place, validator))
    return found


def _validated_fabrics(
    job: TrainJob, held: MotionBank, body: CollisionBody, frames: int, device: torch.device, group: ProcessGroup
) -> list[ValidatedFabric]:
    """Return the fabrics at the ends of a range, which models are validated in as well.

    Together they have as many frames as the model's own.
    """
    assert job.fabrics
    scene, chosen, found = job.scene, ends(job.fabric, job.fabrics), []
    rest = torch.tensor(scene.garment.mesh.points, dtype=torch.float32, device=device)
    for fabric in chosen:
        factors = factors_of(job.fabric, fabric)
        energy = GarmentEnergy(scene.garment.rest_mesh, fabric, scene.classes, device=device)
        part = max(1, frames // len(chosen))
        validator = Validator(held, energy, body, scene, rest, job.model.fps, part, group)
        seen = torch.tensor(inputs_of(factors), dtype=torch.float32, device=device)
        density = float(factors[FACTORS.index("density")])
        found.append(ValidatedFabric(f"fabric {fabric.name}", seen, validator, density))
    return found
