# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig that `ssilk rig` wrote into a stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdSkel

from ..errors import SetupError
from .arrays import Joints, Rig, Staged, dense
from .names import joint_paths
from .write import CLASS, PLAIN, PROXIES, ROOT, SKIN


def read_rig(path: Path, garment: str, joints: Joints) -> Rig:
    """Read classes, proxies and weights of the garment at a prim path.

    Args:
        path: what `ssilk rig` made of a stage of `write_stage`.
        joints: the joints that were written, without proxies.
    """
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath(garment)
    proxies = [str(name) for name in _value(prim, PROXIES) or ()]
    index = {name: joint for joint, name in enumerate([*joint_paths(joints.names, joints.parents), *proxies])}
    return Rig(
        classes=np.array(_value(prim, CLASS), dtype=np.int32),
        names=tuple(name.rpartition("/")[2] for name in proxies),
        parents=np.array([index[name.rpartition("/")[0]] for name in proxies], dtype=np.int64),
        binds=_binds(UsdSkel.Skeleton.Get(stage, ROOT.AppendChild("Skeleton")), proxies),
        weights=_weights(prim, SKIN, "skel:joints", index),
        plain=_weights(prim, PLAIN[:2], PLAIN[2], index)[:, : len(joints.names)],
    )


def read_staged(path: Path) -> tuple[list[Staged], float | None]:
    """Read the garments with proxies of any stage, and its frames per second, None where it does not say.

    Raises:
        SetupError: it is no USD file.
    """
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise SetupError(f"'{path}' is no USD file that can be read; choose one that `ssilk rig` wrote.") from error
    found = [_staged(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh) and _value(prim, PROXIES)]
    return found, stage.GetFramesPerSecond() if stage.HasAuthoredTimeCodeRange() else None


def _staged(prim: Usd.Prim) -> Staged:
    own = tuple(str(name).rpartition("/")[2] for name in _value(prim, PLAIN[2]) or ())
    index = {str(name): joint for joint, name in enumerate(_value(prim, PLAIN[2]) or ())}
    return Staged(
        name=prim.GetName(),
        proxies=tuple(str(name).rpartition("/")[2] for name in _value(prim, PROXIES)),
        plain=_weights(prim, PLAIN[:2], PLAIN[2], index) if own else None,
        plain_joints=own,
    )


def read_points(path: Path, mesh: str) -> np.ndarray:
    """Read the points of the mesh at a prim path of a stage of `write_stage`, shape (V, 3)."""
    stage = Usd.Stage.Open(str(path))
    return np.array(UsdGeom.Mesh.Get(stage, mesh).GetPointsAttr().Get())


def _value(prim: Usd.Prim, name: str) -> Any:
    return prim.GetAttribute(name).Get()


def _binds(skeleton: UsdSkel.Skeleton, proxies: list[str]) -> np.ndarray:
    """Return the bind transforms of the proxies as column-vector matrices."""
    names = list(skeleton.GetJointsAttr().Get())
    binds = np.array(skeleton.GetBindTransformsAttr().Get()).reshape(-1, 4, 4).swapaxes(-1, -2)
    return binds[[names.index(name) for name in proxies]]


def _weights(prim: Usd.Prim, names: tuple[str, ...], order: str, index: dict[str, int]) -> np.ndarray:
    """Return dense weights over the joints of `index` from influences in the joint order of attribute `order`."""
    indices, weights = (UsdGeom.Primvar(prim.GetAttribute(name)) for name in names)
    width = indices.GetElementSize()
    own = np.array([index[str(name)] for name in prim.GetAttribute(order).Get()])
    rows = own[np.array(indices.Get()).reshape(-1, width)]
    return dense(rows, np.array(weights.Get()).reshape(-1, width), len(index))
