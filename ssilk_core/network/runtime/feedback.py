# SPDX-License-Identifier: Apache-2.0
"""What the stepper S sees of the cloth, as `network.feedback` defines it, one frame at a time in few numpy calls.

The points that S sees are blended from the character's joints and from the proxies. What the character gives is known
for all frames of a block beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats
from ..checkpoint import ModelFile
from ..feedback import LIMIT, UNIT, feedback_size, feedback_vertices
from .decoder import NumpyDecoder
from .kinematics import ProxyKinematics
from .networks import LayerBuffers, as_float32
from .skinning import tiles, weights_of_joints

SATURATION = np.float32(UNIT * LIMIT)  # [m]


@dataclass(frozen=True, eq=False)
class BodyCourse:
    """The character in F frames and in the two before them, as the points see it.

    Attributes:
        matrices: skinning matrices about each root, shape (F + 2, J, 3, 4).
        affine: what the character's joints add to each point's matrix, shape (F + 2, M, 3, 4).
        bend: second differences of the root's position [m], shape (F, 3).
    """

    matrices: NDArray
    affine: NDArray
    bend: NDArray


class ClothPoints:
    """Decodes the points that S sees.

    Args:
        file: the trained garment; decoder, kinematics: of it.
    """

    def __init__(self, file: ModelFile, decoder: NumpyDecoder, kinematics: ProxyKinematics) -> None:
        self.decoder, self.kinematics = decoder, kinematics
        rows = feedback_vertices(file.scene, file.config)
        self.count, self.joints = len(rows), file.scene.character.skeleton.joint_count
        self.hub = file.scene.character.skeleton.hub
        self.size = feedback_size(file.scene, file.config)
        whole = tiles(file.scene, file.parameters)
        shapes = np.concatenate([tile.shapes.reshape(len(tile.shapes), 3, -1) for tile in whole], axis=2)
        shapes = shapes[:, :, rows].transpose(0, 2, 1).reshape(len(shapes), -1)  # (K + 1, 3 M), the rest shape last
        self.shapes, self.rest = as_float32(shapes[:-1]), as_float32(shapes[-1])
        weights = weights_of_joints(file.scene, file.parameters, rows)
        self.of_character, self.of_proxies = (as_float32(part) for part in np.split(weights, [self.joints], axis=1))

    def course(self, matrices: NDArray, bend: Floats) -> BodyCourse:
        """Return F frames for the points, from skinning matrices of F + 2 (J, 3, 4, F + 2) and bends (F, 3)."""
        own = np.ascontiguousarray(matrices.transpose(3, 0, 1, 2))
        affine = (self.of_character @ own.reshape(len(own), self.joints, 12)).reshape(len(own), self.count, 3, 4)
        return BodyCourse(own, affine, as_float32(bend))

    def points(self, outputs: NDArray, course: BodyCourse, frames: slice) -> NDArray:
        """Return points (F, M, 3) of outputs of D (outputs, F) in frames of a course, counted with the two before."""
        activations, transforms = self.decoder.pose_of(outputs)
        matrices = self.kinematics.matrices(transforms, course.matrices[frames].transpose(1, 2, 3, 0))
        proxies = matrices[self.joints :].transpose(3, 0, 1, 2).reshape(outputs.shape[1], -1, 12)
        affine = (self.of_proxies @ proxies).reshape(-1, self.count, 3, 4)
        affine += course.affine[frames]
        rest = (activations.T @ self.shapes + self.rest).reshape(-1, self.count, 3, 1)
        return (affine[..., :3] @ rest)[..., 0] + affine[..., 3]

    def proxies(self, outputs: NDArray) -> NDArray:
        """Return the proxies (C P, F) of outputs of D (outputs, F), as S sees them."""
        decoder, transforms = self.decoder, self.decoder.pose_of(outputs)[1]
        columns = transforms.swapaxes(1, 2)  # x, y, z axis and displacement
        columns = columns[:, [0, 1, 3] if decoder.moves else [0, 1]].reshape(len(columns), -1, outputs.shape[1])
        return ((columns - decoder.identity) / decoder.scale).reshape(-1, outputs.shape[1])


class SeenCloth:
    """Looks back on the last two states of a course, frame by frame.

    Args:
        points: that S sees; course: of the frames.
        first: frame of the course that comes next; states: the two before it, (2, latent).
        into: features of the next frame, which `look` writes, shape (3 M,).
    """

    def __init__(self, points: ClothPoints, course: BodyCourse, first: int, states: NDArray, into: NDArray) -> None:
        self.points, self.course, self.frame, self.into = points, course, first, into
        *hidden, last = points.decoder.layers
        self.layers, self.last = [LayerBuffers(layer.rows) for layer in hidden], last
        self.state = np.ones(len(self.layers[0].rows), np.float32)  # ends in a one, for the biases
        self.older, self.newer = (np.empty(last.rows.shape[1], np.float32) for _ in range(2))
        self.before: NDArray | None = None
        for state in states:
            self._keep(state)

    def look(self) -> None:
        """Write what S sees of the cloth in the next frame."""
        points = 3 * self.points.count
        if points:
            self._look_at_points(self.into[:points])
        if self.points.size > points:
            self.into[points:] = self.points.proxies(np.stack([self.older, self.newer], axis=1)).T.reshape(-1)

    def _look_at_points(self, into: NDArray) -> None:
        both = np.stack([self.newer, 2 * self.newer - self.older], axis=1)
        if self.before is None:
            self.before = self.points.points(self.older[:, None], self.course, self._past(0, 1))[0]
        now, carried = self.points.points(both, self.course, self._past(1, 3))
        away = now + now
        away -= self.before
        away -= carried
        away -= self.course.bend[self.frame]
        away = away @ self.course.matrices[self.frame + 2, self.points.hub, :, :3]
        np.divide(away.reshape(-1), SATURATION, into)
        np.tanh(into, into)
        np.multiply(into, np.float32(LIMIT), into)
        self.before = now

    def keep(self, state: NDArray) -> None:
        """Take the state of the frame that `look` was for, (latent,)."""
        self._keep(state)
        self.frame += 1

    def _keep(self, state: NDArray) -> None:
        self.older, self.newer = self.newer, self.older
        self.state[:-1] = state
        hidden = self.state
        for layer in self.layers:
            np.dot(hidden, layer.rows, layer.sums)
            hidden = layer.activate()
        np.dot(hidden, self.last.rows, self.newer)

    def _past(self, start: int, stop: int) -> slice:
        return slice(self.frame + start, self.frame + stop)
