# SPDX-License-Identifier: Apache-2.0
"""A trained model made smaller without training: fewer blendshapes, proxy joints and influences.

The latents stay what they are, because nothing that is cut feeds back into them: what a smaller model loses does not
add up over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..assets import PINNED, Floats, Motion, SkinWeights
from ..checkpoint import ModelFile
from ..mesh.topology import vertex_areas
from ..runtime import Player
from ..runtime.skinning import trained_weights
from .files import with_basis, with_weights
from .influences import AT_ONCE, InfluenceCandidates, carried_by, fitted, measured
from .joints import candidates, dense, handed_down, least_missed
from .observed import observe
from .shapes import Modes, basis, modes
from .size import ModelSize

FRAMES = 512  # that are looked at, spread evenly over all motions
STEPS = 8  # of turning displacements back through blended matrices


@dataclass(frozen=True, eq=False)
class Reduced:
    """A smaller model.

    Attributes:
        file: the model; size: what it keeps.
        rms, largest: distances of its vertices from the whole model's over the motions [m], RMS weighted by mass.
    """

    file: ModelFile
    size: ModelSize
    rms: float
    largest: float


class Reducer:
    """Makes smaller models of one, all judged by the same motions.

    Args:
        file: the model to cut.
        motions: what it will have to do, without which nobody knows what is missed least.
        frames: how many of them to look at.

    Attributes:
        whole: what the model has.

    Raises:
        SsilkError: there is no motion, or it is of another character.
    """

    def __init__(self, file: ModelFile, motions: Sequence[Motion], *, frames: int = FRAMES) -> None:
        self.file, self.scene, self.player = file, file.scene, Player(file)
        self.seen = observe(self.player, motions, frames)
        self.activations, self.matrices = self.seen.decoded(self.player)
        mesh = self.scene.garment.mesh
        areas = vertex_areas(mesh.points, mesh.faces)
        self.mass, self.free = areas / areas.sum(), np.flatnonzero(self.scene.classes != PINNED)
        skin = SkinWeights("", self.scene.rig.skin.indices, trained_weights(self.scene, file.parameters))
        self.weights = skin.dense(len(self.scene.joint_names))
        self.whole = ModelSize(
            shapes=file.config.shapes,
            joints=self.scene.rig.proxy_count,
            influences=int((self.weights > 0).sum(axis=1).max()),
        )
        self._skinned = lru_cache(4)(self._fitted)
        self._followed = lru_cache(4)(self._modes)

    def reduced(self, size: ModelSize) -> Reduced:
        """Return the model with so much kept; what it has less of stays as it is."""
        kept, file = size.within(self.whole), self.file
        skin = (kept.joints, kept.influences)
        if skin != (self.whole.joints, self.whole.influences):
            weights = dense(self.influences.joints, self._skinned(*skin), len(self.scene.joint_names))
            file = with_weights(file, weights, self._gone(kept.joints))
        if kept != self.whole and file.config.activation_count:
            found = self._followed(*skin)
            readout = file.parameters.get("decoder.readout", np.eye(file.config.activation_count))
            file = with_basis(file, basis(found, kept.shapes, readout))
        return Reduced(file, kept, *self._difference(file))

    def predicted(self, size: ModelSize) -> float:
        """Return about what a model of this size loses [m], RMS weighted by mass, without making it."""
        kept = size.within(self.whole)
        if kept == self.whole:
            return 0.0
        skin = (kept.joints, kept.influences)
        lost = self.mass * self.influences.lost(self._skinned(*skin))
        if not self.file.config.activation_count:
            return float(np.sqrt(lost.sum()))
        pinned = np.delete(lost, self.free).sum()  # shapes can make up for what the others lose
        return float(np.hypot(self._followed(*skin).lost(kept.shapes), np.sqrt(pinned)))

    @cached_property
    def displacements(self) -> NDArray:
        """By how much blendshapes move the vertices that are not pinned, shape (V', 3, F) [m]."""
        moved = self.file.parameters["decoder.shapes"] @ self.activations
        return moved + self.file.parameters.get("decoder.offset", np.zeros((1, 3), np.float32))[:, :, None]

    @cached_property
    def influences(self) -> InfluenceCandidates:
        """The trained weights, and what others would cost."""
        joints = candidates(self.scene, self.weights)
        weights = np.where(joints >= 0, np.take_along_axis(self.weights, joints.clip(min=0), axis=1), 0)
        return measured(joints, weights, self.matrices, self._points)

    @cached_property
    def order(self) -> list[int]:
        """Proxies in the order in which they are taken off."""
        return least_missed(self.scene, self.influences, self.mass)

    @cached_property
    def _points(self) -> NDArray:
        """The vertices before skinning, shape (V, 3, F) [m]."""
        rest = self.scene.garment.mesh.points.astype(np.float32)
        points = np.repeat(rest[:, :, None], self.matrices.shape[-1], axis=2)
        points[self.free] += self.displacements
        return points

    def _gone(self, joints: int) -> list[int]:
        return self.order[: self.whole.joints - joints]

    def _fitted(self, joints: int, influences: int) -> Floats:
        own = self.influences
        weights = handed_down(own, self.scene.parents, self._gone(joints))
        return fitted(replace(own, weights=weights), weights > 0, influences)

    def _modes(self, joints: int, influences: int) -> Modes:
        """Return what displacements would make up for other weights, as far as activations tell."""
        parameters = self.file.parameters
        more = np.zeros_like(self.displacements)
        if (joints, influences) != (self.whole.joints, self.whole.influences):
            more = -self._shifts(self._skinned(joints, influences))
        more += parameters.get("decoder.offset", np.zeros((1, 3)))[:, :, None]
        return modes(parameters["decoder.shapes"], more, self.activations, self.mass[self.free])

    def _shifts(self, weights: Floats) -> NDArray:
        """Return by how much other weights (V, C) move the vertices that are not pinned, turned back to rest.

        Blended matrices are turned back by their transposes, which stay bounded where an inverse does not.
        """
        shifts = np.empty_like(self.displacements, dtype=np.float64)
        changed = weights - self.influences.weights
        for start in range(0, len(self.free), AT_ONCE):
            rows = self.free[start : start + AT_ONCE]
            joints = self.influences.joints[rows]
            moved = np.einsum("vc,vcaf->vaf", changed[rows], carried_by(joints, self.matrices, self._points[rows]))
            turns = np.einsum("vc,vcabf->vabf", weights[rows], self.matrices[joints][:, :, :, :3])
            shifts[start : start + AT_ONCE] = _turned_back(turns, moved)
        return shifts

    def _difference(self, file: ModelFile) -> tuple[float, float]:
        """Return how far a model's vertices are from the whole one's, RMS and largest [m]."""
        squares = [
            ((mine - theirs) ** 2).sum(axis=2)
            for mine, theirs in zip(self.seen.vertices(self.player), self.seen.vertices(Player(file)))
        ]
        square = np.concatenate(squares)
        return float(np.sqrt((square @ self.mass).mean())), float(np.sqrt(square.max()))


def _turned_back(turns: NDArray, moved: Floats) -> Floats:
    """Return what blended matrices (V, 3, 3, F) take to `moved` (V, 3, F), nearly where one is close to singular.

    Landweber's iteration: exact at once for rotations, and bounded however much a blend shrinks.
    """
    found = np.zeros_like(moved)
    for _ in range(STEPS):
        found += np.einsum("vabf,vaf->vbf", turns, moved - np.einsum("vabf,vbf->vaf", turns, found))
    return found
