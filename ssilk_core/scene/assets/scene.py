# SPDX-License-Identifier: Apache-2.0
"""The input of training and baking: a character with one prepared garment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen
from .character import Character
from .garment import Garment
from .rig import ProxyRig
from .skin import SkinWeights


@dataclass(frozen=True, eq=False)
class Scene:
    """A character, one prepared garment, and its proxy rig.

    The garment must have weights and classes, so that training and baking need no further checks.
    """

    character: Character
    garment: Garment
    rig: ProxyRig
    joint_names: tuple[str, ...] = field(init=False)
    parents: Ints = field(init=False)
    bind_transforms: Floats = field(init=False)

    def __post_init__(self) -> None:
        self._check_garment()
        self._check_rig()
        skeleton, rig = self.character.skeleton, self.rig
        assign(
            self,
            joint_names=(*skeleton.joint_names, *rig.joint_names),
            parents=frozen(np.concatenate([skeleton.parents, rig.parents]), np.int32),
            bind_transforms=frozen(np.concatenate([skeleton.bind_transforms, rig.bind_transforms]), np.float64),
        )

    def _check_garment(self) -> None:
        where = self.garment.mesh.path
        if self.garment.skin is None:
            fail(where, "the garment has no skinning weights", "weights are needed", "run 'ssilk rig' on it")
        if self.garment.classes is None:
            fail(where, "the garment has no vertex classes", "classes are needed", "run 'ssilk rig' on it")
        self.lbs_skin.check_joints(self.character.skeleton.joint_count)

    def _check_rig(self) -> None:
        rig, joints = self.rig, self.character.skeleton.joint_count
        rig.skin.check_joints(joints + rig.proxy_count)
        if rig.skin.vertex_count != self.garment.mesh.vertex_count:
            fail(
                rig.path,
                f"{rig.skin.vertex_count} rig weight rows for {self.garment.mesh.vertex_count} points",
                "one row for each point is needed",
                "generate the rig again",
            )
        late = np.flatnonzero(rig.parents >= joints + np.arange(rig.proxy_count))
        if not (late.size == 0 and (rig.parents >= 0).all()):
            fail(
                rig.path,
                "a proxy joint precedes its parent or has none",
                "the parent of each proxy must be an earlier joint",
            )

    @property
    def lbs_skin(self) -> SkinWeights:
        assert self.garment.skin is not None
        return self.garment.skin

    @property
    def classes(self) -> Ints:
        assert self.garment.classes is not None
        return self.garment.classes
