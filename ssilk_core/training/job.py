# SPDX-License-Identifier: Apache-2.0
"""The inputs of a training run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import fail
from ..network.checkpoint import ModelFile
from ..network.settings import PROXIMITY_POINTS, ModelConfig
from ..physics.energy.stretch import rest_frames
from ..scene.assets import LOOSE, PINNED, TIGHT, Motion, Scene
from ..scene.fabric_range import FabricRange
from ..scene.fabrics import Fabric
from ..scene.family import DressedFamily
from ..scene.mesh.stitches import find_stitches
from .inner_garments import InnerModel, loosened, need_wearable
from .perturb import perturb_motions
from .recombine import recombine_motions
from .settings import TrainConfig
from .state import family_digest, json_round_trip, scene_digest

STEPPER_SETTINGS = (
    "scheme", "descriptors", "max_latent_step", "feedback_points", "feedback_proxies", "stiffness",
    "velocity_allowance",
)  # fmt: skip
SAME = 1e-4  # [m], and without unit; model files may store single precision
FARTHEST_MOVED = 0.1  # [m] that rest points of a model that is trained on may have moved; settling moves less
MOST_POSES = 1_000_000  # of all training motions at the model's rate; only extra motions are left out for it


@dataclass(frozen=True, kw_only=True)
class TrainJob:
    """All inputs of a training run, reduced to what the scene needs.

    Garments without loose vertices are quasi-static in place of "spring_verlet": a stepper would add nothing to the
    initialiser. Other schemes stay, as in the paper.

    Attributes:
        scene: character with its body, garment, rig.
        motions, held_out: motions for training, and for validation.
        output: the model file to write; the run's other files go to the same folder.
        inputs: hashes of the input files by name, for the provenance.
        minutes: wall time to fill instead of the schedule's iterations; None for these. A resumed run may have more.
        base: a trained model of the same scene that training goes on from; None to train anew. That of a family may
            be of its first body alone, or of the same family.
        whole: whether all networks of `base` learn, with its settings, and its garment may have been moved.
            Otherwise its initialiser and decoder stay as they are while a new stepper learns.
        over: trained garments that are worn beneath this one, in some of the windows. What is pinned over cloth that
            moves becomes tight in `scene` (`inner_garments.loosened`).
        family: bodies to train for, the scene's as the base; None for that one alone. The garment in `scene` says
            whether it is graded to them.
        fabrics: range of fabrics to train for, as factors of `fabric`; None for that one alone.
        loosened: how many vertices become tight.
    """

    scene: Scene
    motions: Sequence[Motion]
    held_out: Sequence[Motion]
    model: ModelConfig
    train: TrainConfig
    fabric: Fabric
    output: Path
    device: str = "auto"
    resume: bool = False
    inputs: dict[str, str] | None = None
    minutes: float | None = None
    base: ModelFile | None = None
    whole: bool = False
    over: Sequence[InnerModel] = ()
    family: DressedFamily | None = None
    fabrics: FabricRange | None = None
    loosened: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        if self.family:
            self._need_family()
        elif self.scene.garment.graded:
            found = "a garment that is graded to bodies, and one body alone"
            fail(self.scene.garment.mesh.path, found, "a family has two or more", "name further bodies with --family")
        self._need_fabrics()
        if self.base and self.base.bodies and not self.family:
            found = "training that goes on from a model of a family of bodies, without the family"
            fail(
                self.scene.garment.mesh.path, found, "a model of one body trains on", "name its bodies with --family"
            )
        need_wearable(self.over, self.scene, self.model.fps)
        if self.over:
            keeps = self.base and not self.whole and np.array_equal(self.base.scene.classes, self.scene.classes)
            scene = self.scene if keeps else loosened(self.scene, self.over)  # a stepper alone has no shapes to learn
            object.__setattr__(self, "loosened", int((scene.classes != self.scene.classes).sum()))
            object.__setattr__(self, "scene", scene)
        if self.base:
            _need_same_scene(self.base, self.scene, moved=self.whole)
        if self.base and self.base.bodies and self.family:
            object.__setattr__(self, "family", self.family.along(self.base.bodies.family))
            _need_same_family(self.base, self.base.bodies.family, self.scene, self.family)
        if self.base and self.whole:
            object.__setattr__(self, "model", self.base.config)
            # P and D are trained.
            object.__setattr__(self, "train", replace(self.train, static_fraction=0, pretraining_batch=1))
        elif self.base:
            own = {name: getattr(self.model, name) for name in STEPPER_SETTINGS}
            object.__setattr__(self, "model", replace(self.base.config, **own))
            # There is no P to train on single poses.
            train = replace(self.train, static_fraction=0, pretraining_batch=1, static_batch=1, initial_loss=False)
            object.__setattr__(self, "train", train)
        if self.train.collider_fraction and not self.model.proximity_points:
            if self.stepper_alone:  # nor does P, which stays as it is
                object.__setattr__(self, "train", replace(self.train, collider_fraction=0))
            else:
                object.__setattr__(self, "model", replace(self.model, proximity_points=PROXIMITY_POINTS))
        if not self.base and self.model.proximity_points and not self.train.collider_fraction:
            found = f"proximity_points={self.model.proximity_points} and collider_fraction=0"
            fail("training", found, "a network learns what it sees", "give --set collider_fraction=0.25 as well")
        if not self.has_loose and self.model.scheme == "spring_verlet":
            object.__setattr__(self, "model", replace(self.model, scheme="quasi_static"))
        if self.model.scheme == "quasi_static":  # there are no previous states to vary
            object.__setattr__(self, "train", replace(self.train, state_reuse=0, noise=0))
        if not self.is_trainable:
            object.__setattr__(
                self,
                "model",
                replace(self.model, latent=1, widths=(1,), shapes=1, scheme="quasi_static", proximity_points=0),
            )
            least = replace(
                self.train,
                iterations=1,
                batch=1,
                pretraining_batch=1,
                static_batch=1,
                collider_fraction=0,
                recombinations=0,
                perturbations=0,
            )
            object.__setattr__(self, "train", least)
            object.__setattr__(self, "fabrics", None)  # pinned cloth is the same in all of them

    def _need_family(self) -> None:
        """Raise `SsilkError` where a family is asked for with what knows one body."""
        for found, there in (
            ("a stepper alone that learns", self.stepper_alone),
            ("garments beneath", bool(self.over)),
            ("newton_weight for a graded garment", self.scene.garment.graded and self.train.newton_weight > 0),
            (f"descriptors '{self.model.descriptors}'", self.model.descriptors != "relative"),
        ):
            if there:
                fail(self.scene.garment.mesh.path, f"{found} and a family of bodies", "one of both", "leave one out")
        assert self.family
        for name, coordinates in zip(self.family.bodies.names, self.family.bodies.members):
            if self.scene.garment.graded:
                mesh = self.family.scene_at(self.scene, coordinates).garment.rest_mesh
                rest_frames(replace(mesh, path=f"{mesh.path} on {name}"))  # each triangle has an area on each body

    def _need_fabrics(self) -> None:
        """Raise `SsilkError` where a range of fabrics is asked for with what knows one, or a base knows more."""
        where, known = self.scene.garment.mesh.path, self.base and self.base.fabrics
        if self.base and known and not self.fabrics:
            found = "training that goes on from a model of a range of fabrics, without the range"
            fail(where, found, "a model of one fabric trains on", "name the range with --fabrics")
        if self.base and known and replace(self.base.fabric, name="") != replace(self.fabric, name=""):
            found = f"fabric '{self.fabric.name}' and a model whose range is of factors of '{self.base.fabric.name}'"
            fail(where, found, "training goes on with the model's own fabric", "name that one")
        if not self.fabrics:
            return
        for found, there in (
            ("a stepper alone that learns", self.stepper_alone),
            (f"newton_weight={self.train.newton_weight:g}", self.train.newton_weight > 0),
        ):
            if there:
                fail(where, f"{found} and a range of fabrics", "one of both", "leave one out")

    @property
    def stepper_alone(self) -> bool:
        """Whether only the stepper learns."""
        return self.base is not None and not self.whole

    @property
    def has_loose(self) -> bool:
        """Whether the garment has loose vertices."""
        return bool((self.scene.classes == LOOSE).any())

    @property
    def is_trainable(self) -> bool:
        """Whether there is anything to learn; a garment that is pinned everywhere gets the smallest network."""
        return bool((self.scene.classes != PINNED).any())

    def extra_motions(self) -> tuple[int, int]:
        """Return how many motions are recombined from each, and how many are perturbed, so that all poses fit."""
        recombined, perturbed = self.train.recombinations, self.train.perturbations
        poses = sum(motion.frame_count / motion.fps for motion in self.motions) * self.model.fps
        fitting = min(recombined + perturbed, int(max(0.0, MOST_POSES / max(1.0, poses) - 1)))
        perturbed = ceil(fitting * perturbed / max(1, recombined + perturbed))
        return fitting - perturbed, perturbed

    def training_motions(self) -> list[Motion]:
        """Return the motions, and those recombined from them and perturbed."""
        skeleton, seed = self.scene.character.skeleton, self.train.seed
        recombinations, perturbations = self.extra_motions()
        more = recombine_motions(self.motions, skeleton, recombinations, seed)
        more += perturb_motions(self.motions, skeleton, perturbations, seed, self.train.tumbling)
        return [*self.motions, *more]

    def identity(self) -> dict[str, Any]:
        """Return the inputs that a resumed run must share, as JSON stores them; stitches of one island are none."""
        sewn = len(find_stitches(self.scene.garment.mesh)) > 0
        fabric = self.fabric if sewn else replace(self.fabric, stitch=0.0)
        return json_round_trip(
            {
                "model": asdict(self.model),
                "train": asdict(self.train),
                "fabric": asdict(fabric),
                "inputs": self.inputs or {},
                "motions": _frames(self.motions),
                "held out": _frames(self.held_out),
                "garment": self.scene.garment.mesh.path,
                "scene": scene_digest(self.scene),
                **({"over": {one.name: one.sha256 for one in self.over}} if self.over else {}),
                **({"family": family_digest(self.family, self.scene.garment.graded)} if self.family else {}),
                **({"fabrics": _stated(self.fabrics)} if self.fabrics else {}),
            }
        )


def _stated(fabrics: FabricRange) -> dict[str, Any]:
    """Return a range as runs compare it: without points where it names no preset, as runs of before have it."""
    return {name: value for name, value in asdict(fabrics).items() if value or name != "points"}


def _need_same_scene(base: ModelFile, scene: Scene, moved: bool) -> None:
    """Raise `SsilkError` unless a model was trained on this garment, with this rig and skeleton.

    Args:
        moved: whether the garment may lie elsewhere, as after it was settled, and be tight where it was pinned.
    """
    own, mesh = base.scene, scene.garment.mesh
    alike = own.joint_names == scene.joint_names and all(
        np.array_equal(mine, theirs)
        for mine, theirs in ((own.garment.mesh.faces, mesh.faces), (own.parents, scene.parents))
    )
    alike = alike and own.garment.mesh.points.shape == mesh.points.shape
    alike = alike and np.allclose(own.bind_transforms, scene.bind_transforms, atol=SAME)
    if alike:
        away = np.linalg.norm(own.garment.mesh.points - mesh.points, axis=1).max(initial=0)
        alike = away <= (FARTHEST_MOVED if moved else SAME)
    if not alike:
        fail(
            mesh.path,
            "another garment, rig or skeleton than the given model was trained on",
            "training goes on from a model of the same scene"
            + (f", whose rest points may have moved by {1000 * FARTHEST_MOVED:g} mm" if moved else ""),
            "train anew",
        )
    changed = own.classes != scene.classes
    if moved:
        changed &= ~((own.classes == PINNED) & (scene.classes == TIGHT))
    if changed.any():
        fail(
            mesh.path,
            f"{int(changed.sum())} vertices of another class than in the given model",
            "training goes on with the same classes" + (", but that pinned cloth may become tight" if moved else ""),
            "give --over as it was trained, or train anew",
        )


def _need_same_family(base: ModelFile, own: DressedFamily, scene: Scene, family: DressedFamily) -> None:
    """Raise `SsilkError` unless a model was trained for these bodies; it stores few points of them.

    The garment may lie elsewhere on each, as after it was settled.
    """
    where = scene.garment.mesh.path
    mine, theirs = own.bodies, family.bodies
    alike = mine.members.shape == theirs.members.shape and mine.joints.shape == theirs.joints.shape
    alike = alike and mine.counts == theirs.counts  # else it may lack points that the model knows
    alike = alike and all(
        np.allclose(here, there, atol=SAME)
        for here, there in (
            (mine.members, theirs.members),
            (mine.joint_moves, theirs.joint_moves),
            (mine.point_moves, theirs.point_moves[:, mine.rows]),
        )
    )
    if not alike:
        found = "another family of bodies than the given model was trained for"
        fail(where, found, "training goes on for the same one", "name the same stages in the same order")
    for name, at in zip(theirs.names, theirs.members):
        before, after = own.scene_at(base.scene, at), family.scene_at(scene, at)
        away = np.linalg.norm(after.garment.mesh.points - before.garment.mesh.points, axis=1).max(initial=0)
        if away > FARTHEST_MOVED:
            found = f"its garment lies up to {1000 * away:.0f} mm off where the given model has it on {name}"
            allowed = f"rest points may have moved by {1000 * FARTHEST_MOVED:g} mm"
            fail(where, found, allowed, "settle it as it was, or train anew")


def _frames(motions: Sequence[Motion]) -> dict[str, list[tuple[float, int, float]]]:
    """Return (first frame, number of frames, rate) of the motions by path, which names the prim."""
    found: dict[str, list[tuple[float, int, float]]] = {}
    for motion in motions:
        found.setdefault(motion.path, []).append((motion.start, motion.frame_count, motion.fps))
    return found


def split_motions(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Return 80 % of the clips to train on and 20 % to validate on, spread evenly; one clip is cut in two."""
    if len(motions) == 1:
        cut = int(motions[0].frame_count * 0.8)
        if not cut > 0:
            fail(motions[0].path, "one motion of one frame", "longer motions are needed to train")
        return [motions[0].clip(0, cut)], [motions[0].clip(cut, motions[0].frame_count)]
    held = set(range(4, len(motions), 5)) or {len(motions) - 1}
    return [m for i, m in enumerate(motions) if i not in held], [m for i, m in enumerate(motions) if i in held]
