# SPDX-License-Identifier: Apache-2.0
"""Garments beneath the one that is trained: what it lies on besides the body.

Each inner garment plays by its own trained network, which stays as it is, over the same poses and under the same
gravity: in the windows of dynamic training it rolls along, in single poses it is in its quasi-static state. It sees
the obstacles that the outer garment meets. So the outer garment meets what it will be baked with. An inner garment is
there in a share `WORN` of the windows and poses, drawn for each by itself, so that the outer one also learns to be
worn without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..errors import fail
from ..events import Message, Reporter, silent
from ..network.checkpoint import ModelFile, load_model, network
from ..network.descriptors import place_of_hub
from ..network.model.network import GarmentModel
from ..physics.collision import Contacts, PosedBody
from ..physics.collision.inner_cloth import InnerCloth, Planes, loosened_over
from ..physics.intersections.layers import ClothLayers, LayerCounts
from ..physics.intersections.pairs import need_predicates
from ..physics.reach import reachable_cloth
from ..physics.samples import ContactSamples
from ..scene.assets import PINNED, Motion, Scene, Skeleton
from ..scene.kinematics import MAX_JOINT_SPEED
from .motion_bank import MotionBank, build_bank, roll_states
from .obstacles import Near, ObstacleDrawer, Obstacles
from .windows import WindowSampler

WORN = 0.75
SAME_BIND = 1e-3  # [m] between joints' positions, and between entries of rotations


@dataclass(frozen=True, eq=False)
class InnerModel:
    """A trained garment to be worn beneath the one that is trained.

    Attributes:
        name: of its file, without the suffix; of its folder where another model of the training has that one.
        sha256: of its file.
    """

    name: str
    sha256: str
    file: ModelFile

    @classmethod
    def load_all(cls, paths: Sequence[Path], output: Path) -> list[InnerModel]:
        """Read those of a training that writes a model to `output`; raise `SsilkError` as `load` does."""
        stems = [path.stem for path in (*paths, output)]
        alike = [stems.count(path.stem) > 1 for path in paths]
        return [cls.load(path, path.absolute().parent.name if shared else None) for path, shared in zip(paths, alike)]

    @classmethod
    def load(cls, path: Path, name: str | None = None) -> InnerModel:
        """Read one from a file, by that name or by its own.

        Raises:
            SsilkError: as `load_model` does, or it is a model of a family of bodies, of which this does not know the
                one that it is worn on.
        """
        from ..files import sha256

        digest, file = sha256(path) if path.is_file() else "", load_model(path)
        if file.bodies:
            found = "a model of a family of bodies"
            fail(f"--over {path}", found, "a garment is trained over models of one body", "train it for that body")
        return cls(name or path.stem, digest, file)


def loosened(scene: Scene, inner: Sequence[InnerModel]) -> Scene:
    """Return the scene of an outer garment that is tight where it was pinned over cloth that moves (`loosened_over`).

    Raises:
        SsilkError: libigl is missing.
    """
    if (scene.classes == PINNED).any():
        need_predicates()
    return loosened_over(scene, [each.file.scene for each in inner])


def need_wearable(inner: Sequence[InnerModel], scene: Scene, fps: float) -> None:
    """Raise `SsilkError` unless inner models were trained for the character of a scene, at a rate [1/s].

    Names tell them apart, so each has one of its own.
    """
    for number, model in enumerate(inner):
        if model.name in [other.name for other in inner[:number]]:
            fail(f"--over {model.name}", "two inner models of this name", "each is named once", "rename one")
        if model.file.config.fps != fps:
            found = f"it plays at {model.file.config.fps:g} frames per second"
            fail(
                f"--over {model.name}",
                found,
                f"the outer garment plays at {fps:g}",
                f"train it with --set fps={fps:g}",
            )
        found = other_character(model.file.scene.character.skeleton, scene.character.skeleton)
        if found:
            allowed = "inner and outer garments are trained on one character"
            fail(f"--over {model.name}", found, allowed, f"train it on {scene.character.path}")


def other_character(own: Skeleton, skeleton: Skeleton) -> str:
    """Return how the skeleton of an inner model differs; empty where it does not."""
    if own.joint_names != skeleton.joint_names:
        other = next((name for name in own.joint_names if name not in skeleton.joint_names), "")
        return f"a skeleton with the joint '{other}'" if other else "a skeleton with other joints, or another order"
    if not np.allclose(own.bind_transforms, skeleton.bind_transforms, atol=SAME_BIND):
        return "a skeleton that is bound elsewhere"
    return ""


@dataclass(frozen=True, eq=False)
class _Garment:
    """One inner garment: its network, the motions and obstacles as it sees them, and its surface.

    Attributes:
        sight: tells what it sees of obstacles; None where it sees none.
    """

    model: GarmentModel
    bank: MotionBank
    held: MotionBank
    cloth: InnerCloth
    sight: ObstacleDrawer | None

    def near(self, obstacles: Obstacles | None, frames: Tensor, down: Tensor) -> Near | None:
        """Return what is near in frames (N,) under gravity and wind (N, 3) [g]; None where it sees nothing."""
        return None if obstacles is None or self.sight is None else self.sight.near(obstacles, frames, down)

    def static(self, frames: Tensor, down: Tensor, near: Near | None) -> Tensor:
        """Return static descriptors (N, S) of frames (N,), with the proximity of obstacles where there are any."""
        static = self.bank.static_descriptor(frames, down)
        if near is None or self.sight is None:
            return static
        return torch.cat([self.sight.seen(near, frames), static], dim=1)

    def positions(self, z: Tensor, character: Tensor) -> Tensor:
        """Decode latents (N, latent) to the positions (W, 3, N) that the outer garment can touch [m]."""
        return self.model.vertices(z, character).index_select(0, self.cloth.vertices)


@dataclass(frozen=True, eq=False)
class Beneath:
    """Inner garments in N frames: positions (W, 3, N) of each [m], and where it is worn, bool (N,)."""

    positions: list[Tensor]
    worn: list[Tensor]


class InnerGarments:
    """The inner garments of a training run, on its device.

    Attributes:
        names: of those that the outer garment can touch; others are left out.
        layers: what counts how the outer garment lies over each.
        vertex_count: of theirs that can be touched.

    Args:
        scene: of the outer garment, on its character.
        samples: of the outer garment.
        motions, held: motions to train on, and to validate on.
        bank, held_bank: the same as the outer garment sees them.
        joints: of the character, in its descriptors.
        kind: of these.
    """

    def __init__(
        self,
        inner: Sequence[InnerModel],
        scene: Scene,
        samples: ContactSamples,
        motions: Sequence[Motion],
        held: Sequence[Motion],
        bank: MotionBank,
        held_bank: MotionBank,
        joints: np.ndarray,
        kind: str,
        report: Reporter = silent,
    ) -> None:
        device, skeleton = bank.static.device, scene.character.skeleton
        self.names: list[str] = []
        self.layers: list[ClothLayers] = []
        outer, body = scene.garment.mesh, scene.character.merged_body().mesh
        self._garments: list[_Garment] = []
        for each in inner:
            beneath = replace(each.file.scene, character=scene.character)
            every = [*motions, *held]
            touched = reachable_cloth(scene, beneath, every)
            touching = reachable_cloth(beneath, scene, every) if touched.any() else np.zeros(0, dtype=bool)
            if not touched.any():
                report(Message(f"'{each.name}' is left out: the garment cannot reach it in these motions"))
                continue
            mesh, thickness = beneath.garment.mesh, each.file.fabric.thickness
            cloth = InnerCloth(scene, samples, mesh, thickness, touched, touching, device=device)
            model = network(each.file, beneath).to(device).requires_grad_(False)
            own = each.file.joints, model.config.descriptors
            banks = bank, held_bank
            if not (np.array_equal(own[0], joints) and own[1] == kind):
                fps = model.config.fps
                banks = (
                    _sharing(bank, motions, skeleton, *own, fps, MAX_JOINT_SPEED),
                    _sharing(held_bank, held, skeleton, *own, fps, np.inf),
                )
            self.names.append(each.name)
            self.layers.append(ClothLayers((outer.path.rpartition("/")[2], each.name), outer, mesh, body))
            sight = None
            if model.proximity:
                hub = place_of_hub(skeleton, model.joints)
                sight = ObstacleDrawer(model, banks[0], hub, 0.0, torch.Generator(device))  # it draws none
            self._garments.append(_Garment(model, *banks, cloth, sight))
            self._tell_beneath(each.name, cloth, scene, samples, mesh.points, report)
        self.vertex_count = sum(len(one.cloth.vertices) for one in self._garments)
        self._states: dict[int, list[Tensor]] = {}

    def __len__(self) -> int:
        return len(self._garments)

    @staticmethod
    def _tell_beneath(
        name: str, cloth: InnerCloth, scene: Scene, samples: ContactSamples, points: np.ndarray, report: Reporter
    ) -> None:
        """Warn where the outer garment begins beneath an inner one."""

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=cloth.rows.device)[:, :, None]

        x, y = tensor(samples.points(scene.garment.mesh.points)), tensor(points)[cloth.vertices]
        found = int((cloth.distance(x, y)[: scene.garment.mesh.vertex_count] < 0).sum())
        if found:
            count = f"{found} of its {scene.garment.mesh.vertex_count} vertices lie beneath '{name}' in the bind pose"
            todo = "training pushes out those that move; 'ssilk inspect --over' settles all of them off it before"
            report(Message(f"{scene.garment.mesh.path}: {count}; {todo}", "warning"))

    def attach(self, sampler: WindowSampler) -> None:
        """Let a sampler keep the states of the inner garments from window to window."""
        count, device = sampler.config.batch, sampler.first.device
        for number, one in enumerate(self._garments):
            sampler.inner |= {
                f"inner.{number}.latents": torch.zeros(2, count, one.model.config.latent, device=device),
                f"inner.{number}.worn": torch.ones(count, dtype=torch.bool, device=device),
            }

    @torch.no_grad()
    def poses(
        self, frames: Tensor, single_down: Tensor, generator: torch.Generator, obstacles: Obstacles | None = None
    ) -> Beneath:
        """Return quasi-static inner garments in single poses (M,) under gravity and wind (M, 3) [g].

        Args:
            obstacles: in these poses, which they see as the outer garment does.
        """
        positions, worn = [], []
        for one in self._garments:
            z = one.model.initial(one.static(frames, single_down, one.near(obstacles, frames, single_down)))
            positions.append(one.positions(z, one.bank.character(frames)))
            worn.append(_drawn(len(frames), generator, frames.device))
        return Beneath(positions, worn)

    @torch.no_grad()
    def window(
        self,
        sampler: WindowSampler,
        frames: Tensor,
        single_down: Tensor,
        single_obstacles: Obstacles | None = None,
    ) -> Beneath:
        """Roll along one window of every slot, and keep the states for the next.

        Args:
            frames, single_down: single poses beside the windows (M,), and their gravity and wind (M, 3) [g].
            single_obstacles: around these, where there are any.

        Returns:
            The garments in the frames of the windows from the third on, then in the single poses.
        """
        length, batch = sampler.config.window, sampler.config.batch
        device = sampler.first.device
        times = sampler.first + torch.arange(length, device=device)[:, None]
        down = sampler.gravity().flatten(0, 1)
        single = self.poses(frames, single_down, sampler.generator, single_obstacles)
        obstacles = sampler.obstacles and sampler.obstacles.repeated(length)
        positions, worn = [], []
        for number, one in enumerate(self._garments):
            kept, is_worn = (sampler.inner[f"inner.{number}.{name}"] for name in ("latents", "worn"))
            bank, flat = one.bank, times.reshape(-1)
            near = one.near(obstacles, flat, down)
            static = one.static(flat, down, near)
            pose = bank.described(static, flat, down, _headings(sampler, bank, down))
            target = one.model.initial(static).reshape(length, batch, -1)
            start = torch.where(sampler.carried[None, :, None], kept, target[:2])
            body = bank.body(times)
            if near is not None:
                body = near.stopping(body, one.model.feedback.stopped, length)
            z = one.model.roll([*start], target[2:], pose.reshape(length, batch, -1)[2:], body)
            here = torch.where(sampler.carried, is_worn, _drawn(batch, sampler.generator, device))
            kept.copy_(torch.stack(z[-2:]))
            is_worn.copy_(here)
            moving = one.positions(torch.cat(z[2:]), bank.character(flat[2 * batch :]))
            positions.append(torch.cat([moving, single.positions[number]], dim=-1))
            worn.append(torch.cat([here.repeat(length - 2), single.worn[number]]))
        return Beneath(positions, worn)

    def deeper(self, planes: Planes, x: Tensor, beneath: Beneath) -> Planes:
        """Return planes of samples x (S, 3, N), replaced where a sample is deeper in an inner garment."""
        for one, y, worn in zip(self._garments, beneath.positions, beneath.worn, strict=True):
            planes = one.cloth.deeper(planes, x, y, worn)
        return planes

    @torch.no_grad()
    def held(self, clip: range, clips: Sequence[range], frames: Tensor, down: Tensor) -> Beneath:
        """Return all inner garments, all worn, in frames of a clip to validate on.

        Args:
            clip: one of `clips`, or another range of the bank.
            frames: from the clip's start, (N,).
            down: direction of gravity, (3,).
        """
        every = enumerate(self._garments)
        positions = [
            self._posed(number, clip, clips, frames, down).index_select(0, one.cloth.vertices)
            for number, one in every
        ]
        here = torch.ones(len(frames), dtype=torch.bool, device=frames.device)
        return Beneath(positions, [here] * len(self._garments))

    def _posed(self, number: int, clip: range, clips: Sequence[range], frames: Tensor, down: Tensor) -> Tensor:
        """Return all of an inner garment in frames of a clip to validate on [m], shape (V, 3, N)."""
        one = self._garments[number]
        if number not in self._states:
            self._states[number] = roll_states(one.model, one.held, clips, down)
        first = next(at for at, whole in enumerate(clips) if whole.start <= clip.start < whole.stop)
        states = self._states[number][first][clip.start - clips[first].start + frames]
        return one.model.vertices(states, one.held.character(clip.start + frames))

    @torch.no_grad()
    def counts(
        self, x: Tensor, clip: range, clips: Sequence[range], frames: Tensor, down: Tensor, numbers: Sequence[int]
    ) -> list[LayerCounts]:
        """Count how an outer garment x (V, 3, N) lies over each inner one in frames of a clip, as `held` takes them.

        Args:
            numbers: of the frames, by which they are told.
        """

        def listed(points: Tensor) -> list[np.ndarray]:
            return list(points.permute(2, 0, 1).double().cpu().numpy())

        return [
            layers.counts(listed(x), listed(self._posed(number, clip, clips, frames, down)), numbers)
            for number, layers in enumerate(self.layers)
        ]

    def over(self, contacts: Contacts, beneath: Beneath) -> LayeredContacts:
        """Return contacts with the body and with inner garments."""
        return LayeredContacts(self, contacts, beneath)


@dataclass(frozen=True, eq=False)
class LayeredContacts:
    """Distances to the body, or to inner garments where these are nearer."""

    inner: InnerGarments
    body: Contacts
    beneath: Beneath

    def distances(self, x: Tensor, posed: PosedBody) -> tuple[Tensor, Tensor]:
        """Return what `Contacts.distances` does, where the first counts inner garments."""
        contact, nearest = self.body.distances(x, posed)
        for one, y in zip(self.inner._garments, self.beneath.positions, strict=True):
            contact = contact.minimum(one.cloth.contact_distance(x, y))
        return contact, nearest


def _drawn(count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    return torch.rand(count, generator=generator, device=device) < WORN


def _headings(sampler: WindowSampler, bank: MotionBank, down: Tensor) -> Tensor | None:
    """Return how the frames of windows are turned about gravity, for absolute descriptors; None for relative ones."""
    if not bank.is_absolute:
        return None
    if sampler.heading is not None:
        return sampler.heading.repeat(sampler.config.window, 1)
    return torch.eye(3, device=down.device)[0].expand_as(down)


def _sharing(
    bank: MotionBank, motions: Sequence[Motion], skeleton: Skeleton, joints: np.ndarray, kind: str, fps: float,
    max_joint_speed: float,
) -> MotionBank:  # fmt: skip
    """Return the bank of the same motions as other descriptors see them; the character's poses are shared."""
    device = bank.static.device
    own = build_bank(motions, skeleton, joints, fps, device, max_joint_speed=max_joint_speed, kind=kind)
    return replace(own, matrices=bank.matrices, root=bank.root)
