# SPDX-License-Identifier: Apache-2.0
"""Proxy joints of a garment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen
from .skeleton import check_rigid
from .skin import SkinWeights


@dataclass(frozen=True, eq=False)
class ProxyRig:
    """Proxy joints of one garment and the initial weights of the whole garment (paper, Appendix A).

    Combined joint indices count the J character joints first, then the P proxies: proxy p is joint J + p. With no
    proxies (P = 0) the garment follows only the character's joints.

    Attributes:
        joint_names: UsdSkel joint paths of the proxies, length P.
        parents: combined index of each proxy's parent, which precedes its children, shape (P,).
        bind_transforms: proxy to world at the bind pose, rigid, shape (P, 4, 4).
        skin: initial weights of every garment vertex over the combined joints.
    """

    path: str
    joint_names: tuple[str, ...]
    parents: Ints
    bind_transforms: Floats
    skin: SkinWeights

    def __post_init__(self) -> None:
        assign(
            self,
            joint_names=tuple(self.joint_names),
            parents=frozen(self.parents, np.int32),
            bind_transforms=frozen(np.reshape(self.bind_transforms, (-1, 4, 4)), np.float64),
        )
        if self.parents.shape != (self.proxy_count,):
            fail(
                self.path,
                f"{len(self.parents)} parents for {self.proxy_count} proxy joints",
                "one for each is needed",
            )
        if len(set(self.joint_names)) != self.proxy_count:
            fail(self.path, "proxy joint names repeat", "each needs its own name")
        if self.proxy_count:
            check_rigid(self.bind_transforms, self.path, "bind transform", self.joint_names)

    @property
    def proxy_count(self) -> int:
        return len(self.joint_names)
