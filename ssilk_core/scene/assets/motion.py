# SPDX-License-Identifier: Apache-2.0
"""Animations of a character's joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite
from .body_shape import BodyShape


@dataclass(frozen=True, eq=False)
class Motion:
    """An animation of the character's joints at a constant rate.

    Attributes:
        path: source of the motion, for messages.
        fps: frames per second [1/s].
        rotations: local joint rotations, unit quaternions (w, x, y, z), shape (F, J, 4).
        translations: local joint translations [m], shape (F, J, 3); roots are in world space.
        start: index of the first frame, counted from time zero at `fps`; it begins at `start / fps` seconds.
        gravity: acceleration that cloth feels, wind included [m/s2], shape (F, 3); None for the usual one.
        proximity: to colliders at M points of a garment, as its network sees them (`network.proximity`), shape
            (F, M, 5); None where it sees none.
        shapes: K blendshapes of the character's meshes that are on otherwise than in its stage.
        shape_weights: how much of each is on, from 0 to 1, shape (F, K); None where there are none.
    """

    path: str
    fps: float
    rotations: Floats
    translations: Floats
    start: float = 0.0
    gravity: Floats | None = None
    proximity: Floats | None = None
    shapes: tuple[BodyShape, ...] = ()
    shape_weights: Floats | None = None

    def __post_init__(self) -> None:
        rotations, translations = frozen(self.rotations, np.float64), frozen(self.translations, np.float64)
        if not (np.isfinite(self.fps) and self.fps > 0):
            fail(self.path, f"a rate of {self.fps} frames per second", "the rate must be positive")
        if not (rotations.ndim == 3 and rotations.shape[-1] == 4 and translations.shape == (*rotations.shape[:2], 3)):
            fail(
                self.path,
                f"rotations of shape {rotations.shape} and translations of shape {translations.shape}",
                "(frames, joints, 4) and (frames, joints, 3) are needed",
            )
        if not len(rotations) > 0:
            fail(self.path, "the motion has no frames", "at least one is needed")
        need_finite(rotations, self.path, "frames of rotations")
        need_finite(translations, self.path, "frames of translations")
        norms = np.linalg.norm(rotations, axis=-1, keepdims=True)
        if not norms.min() > 1e-6:
            fail(self.path, "a rotation is the zero quaternion", "rotations are unit quaternions")
        assign(self, rotations=frozen(rotations / norms, np.float64), translations=translations)
        if self.gravity is not None:
            gravity = frozen(self.gravity, np.float64)
            if gravity.shape != (len(rotations), 3):
                fail(self.path, f"gravity of shape {gravity.shape}", f"({len(rotations)}, 3) is needed")
            need_finite(gravity, self.path, "frames of gravity")
            assign(self, gravity=gravity)
        if self.proximity is not None:
            proximity = frozen(self.proximity, np.float64)
            if not (proximity.ndim == 3 and len(proximity) == len(rotations) and proximity.shape[2] == 5):
                fail(self.path, f"proximity of shape {proximity.shape}", f"({len(rotations)}, points, 5) is needed")
            need_finite(proximity, self.path, "frames of proximity")
            assign(self, proximity=proximity)
        if self.shapes or self.shape_weights is not None:
            weights = frozen(np.zeros((0, 0)) if self.shape_weights is None else self.shape_weights, np.float64)
            if weights.shape != (len(rotations), len(self.shapes)):
                needed = f"({len(rotations)}, {len(self.shapes)}) is needed"
                fail(self.path, f"weights of blendshapes of shape {weights.shape}", needed)
            need_finite(weights, self.path, "frames of weights of blendshapes")
            assign(self, shapes=tuple(self.shapes), shape_weights=weights)

    @property
    def frame_count(self) -> int:
        return len(self.rotations)

    @property
    def felt(self) -> dict[str, Any]:
        """What cloth feels of the character's shape and of the world in each frame, by the attribute's name."""
        every = {"gravity": self.gravity, "proximity": self.proximity, "shape_weights": self.shape_weights}
        return {name: values for name, values in every.items() if values is not None}

    def same_frames(self, other: Motion) -> int:
        """Return in how many frames, from the first one on, another motion is the same; in none at another rate."""
        count = min(self.frame_count, other.frame_count)
        if self.fps != other.fps or self.rotations.shape[1] != other.rotations.shape[1]:
            return 0
        if self.shapes != other.shapes:
            return 0
        if {name: each.shape[1:] for name, each in self.felt.items()} != {
            name: each.shape[1:] for name, each in other.felt.items()
        }:
            return 0
        turned = (self.rotations[:count] != other.rotations[:count]).any(axis=(1, 2))
        moved = (self.translations[:count] != other.translations[:count]).any(axis=(1, 2))
        changed = turned | moved
        for own, others in zip(self.felt.values(), other.felt.values()):
            changed |= (own[:count] != others[:count]).reshape(count, -1).any(axis=1)
        return int(np.append(changed, True).argmax())

    def clip(self, start: int, stop: int) -> Motion:
        """Return frames `start` (inclusive) to `stop` (exclusive) as a separate motion."""
        return replace(
            self,
            rotations=self.rotations[start:stop],
            translations=self.translations[start:stop],
            start=self.start + start,
            **{name: values[start:stop] for name, values in self.felt.items()},
        )

    def picked(self, frames: Ints | slice) -> Motion:
        """Return some frames, of which each counts by itself: rate and start are those of the whole."""
        return replace(
            self,
            rotations=self.rotations[frames],
            translations=self.translations[frames],
            **{name: values[frames] for name, values in self.felt.items()},
        )

    def after(self, before: Motion) -> Motion:
        """Return the frames of another motion, which feels the world as this one does or not, followed by these."""
        felt, earlier = self.felt, before.felt
        return replace(
            self,
            rotations=np.concatenate([before.rotations, self.rotations]),
            translations=np.concatenate([before.translations, self.translations]),
            start=self.start - before.frame_count,
            **{name: np.concatenate([earlier[name], felt[name]]) for name in felt if name in earlier},
        )
