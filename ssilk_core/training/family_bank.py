# SPDX-License-Identifier: Apache-2.0
"""The motions of a training run on every body of a family.

Joints turn alike on all bodies, between bones of other lengths (`scene.family.motion_on`). Skinning matrices keep
their rotations, and their positions are linear in a body's coordinates. So are positions and accelerations of joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..network.descriptors import SATURATION, accelerations, place_of_hub
from ..scene.assets import Floats, Motion, Skeleton
from ..scene.family import BodyFamily, motion_on
from ..scene.kinematics import motion_transforms, resample, skinning_matrices
from .motion_bank import MotionBank, arrays_of, bank_tensors, needed_spans


@dataclass(frozen=True, eq=False)
class FamilyBank(MotionBank):
    """A `MotionBank` of the base, and what a unit along each of K directions adds to it.

    Attributes:
        place: coordinates of the body that it is on, shape (K,); `wear` changes them in place.
        matrix_moves: of the positions in skinning matrices [m], shape (F, K, J * 3).
        root_moves: of the hub's positions [m], shape (F, K, 3).
        raw: accelerations before they saturate, shape (F, 3 J'); raw_moves: of these, shape (F, K, 3 J').
    """

    place: Tensor
    matrix_moves: Tensor
    root_moves: Tensor
    raw: Tensor
    raw_moves: Tensor

    def wear(self, place: Tensor) -> None:
        """Play on the body at coordinates (K,)."""
        self.place.copy_(place)

    def _added(self, moves: Tensor) -> Tensor:
        return torch.einsum("...kn,k->...n", moves, self.place)

    def matrices_at(self, frames: Tensor) -> Tensor:
        """Return skinning matrices (..., J * 12) of frame indices (...,) on the body."""
        matrices = self.matrices[frames].unflatten(-1, (-1, 3, 4))
        moved = self._added(self.matrix_moves[frames]).unflatten(-1, (-1, 3, 1))
        return torch.cat([matrices[..., :3], matrices[..., 3:] + moved], dim=-1).flatten(-3)

    def root_at(self, frames: Tensor | slice) -> Tensor:
        """Return the hub's positions (N, 3) in frames (N,) on the body [m]."""
        return self.root[frames] + self._added(self.root_moves[frames])

    def dynamic_at(self, frames: Tensor) -> Tensor:
        """Return what `dynamic` has of frames (N,) on the body, shape (N, D)."""
        raw = self.raw[frames] + self._added(self.raw_moves[frames])
        others = self.dynamic[frames][:, : -raw.shape[1]]
        return torch.cat([others, SATURATION * torch.tanh(raw / SATURATION)], dim=1)


def build_family_bank(
    motions: Sequence[Motion],
    skeleton: Skeleton,
    joints: np.ndarray,
    fps: float,
    device: torch.device,
    family: BodyFamily,
    *,
    max_joint_speed: float = np.inf,
) -> FamilyBank:
    """Return what `build_bank` returns, on the base of a family and on all its other bodies.

    Raises:
        SsilkError: there is no motion.
    """

    def arrays(span: Motion) -> dict[str, np.ndarray]:
        clip = resample(span, fps)
        return {**arrays_of(clip, skeleton, joints, "relative"), **_family_arrays(clip, skeleton, joints, family)}

    spans = needed_spans(motions, skeleton, fps, max_joint_speed)
    place = torch.zeros(family.size, device=device)
    return FamilyBank(**bank_tensors(map(arrays, spans), device), place=place)


def _family_arrays(clip: Motion, skeleton: Skeleton, joints: np.ndarray, family: BodyFamily) -> dict[str, np.ndarray]:
    """Return what a `FamilyBank` has of the frames of one clip beside those of the base, by name, float32.

    Rotations are the same on all bodies, so that only positions are summed anew along chains of joints.
    """
    world = motion_transforms(clip, skeleton.parents)
    turned = skinning_matrices(world, skeleton.bind_transforms)[..., :3, :3]
    hub, root = skeleton.hub, world[:, joints[place_of_hub(skeleton, joints)], :3, :3]
    moves: list[tuple[Floats, Floats, Floats]] = []
    for unit, taller in zip(np.eye(family.size), family.taller):
        other = family.skeleton_at(skeleton, unit)
        local = motion_on(clip, skeleton, other, 1 + taller).translations - clip.translations
        moved = np.zeros_like(local)
        for joint, parent in enumerate(skeleton.parents):
            own = local[:, joint]
            if parent >= 0:
                own = moved[:, parent] + np.einsum("fab,fb->fa", world[:, parent, :3, :3], own)
            moved[:, joint] = own
        bound = other.bind_transforms[:, :3, 3] - skeleton.bind_transforms[:, :3, 3]
        centred = moved - moved[:1, hub, None]
        skins = centred - np.einsum("fjab,jb->fja", turned, bound)
        raw = accelerations(moved[:, joints], root, clip.fps)
        moves.append((skins.reshape(len(skins), -1), centred[:, hub], raw))
    stacked = [np.stack(each, axis=1).astype(np.float32) for each in zip(*moves)]
    own = accelerations(world[:, joints][..., :3, 3], root, clip.fps).astype(np.float32)
    return {**dict(zip(("matrix_moves", "root_moves", "raw_moves"), stacked)), "raw": own}
