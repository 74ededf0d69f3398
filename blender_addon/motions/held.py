# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of a garment that are held by themselves, as a shot in USD says it (`ssilk_usd.reading.direction`)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import bpy
import numpy as np
from ssilk_usd.names import FREE, POSED

from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import local_transforms

from ..arrays.joints import Joints, identifiers
from ..errors import SetupError
from .freedom import freedom, held_proxies
from .sampling import SampledTake
from .sources import ACTION, Source

ATTRIBUTES = {"ssilk_free": FREE, "ssilk_posed": POSED}
WITHIN = 0.5  # weight from which on a vertex is in a group


@dataclass(eq=False)
class HeldBones:
    """How parts of a garment are held.

    Attributes:
        joints: of the armature, with proxies.
        parts: values of frames, shape (F,) each, by the name of the attribute in USD.
        groups: vertices of those that are no proxies, shape (N,) each, by name.
        hand: the action that poses proxies, to be sampled; None where none is asked for.
    """

    joints: Joints
    parts: dict[str, np.ndarray]
    groups: dict[str, np.ndarray]
    hand: SampledTake | None

    @classmethod
    def of(cls, garment: bpy.types.Object, joints: Joints, frames: range, trained: Collection[str]) -> HeldBones:
        """Return what sliders say in frames.

        Args:
            trained: joint paths of the model.

        Raises:
            SetupError: there is no such vertex group, or no action to pose proxies by.
        """
        leaves = {bone: path.rpartition("/")[2] for path, bone in joints.bones.items() if path in trained}
        held = {each: values for each, values in held_proxies(garment, frames).items() if each[0] in leaves}
        parts = {f"{ATTRIBUTES[what]}:{leaves[bone]}": each for (bone, what), each in held.items()}
        groups, settings, hand = dict[str, np.ndarray](), garment.ssilk, None
        if settings.part and ((free := freedom(garment, frames, "part_free")) < 1).any():
            (name,) = identifiers([settings.part], leaves.values())
            groups[name], parts[f"{FREE}:{name}"] = _vertices(garment, settings.part), free
        if any(what == "ssilk_posed" for _, what in held):
            if settings.hand_pose is None:
                raise SetupError("Choose the action that poses proxies by hand: Posed By, in the Baking panel.")
            hand = SampledTake(Source(ACTION, settings.hand_pose.name), frames)
        return cls(joints, parts, groups, hand)

    def with_proxies(self, motion: Motion, skeleton: Skeleton) -> tuple[Motion, Skeleton]:
        """Return a motion of the character with the proxies as the action has them, and the joints of both."""
        assert self.hand is not None
        count, by_hand = self.joints.character_count, self.hand.motion(self.joints)
        rotations, translations = (
            np.concatenate([getattr(motion, name), getattr(by_hand, name)[:, count:]], axis=1)
            for name in ("rotations", "translations")
        )
        own = self.joints
        rest = local_transforms(own.binds, own.parents)
        whole = replace(
            skeleton, joint_names=own.paths, parents=own.parents, bind_transforms=own.binds, rest_transforms=rest
        )
        return replace(motion, rotations=rotations, translations=translations), whole


def _vertices(garment: bpy.types.Object, name: str) -> np.ndarray:
    group = garment.vertex_groups.get(name)
    if group is None:
        raise SetupError(f"'{garment.name}' has no vertex group '{name}'; choose another Part in the Baking panel.")
    inside = [
        vertex.index
        for vertex in garment.data.vertices
        if any(each.group == group.index and each.weight >= WITHIN for each in vertex.groups)
    ]
    return np.array(inside, dtype=np.int64)
