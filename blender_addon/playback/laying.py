# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment of a family of bodies, laid on the body that its character has, wherever its mesh and its proxies are.

The garment and its bones stay as the artist has them: as on the family's first body, or as they were carried. A shape
key that is always on takes the mesh to where the model has it on this body. Proxies that rest elsewhere than the
model's move so that they skin alike. One whose rest is off by d, in its own axes, is at its place and R d, where R is
its rotation, less what its parent is off where that is a proxy, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ssilk_core.scene.assets import GarmentPose
from ssilk_core.scene.kinematics import local_transforms, matrix_from_quaternion

from ..arrays.joints import Joints
from ..errors import SetupError
from ..scene.objects import scene_units
from ..scene.shapes import earlier_shapes

MOVED = 1e-4  # how far rest points may be from those that were trained on, as a share of the garment's size
TURNED = 1e-3  # how far the axes and places of bones may be
CARRIED = 0.03  # [m] that a garment which was carried onto a body in another way may be off


@dataclass(frozen=True, eq=False)
class Laid:
    """How a garment is brought to where its model has it on a body.

    Attributes:
        offsets: of its vertices from the artist's shape, in its own space, shape (V, 3); None where it lies there.
        shifts: how far proxies of the armature rest off the model's, in their own axes [m], shape (P, 3).
        above: likewise of their parents, zero for bones of the character, shape (P, 3).
        rests: where the model's proxies are at rest in their parents' axes [m], shape (P, 3).
    """

    offsets: np.ndarray | None
    shifts: np.ndarray
    above: np.ndarray
    rests: np.ndarray

    @property
    def moves_proxies(self) -> bool:
        """Whether proxies rest elsewhere than the model's."""
        return bool(self.shifts.any())

    def places(self, rotations: np.ndarray, pose: GarmentPose, proxies: np.ndarray) -> np.ndarray:
        """Return where proxies are in their parents' axes [m], shape (F, P, 3).

        Args:
            rotations: of each to its parent, unit quaternions (w, x, y, z), shape (F, P, 4).
            pose: of the model.
            proxies: where each stands among those of the pose, -1 for none, shape (P,).
        """
        places = np.tile(self.rests, (len(rotations), 1, 1))
        there = proxies >= 0
        if pose.translations is not None:
            places[:, there] = pose.translations[:, proxies[there]]
        return places + (matrix_from_quaternion(rotations) @ self.shifts[..., None])[..., 0] - self.above


def lay(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    joints: Joints,
    skinned: SkinnedGarment,
    order: np.ndarray,
    base: np.ndarray,
) -> Laid:
    """Return how a garment is brought to where its model has it on the body of its armature.

    Args:
        skinned: the garment on that body.
        order: where each joint stands among the trained ones, -1 for none, shape (J,).
        base: the garment's points on the first body of its family [m], shape (V, 3).

    Raises:
        SetupError: bones of the character or axes of proxies are others, or the garment is neither where it lies on
            the first body nor near where it lies on this one.
    """
    need_same_count(garment, skinned)
    back = moved_back(armature, joints.character, skinned, order[: joints.character_count])
    to_trained = back @ scene_units().matrix @ np.array(garment.matrix_world)
    variants = [points @ to_trained[:3, :3].T + to_trained[:3, 3] for points in earlier_shapes(garment)]
    on_base, on_body = (min(variants, key=lambda points: away(points, goal)) for goal in (base, skinned.points))
    near = MOVED * size(skinned)
    if away(on_body, skinned.points) <= near:
        offsets = None
    elif away(on_base, base) <= near:
        offsets = skinned.points - on_base
    elif away(on_body, skinned.points) <= CARRIED:
        offsets = skinned.points - on_body
    else:
        raise SetupError(
            f"'{garment.name}' lies neither as on the first body of its model's family nor within "
            f"{1000 * CARRIED:.0f} mm of where it lies on that of '{armature.name}'; give it the shape and place "
            "that it has on the first."
        )
    if offsets is not None:
        offsets = offsets @ np.linalg.inv(to_trained[:3, :3]).T
    return Laid(offsets, *_proxies(armature, joints, skinned, order, back))


def _proxies(
    armature: bpy.types.Object, joints: Joints, skinned: SkinnedGarment, order: np.ndarray, back: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `Laid.shifts`, `above` and `rests` of the proxies of an armature."""
    first, there = joints.character_count, order >= 0
    now, trained = back @ joints.binds, np.array(joints.binds)
    trained[there], trained[~there] = skinned.bind_transforms[order[there]], now[~there]
    turned = np.abs(now - trained)[first:, :3, :3].max(axis=(1, 2), initial=0)
    if len(turned) and not turned.max() <= TURNED:
        raise _was_moved(joints.proxies[int(turned.argmax())], armature)
    apart = (np.swapaxes(trained[:, :3, :3], -1, -2) @ (now - trained)[:, :3, 3:])[..., 0]
    apart[np.abs(apart).max(axis=1) <= TURNED * size(skinned)] = 0
    apart[:first] = 0
    rests = local_transforms(trained, joints.parents)[first:, :3, 3]
    return apart[first:], apart[joints.parents[first:]], rests


def need_same_count(garment: bpy.types.Object, skinned: SkinnedGarment) -> None:
    """Raise `SetupError` where a garment has other vertices than it was trained with."""
    count = len(garment.data.vertices)
    if count != len(skinned.points):
        raise SetupError(
            f"'{garment.name}' had {len(skinned.points)} vertices when it was trained and has {count} now; train it "
            "again."
        )


def moved_back(armature: bpy.types.Object, joints: Joints, skinned: SkinnedGarment, order: np.ndarray) -> np.ndarray:
    """Return how the armature has moved as an object [m], back to where it was when the garment was trained, (4, 4).

    Raises:
        SetupError: bones have moved.
    """
    there = np.flatnonzero(order >= 0)
    now, trained = joints.binds[there], skinned.bind_transforms[order[there]]
    back = trained[0] @ np.linalg.inv(now[0])
    apart = np.abs(back @ now - trained)
    apart[:, :3, 3] /= size(skinned)
    worst = int(apart.max(axis=(1, 2)).argmax())
    if not apart[worst].max() <= TURNED:
        raise _was_moved(joints.names[there[worst]], armature)
    return back


def _was_moved(bone: str, armature: bpy.types.Object) -> SetupError:
    return SetupError(
        f"The bone '{bone}' of '{armature.name}' was moved since the garment was trained; undo that, or train again."
    )


def away(points: np.ndarray, trained: np.ndarray) -> float:
    """Return by how much points differ at most in one coordinate."""
    return float(np.abs(points - trained).max())


def size(skinned: SkinnedGarment) -> float:
    """Return the largest extent of a garment at rest [m]."""
    return max(float(np.ptp(skinned.points, axis=0).max()), 1e-9)
