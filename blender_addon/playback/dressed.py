# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment with a model's shapes and weights, which shows a pose at once, or poses over the timeline as keys."""

from __future__ import annotations

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ssilk_core.scene.assets import GarmentPose

from ..arrays.joints import Joints
from ..errors import SetupError
from ..motions.keys import has_live_keys, need_tracks, remove_keys
from ..motions.sampling import worlds
from ..scene.armature import read_joints
from ..scene.objects import found_again
from .bake import (
    animated,
    apply_deformation,
    need_bakeable,
    proxy_places,
    put_keys,
    shifts_from_rest,
    turns_from_rest,
)
from .family import shape_of
from .laying import Laid
from .models import TrainedGarment


class DressedGarment:
    """A garment of the scene and its armature, found again as long as they are there. In object mode when it begins.

    Attributes:
        joints: of the armature, where they were when the garment was dressed last.
        shapes: its shape keys of the model; none before it is dressed.

    Raises:
        SetupError: bones or the garment do not deform as ssilk has it.
    """

    def __init__(self, garment: bpy.types.Object, armature: bpy.types.Object) -> None:
        self.joints = read_joints(armature, garment)
        need_bakeable(garment, armature, self.joints)
        self.shapes: list[str] = []
        self._things = tuple((thing.name, thing.session_uid) for thing in (garment, armature))
        self._laid: Laid | None = None  # how a garment of a family is brought to its body
        self._body: tuple[object, ...] | None = None  # which that was; None for a model of one body

    def objects(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Return the garment and its armature; raise `SetupError` if one was deleted."""
        garment, armature = (_found(name, uid) for name, uid in self._things)
        return garment, armature

    def ready(self) -> bool:
        """Return whether the garment may be given other shapes and weights now."""
        garment, _ = self.objects()
        return garment.mode == "OBJECT"

    def is_in(self, scene: bpy.types.Scene) -> bool:
        """Return whether a scene holds the garment; motions are read in one that does not."""
        garment, _ = self.objects()
        return garment.name in scene.objects

    def dress(self, trained: TrainedGarment, skinned: SkinnedGarment) -> None:
        """Give the garment the shapes and weights of a model; in object mode.

        Args:
            skinned: the garment as the model has it.
        """
        garment, armature = self.objects()
        self.joints = self._joints_now()
        self._laid = trained.lay(garment, armature, self.joints, skinned)
        self.shapes = apply_deformation(garment, armature, self.joints, skinned, trained.order, self._laid)
        self._body = shape_of(garment, armature) if trained.on else None

    def has_another_body(self) -> bool:
        """Return whether the artist has given the character another body since a model of a family was put on it."""
        return self._body is not None and self._body != shape_of(*self.objects())

    def has_lost_shapes(self) -> bool:
        """Return whether shapes are not there any more, as an undo takes them away before it is told."""
        garment, _ = self.objects()
        keys = garment.data.shape_keys
        return any(not keys or name not in keys.key_blocks for name in self.shapes)

    def lost_bone(self) -> str | None:
        """Return a bone that is read or written to and is not there any more under its name; None where all are."""
        _, armature = self.objects()
        return next((name for name in self.joints.names if name not in armature.pose.bones), None)

    def need_bones(self) -> None:
        """Raise `SetupError` where such a bone was deleted or renamed."""
        if (lost := self.lost_bone()) is not None:
            garment, armature = self.objects()
            raise SetupError(
                f"The bone '{lost}' of '{armature.name}' was deleted or renamed while '{garment.name}' was played; "
                "play it again."
            )

    def placed(self, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        """Return the character's joints to the world in an evaluated frame, shape (J, 4, 4)."""
        _, armature = self.objects()
        bones = [armature.pose.bones.find(name) for name in self.joints.character.names]
        return worlds(armature.evaluated_get(depsgraph))[bones]

    def put(self, pose: GarmentPose, proxies: np.ndarray) -> None:
        """Put proxies and shape keys where a pose of one frame has them.

        Args:
            proxies: where each stands among those of the model, -1 for none, shape (P,).
        """
        garment, armature = self.objects()
        rotations = pose.rotations[:, proxies]
        turns = turns_from_rest(self.joints, rotations)[0]
        for name, turn in zip(self.joints.proxies, turns.tolist()):
            armature.pose.bones[name].rotation_quaternion = turn
        places = proxy_places(self.joints, rotations, pose, proxies, self._laid)
        if places is not None:
            shifts = shifts_from_rest(armature, self.joints, places)[0]
            for name, shift in zip(self.joints.proxies, shifts.tolist()):
                armature.pose.bones[name].location = shift
        blocks = garment.data.shape_keys.key_blocks if self.shapes else ()
        for name, weight in zip(self.shapes, pose.weights[0].tolist()):
            blocks[name].value = weight

    def need_tracks(self) -> None:
        """Raise `SetupError` where keys cannot stand on tracks of their own now, as while a strip is tweaked."""
        need_tracks(animated(*self.objects()))

    def put_keys(self, poses: GarmentPose, first: int, proxies: np.ndarray) -> None:
        """Put poses from a frame of the timeline on as keys; `proxies` as for `put`."""
        garment, armature = self.objects()
        put_keys(garment, armature, self.joints, proxies, self.shapes, poses, first, live=True, laid=self._laid)

    def has_keys(self) -> bool:
        """Return whether these keys are there still."""
        garment, armature = self.objects()
        keys = garment.data.shape_keys
        return has_live_keys(garment, [armature, *([keys] if self.shapes and keys else [])])

    def _joints_now(self) -> Joints:
        """Return the joints where the armature, which may move as an object, has them in this frame."""
        garment, armature = self.objects()
        joints = read_joints(armature, garment)
        if joints.names != self.joints.names or not np.array_equal(joints.parents, self.joints.parents):
            raise SetupError(
                f"Bones of '{armature.name}' were changed while '{garment.name}' was played; play it again."
            )
        return joints


def remove_live_keys(garment: bpy.types.Object) -> None:
    """Remove the keys that stand for live playback of a garment, wherever they are."""
    own = (thing for things in (bpy.data.objects, bpy.data.shape_keys) for thing in things)
    remove_keys(garment, [thing for thing in own if not thing.library], live=True)


def _found(name: str, uid: int) -> bpy.types.Object:
    """Return an object, mostly by its name, which is fast; raise `SetupError` if it was deleted."""
    thing = bpy.data.objects.get(name)
    return thing if thing and thing.session_uid == uid else found_again(uid, name)
