# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones that were renamed since a garment was trained, found again by their names, by choice, or by their places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssilk_core.scene.kinematics import local_transforms

from .joints import Joints

NEAR = 1e-3  # how far a bone may stand from its place in its parent, as a share of the skeleton's size
TURNED = 1e-2  # how far its axes may be
SAME_SIZE = 1e-3  # difference of sizes that does not count
ALIKE = 1e-2  # by how much bones may have grown unequally and still count as scaled


@dataclass(frozen=True, eq=False)
class TrainedJoints:
    """The joints that a garment was trained with.

    Attributes:
        names: UsdSkel joint paths, the character's first, then the proxies, length J.
        binds: joint to world at rest [m], shape (J, 4, 4).
    """

    names: tuple[str, ...]
    binds: np.ndarray

    @property
    def parents(self) -> np.ndarray:
        """Index of each joint's parent, -1 for roots, shape (J,)."""
        index = {path: joint for joint, path in enumerate(self.names)}
        return np.array([index.get(path.rpartition("/")[0], -1) for path in self.names])


def known_as(joints: Joints, trained: TrainedJoints, chosen: Mapping[str, str]) -> Joints:
    """Return joints under the paths by which a trained garment knows them, as far as they are found there.

    Beneath parents that are found, a bone is the one that the artist has chosen, else the one of its name, else the
    only one in its place, turned alike. A root that is left over is the only one that is left there.

    Args:
        chosen: what bones were called when the garment was trained, by their names now.
    """
    if set(joints.paths) == set(trained.names):
        return joints
    found = _matches(joints, trained, chosen)
    known: list[str] = []
    for joint, path in enumerate(joints.paths):
        above = joints.parents[joint]
        leaf = path.rpartition("/")[2]
        own = f"{known[above]}/{leaf}" if above >= 0 else leaf
        known.append(trained.names[found[joint]] if joint in found else own)
    return replace(joints, known=tuple(known))


def renames(joints: Joints) -> dict[str, str]:
    """Return what bones were called when a garment was trained, by their names now, where these differ."""
    natural = replace(joints, known=()).paths
    pairs = zip(joints.names, _leaves(joints.paths), _leaves(natural))
    return {name: known for name, known, own in pairs if known != own}


def lost(joints: Joints, trained: TrainedJoints) -> list[str]:
    """Return what the trained joints were called that no bone is known as, parents first."""
    paths = set(joints.paths)
    return _leaves([path for path in trained.names if path not in paths])


def growth(joints: Joints, trained: TrainedJoints) -> float:
    """Return how many times as large a skeleton is as the trained one; 1 where it is not that one in another size.

    Joints must be known by their trained paths.
    """
    place = {path: index for index, path in enumerate(trained.names)}
    pairs = [(joint, place[path]) for joint, path in enumerate(joints.paths) if path in place]
    if len(pairs) < 2:
        return 1.0
    own, old = (
        np.linalg.norm(binds[:, :3, 3] - binds[:1, :3, 3], axis=1)
        for binds in (joints.binds[[pair[0] for pair in pairs]], trained.binds[[pair[1] for pair in pairs]])
    )
    far = old > NEAR * old.max()
    ratios = own[far] / old[far]
    if not far.any() or np.ptp(ratios) > ALIKE * ratios.mean():
        return 1.0
    ratio = float(ratios.mean())
    return ratio if abs(ratio - 1) > SAME_SIZE else 1.0


def _matches(joints: Joints, trained: TrainedJoints, chosen: Mapping[str, str]) -> dict[int, int]:
    """Return where joints stand among the trained ones, for those that are found."""
    parents, found = trained.parents, dict[int, int]()
    near, calls = _nearness(joints, trained), [chosen.get(name, "") for name in joints.names]
    waiting = [(-1, -1)]
    while waiting:
        above, old_above = waiting.pop()
        own, old = np.flatnonzero(joints.parents == above).tolist(), np.flatnonzero(parents == old_above).tolist()
        pairs: dict[int, int] = {}
        for names in (calls, _leaves(joints.paths)):
            places = {name: joint for joint, name in zip(old, _leaves([trained.names[joint] for joint in old]))}
            for joint in own:
                match = places.get(names[joint], -1)
                if joint not in pairs and match >= 0 and match not in pairs.values():
                    pairs[joint] = match
        own = [joint for joint in own if joint not in pairs]
        old = [joint for joint in old if joint not in pairs.values()]
        if above >= 0:
            inside = near[np.ix_(own, old)]
            only = inside & (inside.sum(axis=0) == 1) & (inside.sum(axis=1, keepdims=True) == 1)
            pairs |= {own[row]: old[column] for row, column in np.argwhere(only).tolist()}
        elif len(own) == len(old) == 1:
            pairs[own[0]] = old[0]
        found |= pairs
        waiting += pairs.items()
    return found


def _nearness(joints: Joints, trained: TrainedJoints) -> np.ndarray:
    """Return which joints stand in their parents where trained ones do, turned alike, in any size, shape (J, J')."""
    own, old = local_transforms(joints.binds, joints.parents), local_transforms(trained.binds, trained.parents)
    sizes = [max(float(np.ptp(each.binds[:, :3, 3], axis=0).max()), 1e-9) for each in (joints, trained)]
    turned = np.abs(own[:, None, :3, :3] - old[None, :, :3, :3]).max(axis=(-1, -2)) <= TURNED
    places, old_places = own[:, None, :3, 3], old[None, :, :3, 3]
    away = [np.abs(places - size * old_places).max(axis=-1) for size in (1.0, sizes[0] / sizes[1])]
    return turned & (np.minimum(*away) <= NEAR * sizes[0])


def _leaves(paths: Sequence[str]) -> list[str]:
    return [path.rpartition("/")[2] for path in paths]
