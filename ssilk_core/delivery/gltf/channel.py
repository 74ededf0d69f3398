# SPDX-License-Identifier: Apache-2.0
"""What the animation of a glTF binary does to one property of a node, at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...scene.assets import Floats
from ...scene.kinematics import slerp
from .file import GlbFile, listed

LINEAR, STEP, CUBIC = "LINEAR", "STEP", "CUBICSPLINE"
SAME = 1e-6  # share of a time by which a key may miss it, since keys are float32


@dataclass(frozen=True, eq=False)
class NodeChannel:
    """The keys of one property.

    Attributes:
        node, path: what moves: "translation", "rotation", "scale" or "weights" of a node.
        times: of the keys [s], shape (K,).
        values: at the keys, shape (K, width); of splines with their tangents around, shape (K, 3, width).
        between: how values between keys are found.
    """

    node: int
    path: str
    times: Floats
    values: Floats
    between: str = LINEAR

    @classmethod
    def of(cls, file: GlbFile, animation: Mapping[str, Any], item: Mapping[str, Any]) -> NodeChannel:
        """Return a channel of an animation.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document is malformed.
        """
        sampler, target = listed(animation["samplers"], item["sampler"]), item["target"]
        listed(file.document["nodes"], target["node"])
        between = sampler.get("interpolation", LINEAR)
        if between not in (LINEAR, STEP, CUBIC):
            raise ValueError(f"interpolation {between}")
        times = file.array(sampler["input"])[:, 0].astype(np.float64)
        if not (len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise ValueError(f"keys of {target['path']} that do not follow each other")
        values = file.array(sampler["output"]).astype(np.float64)
        shape = (len(times), 3, -1) if between == CUBIC else (len(times), -1)
        return cls(target["node"], str(target["path"]), times, values.reshape(shape), between)

    def at(self, time: float) -> Floats:
        """Return the value at a time [s], shape (width,); before and after its keys it stays as they are."""
        last = len(self.times) - 1
        before = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, last))
        after = min(before + 1, last)
        length = self.times[after] - self.times[before]
        share = float(np.clip((time - self.times[before]) / length, 0, 1)) if length > 0 else 0.0
        near = SAME * (abs(time) + length)
        if share * length <= near:
            share = 0.0
        elif (1 - share) * length <= near:
            before, share = after, 0.0
        value = self._key(before) if share == 0 or self.between == STEP else self._between(before, after, share)
        return value / np.linalg.norm(value) if self.path == "rotation" and self.between == CUBIC else value

    def _key(self, index: int) -> Floats:
        return self.values[index, 1] if self.between == CUBIC else self.values[index]

    def _between(self, before: int, after: int, share: float) -> Floats:
        if self.between == CUBIC:
            length, s = self.times[after] - self.times[before], share
            (_, start, leaving), (arriving, end, _) = self.values[before], self.values[after]
            bend = (s**3 - 2 * s**2 + s) * leaving + (s**3 - s**2) * arriving
            return (2 * s**3 - 3 * s**2 + 1) * start + (3 * s**2 - 2 * s**3) * end + length * bend
        start, end = self.values[before], self.values[after]
        if self.path == "rotation":
            return slerp(start, end, np.asarray(share))
        return (1 - share) * start + share * end
