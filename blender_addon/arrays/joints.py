# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones as joints, where these stand in a stage or a model, and valid USD names for bones and objects."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssilk_core.scene.assets import Body, Skeleton, carrying_joint, moved_by_joints
from ssilk_core.scene.kinematics import local_transforms

from ..errors import SetupError


@dataclass(frozen=True, eq=False)
class Joints:
    """The bones of an armature that deform, parents before children, the proxies of one garment last.

    Attributes:
        names: of the bones, length J.
        parents: index of each joint's parent, -1 for roots, shape (J,).
        binds: joint to world at rest, rigid [m], y up, shape (J, 4, 4).
        proxy_count: how many of the last joints are proxies.
        known: the paths by which a trained garment knows them where bones were renamed since; else empty.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    binds: np.ndarray
    proxy_count: int = 0
    known: tuple[str, ...] = ()

    @property
    def character_count(self) -> int:
        return len(self.names) - self.proxy_count

    @property
    def proxies(self) -> tuple[str, ...]:
        """Names of the proxies."""
        return self.names[self.character_count :]

    @property
    def paths(self) -> tuple[str, ...]:
        """UsdSkel joint paths."""
        return self.known or joint_paths(self.names, self.parents)

    @property
    def bones(self) -> dict[str, str]:
        """Names of the bones by their paths."""
        return dict(zip(self.paths, self.names))

    @property
    def character(self) -> Joints:
        """The joints without proxies."""
        count = self.character_count
        return replace(self, names=self.names[:count], parents=self.parents[:count], binds=self.binds[:count],
                       proxy_count=0, known=self.known[:count])  # fmt: skip

    def skeleton(self, path: str, bodies: Sequence[Body] = ()) -> Skeleton:
        """Return the character's joints as a skeleton whose rest pose is its bind pose.

        Args:
            path: of its prim.
            bodies: what the joints move; with none the first joint carries the character.
        """
        own = self.character
        count = len(own.names)
        moved = [moved_by_joints(body.mesh.points, body.skin.dense(count)) for body in bodies]
        hub = carrying_joint(moved, own.parents, own.binds[:, :3, 3])
        return Skeleton(path, own.paths, own.parents, own.binds, local_transforms(own.binds, own.parents), hub)


def joint_order(joints: Joints, names: Sequence[str], *, fewer_proxies: bool = False) -> np.ndarray:
    """Return where each joint stands among the joint paths of a trained garment, shape (J,).

    Args:
        fewer_proxies: whether proxies may be missing there; they get -1.

    Raises:
        SetupError: the joints are others.
    """
    paths = joints.paths
    lacking = set(paths[joints.character_count :]) - set(names) if fewer_proxies else set()
    # Two bones that are taken for one joint are odd as well.
    odd = sorted({path for path in paths if paths.count(path) > 1} or set(paths) ^ set(names) ^ lacking)
    if odd:
        raise SetupError(
            f"The bones are not those that the garment was trained with ('{odd[0].rpartition('/')[2]}' was added, "
            "removed, renamed or has another parent); undo that, tell which bone it is by Match Bones in the Baking "
            "panel, train again, or put it onto another rig by 'ssilk rig --onto'."
        )
    places = {name: place for place, name in enumerate(names)}
    return np.array([places.get(path, -1) for path in paths])


def identifiers(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return a unique ASCII identifier for each name, the name itself where it is one and free."""
    used, found = set(taken), []
    for name in names:
        stem = re.sub(r"^(?=\d|$)", "_", re.sub(r"[^A-Za-z0-9_]", "_", name))
        unique, copy = stem, 1
        while unique in used:
            copy += 1
            unique = f"{stem}_{copy}"
        used.add(unique)
        found.append(unique)
    return found


def joint_paths(names: Iterable[str], parents: Iterable[int]) -> tuple[str, ...]:
    """Return UsdSkel joint paths ("Hips/Spine"), with leaf names that are unique among all joints.

    Args:
        parents: index of each joint's parent, which comes before it; -1 for roots.
    """
    paths: list[str] = []
    for leaf, parent in zip(identifiers(names), parents):
        paths.append(f"{paths[parent]}/{leaf}" if parent >= 0 else leaf)
    return tuple(paths)
