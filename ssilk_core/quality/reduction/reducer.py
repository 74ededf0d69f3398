# SPDX-License-Identifier: Apache-2.0
"""A trained model made smaller without training: fewer blendshapes, proxy joints and influences.

The latents stay the same, because nothing that is removed feeds back into them: errors do not accumulate over time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ...network.checkpoint import ModelFile
from ...network.runtime import Player
from ...network.runtime.skinning import trained_weights
from ...scene.assets import PINNED, Floats, Motion, SkinWeights
from ...scene.mesh.topology import vertex_areas
from .files import with_basis, with_weights
from .influences import VERTICES_PER_BLOCK, InfluenceCandidates, fit_weights, measure_costs, transform_by_each
from .joints import candidate_joints, dense, move_to_parents, removal_order, with_those_above
from .observed import observe
from .shapes import Modes, basis, modes
from .size import ModelSize

FRAMES = 512  # that are looked at, spread evenly over all motions
ROTATION_ITERATIONS = 8  # of turning displacements back through blended matrices


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """A smaller model.

    Attributes:
        file: the model; size: its size.
        rms, largest: distances of its vertices from those of the whole model over the motions [m]; RMS weighted by
            mass.
    """

    file: ModelFile
    size: ModelSize
    rms: float
    largest: float


class Reducer:
    """Makes smaller models of one, all measured on the same motions.

    Args:
        file: the model to reduce; one of a family of bodies is measured on the first of these.
        motions: representative motions, on which errors are measured.
        frames: number of frames to measure on.
        held: joint paths of proxies that every smaller model keeps, with the proxies above them.

    Attributes:
        whole: size of the model.

    Raises:
        SsilkError: there is no motion, or it is of another character.
    """

    def __init__(
        self, file: ModelFile, motions: Sequence[Motion], *, frames: int = FRAMES, held: Collection[str] = ()
    ) -> None:
        self.file, self.scene, self.player = file, file.scene, Player(file.on_base())
        self.seen = observe(self.player, motions, frames)
        self.activations, self.matrices = self.seen.decode(self.player)
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
        self.held = with_those_above(self.scene, held)
        self._skinned = lru_cache(4)(self._fitted)
        self._followed = lru_cache(4)(self._modes)

    def allowed(self, size: ModelSize) -> ModelSize:
        """Return the nearest size that a smaller model may have."""
        kept = size.within(self.whole)
        return replace(kept, joints=max(kept.joints, len(self.held)))

    def reduce(self, size: ModelSize) -> ReducedModel:
        """Return the model reduced to a size; parts that are already smaller stay as they are."""
        kept, file = self.allowed(size), self.file
        skin = (kept.joints, kept.influences)
        if skin != (self.whole.joints, self.whole.influences):
            weights = dense(self.influences.joints, self._skinned(*skin), len(self.scene.joint_names))
            file = with_weights(file, weights, self._gone(kept.joints))
        if kept != self.whole and file.config.activation_count:
            found = self._followed(*skin)
            readout = file.parameters.get("decoder.readout", np.eye(file.config.activation_count))
            file = with_basis(file, basis(found, kept.shapes, readout))
        return ReducedModel(file, kept, *self._difference(file))

    def predict_error(self, size: ModelSize) -> float:
        """Predict the error of a model of this size [m], RMS weighted by mass, without building it."""
        kept = self.allowed(size)
        if kept == self.whole:
            return 0.0
        skin = (kept.joints, kept.influences)
        lost = self.mass * self.influences.error(self._skinned(*skin))
        if not self.file.config.activation_count:
            return float(np.sqrt(lost.sum()))
        pinned = np.delete(lost, self.free).sum()  # shapes can compensate the error of the others
        return float(np.hypot(self._followed(*skin).error(kept.shapes), np.sqrt(pinned)))

    @cached_property
    def displacements(self) -> NDArray:
        """Displacements of the vertices that are not pinned by blendshapes, shape (V', 3, F) [m]."""
        moved = self.file.parameters["decoder.shapes"] @ self.activations
        return moved + self.file.parameters.get("decoder.offset", np.zeros((1, 3), np.float32))[:, :, None]

    @cached_property
    def influences(self) -> InfluenceCandidates:
        """The trained weights, and the cost of changing them."""
        joints = candidate_joints(self.scene, self.weights)
        weights = np.where(joints >= 0, np.take_along_axis(self.weights, joints.clip(min=0), axis=1), 0)
        return measure_costs(joints, weights, self.matrices, self._points)

    @cached_property
    def order(self) -> list[int]:
        """Proxies in order of removal, without those that are kept."""
        return removal_order(self.scene, self.influences, self.mass, self.held)

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
        weights = move_to_parents(own, self.scene.parents, self._gone(joints))
        return fit_weights(replace(own, weights=weights), weights > 0, influences)

    def _modes(self, joints: int, influences: int) -> Modes:
        """Return modes of the displacements that compensate other weights, as predicted from activations."""
        parameters = self.file.parameters
        more = np.zeros_like(self.displacements)
        if (joints, influences) != (self.whole.joints, self.whole.influences):
            more = -self._shifts(self._skinned(joints, influences))
        more += parameters.get("decoder.offset", np.zeros((1, 3)))[:, :, None]
        return modes(parameters["decoder.shapes"], more, self.activations, self.mass[self.free])

    def _shifts(self, weights: Floats) -> NDArray:
        """Return displacements by other weights (V, C) of the vertices that are not pinned, in the rest shape.

        Blended matrices are inverted with their transposes, which stay bounded where an inverse does not.
        """
        shifts = np.empty_like(self.displacements, dtype=np.float64)
        changed = weights - self.influences.weights
        for start in range(0, len(self.free), VERTICES_PER_BLOCK):
            rows = self.free[start : start + VERTICES_PER_BLOCK]
            joints = self.influences.joints[rows]
            moved = np.einsum(
                "vc,vcaf->vaf", changed[rows], transform_by_each(joints, self.matrices, self._points[rows])
            )
            turns = np.einsum("vc,vcabf->vabf", weights[rows], self.matrices[joints][:, :, :, :3])
            shifts[start : start + VERTICES_PER_BLOCK] = _invert_blend(turns, moved)
        return shifts

    def _difference(self, file: ModelFile) -> tuple[float, float]:
        """Return distances between a model's vertices and those of the whole model, RMS and largest [m]."""
        squares = [
            ((mine - theirs) ** 2).sum(axis=2)
            for mine, theirs in zip(self.seen.vertices(self.player), self.seen.vertices(Player(file.on_base())))
        ]
        square = np.concatenate(squares)
        return float(np.sqrt((square @ self.mass).mean())), float(np.sqrt(square.max()))


def _invert_blend(turns: NDArray, moved: Floats) -> Floats:
    """Return vectors that blended matrices (V, 3, 3, F) map to `moved` (V, 3, F), approximately near singular ones.

    Landweber iteration: exact after one step for rotations, and bounded however much a blend shrinks.
    """
    found = np.zeros_like(moved)
    for _ in range(ROTATION_ITERATIONS):
        found += np.einsum("vabf,vaf->vbf", turns, moved - np.einsum("vabf,vbf->vaf", turns, found))
    return found
