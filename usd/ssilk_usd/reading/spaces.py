# SPDX-License-Identifier: Apache-2.0
"""Convert between the spaces of a stage's skeleton and the core.

A stage has three relevant spaces. *World space* is what a viewer shows. *Skeleton space* is the local space of the
Skeleton prim. *Bind space* is the space of `bindTransforms`, and of meshes after `geomBindTransform`. UsdSkel
defines it as world space at bind time, but many exporters write skeleton space. `SkelSource` distinguishes the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints
from ssilk_core.scene.kinematics import world_transforms

from ..opening.stage import location
from ..units import StageUnits, scaling
from .joint_scales import divided

_RIGID_TOLERANCE = 1e-3
_TILTED = 0.5  # cosine between the up axes of skeleton and stage below which they differ


@dataclass(frozen=True, eq=False)
class SkelSource:
    """A skeleton as authored, including proxies, with its transforms to the core's spaces.

    Attributes:
        stage: referenced here because prims do not keep their stage alive.
        root, prim: the SkelRoot and the Skeleton.
        units: units of the stage.
        joints, parents: UsdSkel joint paths and parent indices, -1 for roots, length N.
        bind, rest: joint to bind space, joint to parent; stage units, column vectors, shape (N, 4, 4).
        placement: skeleton space to world at the earliest time, a similarity, shape (4, 4).
        owners: path of the garment mesh that each joint is a proxy of; empty for the character's own joints.
        scales: by which each joint's space is scaled in the stage, shape (N,); `bind` and `rest` are without it.
    """

    stage: Usd.Stage
    root: Usd.Prim
    prim: Usd.Prim
    units: StageUnits
    joints: tuple[str, ...]
    parents: Ints
    bind: Floats
    rest: Floats
    placement: Floats
    owners: tuple[str, ...]
    scales: Floats

    @property
    def character_joints(self) -> Ints:
        """Indices of the joints that are not proxies, shape (J,)."""
        return np.flatnonzero([not owner for owner in self.owners])

    @property
    def joint_scale(self) -> float:
        """Metres per unit of length in joint and skeleton space [m]."""
        return similarity_scale(self.placement) * self.units.meters_per_unit

    def unscaled(self, posed: Floats) -> Floats:
        """Return joints as USD poses them (..., N, 4, 4), without the scale of their spaces."""
        return divided(posed, self.scales)

    @property
    def bind_to_core(self) -> Floats:
        """Bind space to the core's bind space [m], a similarity, shape (4, 4).

        Lengths are those of the posed character in world space. The y axis points up, by the up axis of the stage. If
        the character's xforms rotate its bind space by 90 degrees, as exporters do to convert axes, this rotation is
        undone.
        """
        matrix = np.eye(4)
        matrix[:3, :3] = self.units.rotation @ self._tilt() * self.joint_scale / self._bind_scale
        return matrix

    @property
    def skeleton_to_world(self) -> Floats | None:
        """Skeleton space to the core's world [m], (4, 4), where xforms above it place it; None elsewhere."""
        return self.units.matrix @ self.placement if (self.placement != np.eye(4)).any() else None

    @property
    def world_to_bind(self) -> Floats:
        """World to bind space for the character's placement at the earliest time, shape (4, 4)."""
        return self._skeleton_to_bind() @ np.linalg.inv(self.placement)

    def binds_to_core(self, bind: Floats) -> Floats:
        """Return bind transforms (..., 4, 4) in the core's bind space [m]."""
        return self.bind_to_core @ bind @ scaling(1 / self.joint_scale)

    def binds_from_core(self, bind: Floats) -> Floats:
        """Return the core's bind transforms (..., 4, 4) in the stage's bind space."""
        return np.linalg.inv(self.bind_to_core) @ bind @ scaling(self.joint_scale)

    @property
    def _bind_scale(self) -> float:
        """Scale of the bind transforms: 1, or the character's scale if they are in world space."""
        determinants = np.linalg.det(self.bind[:, :3, :3])
        scale = float(np.cbrt(determinants.mean()))
        common = scale > 0 and np.allclose(determinants, scale**3, rtol=_RIGID_TOLERANCE)
        return scale if common else 1.0

    def _skeleton_to_bind(self) -> Floats:
        """Skeleton space to bind space: the transform from rest to bind pose if a single one exists."""
        rest = world_transforms(self.rest, self.parents)
        matrix = self.bind[0] @ np.linalg.inv(rest[0])
        size = np.abs(self.bind[:, :3, 3]).max() + self._bind_scale
        agree = np.abs(matrix @ rest - self.bind).max() < _RIGID_TOLERANCE * size
        return matrix if agree else scaling(self._bind_scale)

    def _tilt(self) -> Floats:
        """Rotation by 90 degrees in the stage's axes that makes bind space upright, or the identity, shape (3, 3)."""
        linear = np.linalg.inv(self.world_to_bind)[:3, :3]
        stage_up = self.units.rotation.T @ np.array([0.0, 1.0, 0.0])
        up = linear.T @ stage_up / np.cbrt(np.linalg.det(linear))
        if abs(up @ stage_up) > _TILTED:
            return np.eye(3)
        axis = np.argmax(np.abs(up))
        up = np.eye(3)[axis] * np.sign(up[axis])
        side = np.cross(up, stage_up)
        return np.stack([side, stage_up, np.cross(side, stage_up)]).T @ np.stack([side, up, np.cross(side, up)])


def joints_to_core(
    local: Floats, parents: Ints, placement: Floats, units: StageUnits, scale: float | None = None
) -> Floats:
    """Return joint-to-parent transforms in metres, y up, with the placement applied to the roots.

    Args:
        local: joint to parent in stage units, column vectors, shape (..., J, 4, 4).
        parents: index of each joint's parent, -1 for roots, shape (J,).
        placement: skeleton space to world, similarities, shape (4, 4) or (..., 4, 4).
        units: units of the stage.
        scale: uniform scale of all placements; by default that of the first.
    """
    scale = (similarity_scale(placement) if scale is None else scale) * units.meters_per_unit
    result = np.array(local, dtype=np.float64)
    result[..., :3, 3] *= scale
    roots = np.flatnonzero(np.asarray(parents) < 0)
    world = units.matrix @ placement[..., None, :, :] @ local[..., roots, :, :]
    result[..., roots, :, :] = world @ scaling(1 / scale)
    return result


def similarity_scale(matrices: Floats) -> float:
    """Return the uniform scale of a similarity (4, 4), or of the first of several (..., 4, 4)."""
    first = matrices.reshape(-1, 4, 4)[0]
    return float(np.cbrt(np.linalg.det(first[:3, :3])))


def need_similarity(prim: Usd.Prim, matrices: Floats) -> Floats:
    """Return the world matrices of a skeleton, shape (..., 4, 4), after a check that all have one uniform scale.

    Raises:
        SsilkError: they mirror, shear, scale non-uniformly, or change scale over time.
    """
    linear, scale = matrices[..., :3, :3], similarity_scale(matrices)
    uniform = np.abs(np.swapaxes(linear, -1, -2) @ linear - np.eye(3) * scale**2) < _RIGID_TOLERANCE * scale**2
    if not (scale > 0 and uniform.all()):
        fail(
            location(prim),
            "the xforms above the skeleton mirror, shear, animate scale or scale non-uniformly",
            "they may only translate, rotate and scale uniformly by a constant factor",
            "apply the scale and export again",
        )
    return matrices
