# SPDX-License-Identifier: Apache-2.0
"""Everything that a run needs on one device: tensors of the scene and the motions, and the network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..events import Message, Reporter, format_count, silent
from ..network.descriptors import model_joints, place_of_hub
from ..network.model.network import GarmentModel
from ..physics.collision import CollisionBody, limb_axes
from ..physics.energy import GarmentEnergy
from ..physics.energy.graded import GradedRest
from ..physics.intersections.pairs import need_predicates
from ..physics.reach import reachable_body
from ..scene.assets import Floats, Ints, Motion
from ..scene.fabric_range import FabricRange
from ..scene.family import motion_on
from ..scene.kinematics import MAX_JOINT_SPEED
from .bodies import BodyWearer, DrawnBodies, FamilyBody
from .fabrics import FabricDrawer
from .family_bank import FamilyBank, build_family_bank
from .inner_garments import InnerGarments
from .job import TrainJob
from .motion_bank import MotionBank, build_bank
from .objective import Objective
from .obstacles import ObstacleDrawer
from .parallel import SINGLE_PROCESS, ProcessGroup
from .settings import TrainConfig
from .shape_smoothing import ShapeSmoothing
from .starting_model import starting_model
from .step import Stepper
from .validation import Validator
from .validators import build_validator
from .windows import WindowSampler

POSED_AT_ONCE = 1024  # frames, to find limbs that do not count


@dataclass(frozen=True, eq=False)
class TrainingParts:
    """What a run keeps when it restarts with another batch.

    Attributes:
        bank: the motions to train on.
        body: the part of the body that the garment can touch, with `reached` vertices; None for nothing.
        inner: garments beneath; None where there are none that the garment can touch.
        energy: that steps are done with, and `validator` measures with its own.
        shape: gives `body` the shape of any body of a family; None for one body.
        graded: gives `energy` the rest shape there; None where it is one for all bodies.
        fabrics: range of those that are drawn; None for the energy's own alone.
    """

    model: GarmentModel
    bank: MotionBank
    energy: GarmentEnergy
    body: CollisionBody | None
    validator: Validator
    reached: int
    device: torch.device
    group: ProcessGroup = SINGLE_PROCESS
    smoothing: ShapeSmoothing | None = None
    inner: InnerGarments | None = None
    shape: FamilyBody | None = None
    graded: GradedRest | None = None
    fabrics: FabricRange | None = None

    @cached_property
    def buried(self) -> Tensor | None:
        """Limbs that do not count in each frame of the bank, bool (L, F): found once, not in each step."""
        if self.body is None or self.body.limbs is None:
            return None
        every = torch.arange(self.bank.frame_count, device=self.device).split(POSED_AT_ONCE)
        return torch.cat([self.body.limbs.buried(self.bank.character(frames)) for frames in every], dim=1)

    def detail(self) -> dict[str, object]:
        """Return figures about the run, for messages."""
        scene = self.model.scene
        return {
            "garment": scene.garment.mesh.path,
            "vertices": scene.garment.mesh.vertex_count,
            "proxies": scene.rig.proxy_count,
            "blendshapes": self.model.config.shapes,
            "joints in view": len(self.model.joints),
            "body vertices": self.reached,
            **({"over": ", ".join(self.inner.names)} if self.inner else {}),
            "parameters": sum(value.numel() for value in self.model.parameters()),
            "device": str(self.device),
            "processes": self.group.size,
        }

    def stepper(self, config: TrainConfig, seed: int) -> Stepper:
        """Return a new stepper with its own seed; a group of processes shares the batch."""
        group, own = self.group, self.group.local_config(config)
        generator = torch.Generator(self.device).manual_seed(group.seed(seed))
        drawer, family = None, self.model.family
        if self.graded and family:  # a run that restarts leaves it on some body, and weights count from the first
            self.graded.wear(torch.zeros(family.bodies.size, device=self.device))
        if self.model.proximity and own.collider_fraction:
            hub = place_of_hub(self.model.scene.character.skeleton, self.model.joints)
            known = family.bodies if family else None
            drawer = ObstacleDrawer(self.model, self.bank, hub, own.collider_fraction, generator, known)
        cloth = None
        if self.fabrics:
            cloth = FabricDrawer(self.fabrics, self.energy.fabric, generator, self.device)
        sampler = WindowSampler(self.bank, own, self.model.config.latent, generator, drawer, cloth)
        surface = config.closest_point == "triangles"
        objective = Objective(
            self.model, self.energy, self.body, self.bank, surface, config.newton_weight, config.clearance,
            self.buried if surface else None, config.contact_patches, self.validator.contours, self.inner,
            drawer,
        )  # fmt: skip
        if self.inner:
            self.inner.attach(sampler)
        average = group.average if group.size > 1 else None
        bodies = None
        if family:
            assert isinstance(self.bank, FamilyBank)
            known_to = (self.model, self.bank, objective, self.shape, self.graded, drawer)
            wearers: list[BodyWearer] = [each for each in known_to if each]
            bodies = DrawnBodies(family.bodies, wearers, seed, self.device)
        return Stepper(self.model, objective, sampler, own, average, self.smoothing, bodies)


def build_parts(
    job: TrainJob, device: torch.device, group: ProcessGroup = SINGLE_PROCESS, report: Reporter = silent
) -> TrainingParts:
    """Build what a run needs, and say before each long part what is done.

    Raises:
        SsilkError: the motions are too short, or libigl is missing where `intersection_weight` needs it.
    """
    scene, skeleton = job.scene, job.scene.character.skeleton
    if job.train.intersection_weight or job.over:
        need_predicates()
    motions, extra = job.training_motions(), job.extra_motions()
    if extra != (job.train.recombinations, job.train.perturbations):
        report(Message("{} recombined and {} perturbed motions are added for each, as many as fit".format(*extra)))
    every = [*motions, *job.held_out]
    report(Message(f"the body is posed in {format_count(len(every), 'motions')}, to find what the garment can touch"))
    vertices, moving = _reachable(job, every)
    joints = job.base.joints if job.base else model_joints(scene, moving)
    report(Message(f"the network and its inputs are built on {device}"))
    model = starting_model(job, joints, report).to(device)
    bank = _training_bank(job, motions, joints, device)
    held = build_bank(job.held_out, skeleton, joints, job.model.fps, device, kind=job.model.descriptors)
    energy = GarmentEnergy(scene.garment.rest_mesh, job.fabric, scene.classes, device=device)
    touched, shape, graded = None, None, None
    if len(vertices):
        body, limbs = scene.character.merged_body(), limb_axes(scene)
        touched = CollisionBody(body, skeleton.joint_count, vertices=vertices, limbs=limbs, device=device)
    if touched and job.family:
        shape = FamilyBody(touched, scene, job.family.bodies)
    rest = model.decoder.rest.clone()  # the base's, whichever body steps are done on
    inner = _inner_garments(job, energy, motions, bank, held, joints, report) if job.over else None
    validator = build_validator(job, held, energy, rest, joints, inner, device, group)
    if job.family and scene.garment.graded:
        graded = GradedRest(energy, scene.garment.rest_mesh, job.family.cloth_moves)
    smoothing = None if job.stepper_alone else ShapeSmoothing.of(model, job.train.shape_smoothing)
    if smoothing and not job.base:
        smoothing.smooth_start()  # a resumed run replaces it by what it has learned
    return TrainingParts(
        model, bank, energy, touched, validator, len(vertices), device, group, smoothing, inner, shape, graded,
        job.fabrics,
    )  # fmt: skip


def _training_bank(job: TrainJob, motions: Sequence[Motion], joints: Ints, device: torch.device) -> MotionBank:
    """Return the motions to train on, on all bodies of a family where there is one."""
    given = motions, job.scene.character.skeleton, joints, job.model.fps, device
    if job.family:
        return build_family_bank(*given, job.family.bodies, max_joint_speed=MAX_JOINT_SPEED)
    return build_bank(*given, max_joint_speed=MAX_JOINT_SPEED, kind=job.model.descriptors)


def _inner_garments(
    job: TrainJob, energy: GarmentEnergy, motions: Sequence[Motion], bank: MotionBank, held: MotionBank, joints: Ints,
    report: Reporter,
) -> InnerGarments | None:  # fmt: skip
    """Return the garments beneath, and say what they loosen; None where the garment can touch none of them."""
    scene, kind = job.scene, job.model.descriptors
    listed = ", ".join(f"'{one.name}'" for one in job.over)
    report(Message(f"beneath it are put {listed}, and where it can touch them is found"))
    samples, beside = energy.cloth.samples, (bank, held, joints, kind)
    found = InnerGarments(job.over, scene, samples, motions, job.held_out, *beside, report)
    if job.loosened:
        count = f"{job.loosened} pinned vertices lie over cloth that moves"
        report(Message(f"{scene.garment.mesh.path}: {count}: they are tight, so that it can push them out"))
    return found if len(found) else None


def _reachable(job: TrainJob, motions: Sequence[Motion]) -> tuple[Ints, Floats]:
    """Return the vertices of the body that the garment can touch on some member, and flags of what moves these."""
    reach = reachable_body(job.scene, motions)
    vertices, joints = reach.vertices, reach.joints
    if not job.family:
        return vertices, joints
    bodies, base = job.family.bodies, job.scene.character.skeleton
    for coordinates in bodies.members[1:]:
        other = job.family.scene_at(job.scene, coordinates)
        skeleton = other.character.skeleton
        ratio = bodies.height_ratio(coordinates)
        reach = reachable_body(other, [motion_on(motion, base, skeleton, ratio) for motion in motions])
        vertices, joints = np.union1d(vertices, reach.vertices), np.logical_or(joints, reach.joints)
    return vertices, joints
