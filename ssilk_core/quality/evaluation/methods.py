# SPDX-License-Identifier: Apache-2.0
"""What can be evaluated, behind one protocol: networks, linear blend skinning, point caches and the simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...network.latent_solver import LatentOptions
from ...network.latent_solver.shots import LatentShots
from ...network.model.network import GarmentModel
from ...physics.collision import CollisionBody, Contacts, limb_axes
from ...physics.constants import GRAVITY
from ...physics.energy import GarmentEnergy
from ...physics.energy.stretch import deformation_gradient_operator
from ...physics.intersections.cloth import ClothIntersections
from ...physics.simulate import SimulationOptions, Simulator, simulate
from ...physics.skin.covered_skin import CoveredSkin
from ...physics.skinning import Skinning
from ...scene.assets import PINNED, Floats, Scene
from ...scene.fabrics import Fabric
from ...scene.kinematics import first_place
from ...training.motion_bank import LatentModel, MotionBank, build_bank, roll_states
from .minimum import minima
from .takes import Take

PINNED_TOLERANCE = 0.02  # [m], of pinned vertices of a point cache

Reader = Callable[[str, range], Floats]
"""Returns the points of frames of a clip in the world [m], shape (frames, V, 3)."""


class Method(Protocol):
    """A garment over takes. Positions are relative to the root of each take's first frame, as in a motion bank."""

    def vertices(self, take: int, frames: range) -> Tensor:
        """Return positions [m] of consecutive frames of a take, shape (V, 3, N)."""
        ...

    def still(self, take: int, frames: range) -> Tensor | None:
        """Return the method's own static states of these poses [m], (V, 3, N); None where it has none."""
        ...


@dataclass(frozen=True, eq=False)
class EvaluatedMethod:
    """A method under a name.

    Attributes:
        joints: of the character, which the takes' descriptors are of.
        on: returns the method over takes.
        descriptors: their kind, as `ModelConfig` has it.
    """

    name: str
    joints: np.ndarray
    on: Callable[[TakeSet], Method]
    descriptors: str = "relative"


class EvaluationScene:
    """A garment on its whole character, and what measures it.

    Args:
        scene: with every body mesh, reachable or not.
        fps: of every method.
        exact: tight cloth collides with the nearest point of the body beneath it, as in the simulator, rather than
            of the triangles around the nearest vertex, as in training.
        character: its name, where there are several.

    Attributes:
        columns: maps positions to both columns of all deformation gradients.
        weight: m g L, the garment's weight times its height at rest [J].
    """

    def __init__(
        self,
        scene: Scene,
        fabric: Fabric,
        fps: float,
        device: torch.device,
        *,
        exact: bool = False,
        character: str = "",
    ) -> None:
        mesh = scene.garment.mesh
        self.character = character
        self.scene, self.fabric, self.fps, self.device, self.exact = scene, fabric, fps, device, exact
        rest = scene.garment.rest_mesh
        self.energy = GarmentEnergy(rest, fabric, scene.classes, device=device)
        self.columns = deformation_gradient_operator(rest, device, torch.float32)
        body, joints = scene.character.merged_body(), scene.character.skeleton.joint_count
        self.body = CollisionBody(body, joints, limbs=limb_axes(scene), device=device)
        self.contacts = Contacts(scene, self.energy.cloth.samples, device=device)
        self.skin = Skinning(scene.lbs_skin).to(device)
        self.rest = torch.tensor(mesh.points, dtype=torch.float32, device=device)
        self.weight = float(self.energy.mass.sum()) * GRAVITY * float(np.ptp(mesh.points[:, 1]))

    @property
    def prim(self) -> str:
        """Name of the garment's prim."""
        return self.scene.garment.mesh.path.rpartition("/")[2]

    @property
    def name(self) -> str:
        """That name, with the character's in front where there are several: "heavy/Cape"."""
        return f"{self.character}/{self.prim}" if self.character else self.prim

    @cached_property
    def covered(self) -> CoveredSkin:
        """The skin that the garment covers in the bind pose."""
        return CoveredSkin(self.scene, device=self.device)

    @cached_property
    def intersections(self) -> ClothIntersections:
        """What finds triangles of the garment that intersect others of it."""
        return ClothIntersections.of(self.scene)

    @cached_property
    def simulator(self) -> Simulator:
        """The reference simulator of this garment."""
        return Simulator(self.scene, self.fabric, SimulationOptions(fps=self.fps), device=self.device)

    def lbs(self, character: Tensor) -> Tensor:
        """Return linear blend skinning's positions (V, 3, N) [m] of skinning matrices (J, 3, 4, N)."""
        return self.skin(self.rest, None, self.skin.weights, character)


@dataclass(frozen=True, eq=False)
class TakeSet:
    """Takes of one garment's character on a device; clip `i` of the bank is take `i`."""

    takes: tuple[Take, ...]
    bank: MotionBank
    origins: tuple[Floats, ...]

    def frames(self, take: int, frames: range) -> Tensor:
        """Return indices into the bank of frames of a take, shape (N,)."""
        first = int(self.bank.starts[take])
        return torch.arange(first + frames.start, first + frames.stop, device=self.bank.root.device)

    def character(self, take: int, frames: range) -> Tensor:
        """Return skinning matrices (J, 3, 4, N) of frames of a take."""
        return self.bank.character(self.frames(take, frames))

    def local(self, take: int, points: Floats) -> Tensor:
        """Return points in the world (N, V, 3) about the root of a take's first frame, shape (V, 3, N)."""
        local = points - self.origins[take]
        return torch.as_tensor(local.transpose(1, 2, 0).copy(), dtype=torch.float32, device=self.bank.root.device)


def build_take_set(
    takes: Sequence[Take], dressed: EvaluationScene, joints: np.ndarray, descriptors: str = "relative"
) -> TakeSet:
    """Return takes with their descriptors of these joints, of a kind that `ModelConfig` has.

    Raises:
        SsilkError: there is no take.
    """
    need_takes(takes)
    skeleton = dressed.scene.character.skeleton
    motions = [take.motion for take in takes]
    bank = build_bank(motions, skeleton, joints, dressed.fps, dressed.device, kind=descriptors)
    assert len(bank.starts) == len(takes)
    return TakeSet(tuple(takes), bank, tuple(first_place(take.motion, skeleton) for take in takes))


def need_takes(takes: Sequence[Take]) -> None:
    """Raise `SsilkError` where there is no take."""
    if not takes:
        fail("clips", "none of four frames or more", "one at least is needed", "name longer ones")


class LatentStates:
    """States of a model over all takes, wherever they come from.

    Args:
        states: latents of each take, shape (F, m).
    """

    def __init__(self, model: LatentModel, take_set: TakeSet, states: Sequence[Tensor]) -> None:
        self.model, self.take_set, self.states = model, take_set, states
        self.down = torch.tensor([0.0, -1.0, 0.0], device=take_set.bank.root.device)

    @torch.no_grad()
    def vertices(self, take: int, frames: range) -> Tensor:
        states = self.states[take][frames.start : frames.stop]
        return self.model.vertices(states, self.take_set.character(take, frames))

    @torch.no_grad()
    def still(self, take: int, frames: range) -> Tensor:
        bank, index = self.take_set.bank, self.take_set.frames(take, frames)
        quiet = self.model.initial(bank.static_descriptor(index, self.down.expand(len(index), 3)))
        return self.model.vertices(quiet, self.take_set.character(take, frames))


class Network(LatentStates):
    """A recurrent network, rolled over all takes in one batch, each from its static state."""

    def __init__(self, model: LatentModel, take_set: TakeSet) -> None:
        bank = take_set.bank
        clips = [range(int(start), int(stop)) for start, stop in zip(bank.starts, bank.stops)]
        down = torch.tensor([0.0, -1.0, 0.0], device=bank.root.device)
        super().__init__(model, take_set, roll_states(model, bank, clips, down))


class SolvedNetwork(LatentStates):
    """The solver in a model's latents, over all takes in one batch, each from its static state.

    Args:
        model: on the device of the takes, and on the character that their motions move.
        fabric: of its garment.
        advanced: called after each frame of the longest take.

    Attributes:
        lost: frames whose energy was not finite, and that the network's static state replaces.
    """

    model: GarmentModel

    def __init__(
        self,
        model: GarmentModel,
        fabric: Fabric,
        options: LatentOptions,
        take_set: TakeSet,
        advanced: Callable[[], object] = lambda: None,
    ) -> None:
        takes = take_set.takes
        order = sorted(range(len(takes)), key=lambda take: -takes[take].frame_count)
        states: list[list[Tensor]] = [[] for _ in takes]
        self.lost = 0
        for frame in LatentShots(model, fabric, options).frames([takes[take].motion for take in order]):
            for take, z in zip(order, frame.solution.z.to(take_set.bank.root.dtype)):
                states[take].append(z)
            self.lost += int(frame.lost.sum())
            advanced()
        super().__init__(model, take_set, [torch.stack(each) for each in states])


class LinearBlendSkinning:
    """The LBS baseline."""

    def __init__(self, dressed: EvaluationScene, take_set: TakeSet) -> None:
        self.dressed, self.take_set = dressed, take_set

    def vertices(self, take: int, frames: range) -> Tensor:
        return self.dressed.lbs(self.take_set.character(take, frames))

    def still(self, take: int, frames: range) -> None:
        return None


class CachedPoints:
    """Points from files, written by a simulator or by anything else.

    Args:
        read: gives the points of a clip at the rate of the takes.
    """

    def __init__(self, read: Reader, dressed: EvaluationScene, take_set: TakeSet) -> None:
        self.read, self.dressed, self.take_set = read, dressed, take_set
        self.pinned = torch.as_tensor((dressed.scene.classes == PINNED).nonzero()[0], device=dressed.device)

    def vertices(self, take: int, frames: range) -> Tensor:
        """Return positions as `Method.vertices` does.

        Raises:
            SsilkError: pinned vertices are not where the skeleton puts them, because the cache is of another motion.
        """
        played = self.take_set.takes[take]
        points = self.read(played.clip, range(played.first + frames.start, played.first + frames.stop))
        x = self.take_set.local(take, points)
        self._check(x, take, frames)
        return x

    def _check(self, x: Tensor, take: int, frames: range) -> None:
        lbs = self.dressed.lbs(self.take_set.character(take, frames))
        away = (x - lbs)[self.pinned].norm(dim=1)
        far = float(away.max()) if away.numel() else 0.0
        if not far < PINNED_TOLERANCE:
            fail(
                self.take_set.takes[take].clip,
                f"in the point cache, pinned vertices are {far:.3g} m from where this motion puts them",
                f"{PINNED_TOLERANCE:g} m are allowed",
                "simulate this motion on this character",
            )

    def still(self, take: int, frames: range) -> None:
        return None


class Simulated:
    """The reference simulator itself, over all takes in one batch."""

    def __init__(self, dressed: EvaluationScene, take_set: TakeSet) -> None:
        self.dressed, self.take_set = dressed, take_set
        scene, motions = dressed.scene, [take.motion for take in take_set.takes]
        options, device = dressed.simulator.options, dressed.device
        self.points = simulate(scene, dressed.fabric, motions, options, device=device)

    def vertices(self, take: int, frames: range) -> Tensor:
        return self.take_set.local(take, self.points[take][frames.start : frames.stop])

    def still(self, take: int, frames: range) -> Tensor:
        motion = self.take_set.takes[take].motion
        ends = [Take("", 0, motion.clip(0, frame + 1)) for frame in frames]
        found = minima(self.dressed.simulator, ends, self.vertices(take, frames))
        origin = torch.as_tensor(
            first_place(motion, self.dressed.scene.character.skeleton), device=self.dressed.device
        )
        return (found.x + found.poses.root - origin[:, None]).float()
