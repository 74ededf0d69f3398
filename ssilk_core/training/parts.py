# SPDX-License-Identifier: Apache-2.0
"""Everything that a run needs on one device: tensors of the scene and the motions, and the network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from ..events import Message, Reporter, format_count, silent
from ..network import fabrics as of_fabrics
from ..network.bodies import completed, joined
from ..network.checkpoint import ModelFile, state_inputs
from ..network.descriptors import place_of_hub
from ..network.model.network import GarmentModel, model_joints
from ..network.parameters import on_moved_garment, seeing_more
from ..physics.collision import CollisionBody, limb_axes, reachable_body
from ..physics.constants import GRAVITY
from ..physics.energy import GarmentEnergy
from ..physics.energy.graded import GradedRest
from ..physics.intersections.cloth import ClothIntersections
from ..physics.intersections.contours import IntersectionContours
from ..physics.intersections.pairs import need_predicates
from ..scene.assets import Floats, Ints, Motion
from ..scene.fabric_range import FACTORS, FabricRange, ends, factors_of, inputs_of
from ..scene.family import motion_on, spread_points
from ..scene.kinematics import MAX_JOINT_SPEED
from .bodies import BodyWearer, DrawnBodies, FamilyBody
from .fabrics import FabricDrawer
from .family_bank import FamilyBank, build_family_bank
from .inner_garments import InnerGarments
from .job import TrainJob
from .memory import searches_contours
from .motion_bank import MotionBank, build_bank, usable_spans
from .objective import Objective
from .obstacles import ObstacleDrawer
from .parallel import SINGLE_PROCESS, ProcessGroup
from .settings import TrainConfig
from .shape_smoothing import ShapeSmoothing
from .step import Stepper
from .validation import ValidatedBody, ValidatedFabric, Validator
from .windows import WindowSampler

FIRST_WEIGHT = "stepper.0.weight"
VALIDATED = 4  # members of a family, beside its first, that models are validated on
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
    scene, skeleton, fps = job.scene, job.scene.character.skeleton, job.model.fps
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
    seen = len(FACTORS) if job.fabrics else 0
    model = GarmentModel(scene, job.model, joints, job.train.seed, job.family, seen)
    if job.base and job.whole:
        known = on_moved_garment(job.base.parameters, job.base.scene, scene, job.base.config)
        known = seeing_more(known, scene, job.base.config, job.model)
        if job.fabrics:
            learned = job.base.fabrics.columns if job.base.fabrics else of_fabrics.unseen(job.base.parameters)
            known = of_fabrics.joined(known, learned, state_inputs(job.model))
        if job.family:
            # To a model of one body coordinates count nothing yet.
            own = job.base.bodies.columns if job.base.bodies else {}
            known = joined(known, completed(own, known, job.family.bodies.size))
        model.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in known.items()})
    elif job.base:
        goes_on = _take_over(model, job.base)
        start = "goes on from that of the given model" if goes_on else "starts anew: it steps otherwise, or sees less"
        report(Message(f"the stepper {start}"))
    model = model.to(device)
    kind = job.model.descriptors
    bodies = job.family.bodies if job.family else None
    if bodies:
        bank: MotionBank = build_family_bank(
            motions, skeleton, joints, fps, device, bodies, max_joint_speed=MAX_JOINT_SPEED
        )
    else:
        bank = build_bank(motions, skeleton, joints, fps, device, max_joint_speed=MAX_JOINT_SPEED, kind=kind)
    held = build_bank(job.held_out, skeleton, joints, fps, device, kind=kind)
    energy = GarmentEnergy(scene.garment.rest_mesh, job.fabric, scene.classes, device=device)
    body, limbs, touched = scene.character.merged_body(), limb_axes(scene), None
    if len(vertices):
        touched = CollisionBody(body, skeleton.joint_count, vertices=vertices, limbs=limbs, device=device)
    shape = FamilyBody(touched, scene, bodies) if touched and bodies else None
    # Validation uses the whole body, to detect collisions with parts that training leaves out.
    whole = CollisionBody(body, skeleton.joint_count, limbs=limbs, device=device)
    rest, frames = model.decoder.rest.clone(), job.train.valid_frames  # the base's, whichever body steps are done on
    spans = usable_spans(job.held_out, skeleton, fps)
    contours = None
    if searches_contours(scene, job.train):
        tension = job.train.intersection_weight * GRAVITY * float(energy.mass.sum())
        contours = IntersectionContours(ClothIntersections.of(scene), scene.classes, tension, device)
    inner = None
    if job.over:
        listed = ", ".join(f"'{one.name}'" for one in job.over)
        report(Message(f"beneath it are put {listed}, and where it can touch them is found"))
        samples, beside = energy.cloth.samples, (bank, held, joints, kind)
        found = InnerGarments(job.over, scene, samples, motions, job.held_out, *beside, report)
        inner = found if len(found) else None
        if job.loosened:
            count = f"{job.loosened} pinned vertices lie over cloth that moves"
            report(Message(f"{scene.garment.mesh.path}: {count}: they are tight, so that it can push them out"))
    members = _validated_members(job, energy, joints, frames, device, group) if job.family else []
    fabrics = _validated_fabrics(job, held, whole, frames, device, group) if job.fabrics else []
    graded, measured = None, energy
    if job.family and scene.garment.graded:
        # Steps move its rest shape about, and what is validated on the first body needs that body's.
        measured = GarmentEnergy(scene.garment.rest_mesh, job.fabric, scene.classes, device=device)
        graded = GradedRest(energy, scene.garment.rest_mesh, job.family.cloth_moves)
    validator = Validator(
        held, measured, whole, scene, rest, fps, frames, group, spans, contours, inner, [*members, *fabrics]
    )
    smoothing = None if job.stepper_alone else ShapeSmoothing.of(model, job.train.shape_smoothing)
    if smoothing and not job.base:
        smoothing.smooth_start()  # a resumed run replaces it by what it has learned
    reached = len(vertices)
    return TrainingParts(
        model, bank, energy, touched, validator, reached, device, group, smoothing, inner, shape, graded, job.fabrics
    )


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


def _take_over(model: GarmentModel, base: ModelFile) -> bool:
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
