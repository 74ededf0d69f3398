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
from ..feedback import LIMIT, UNIT, feedback_size, feedback_vertices, stopped_points
from ..proximity import PLANE
from .decoder import NumpyDecoder
from .networks import LayerBuffers, as_float32
from .two_frames import COLUMNS, PointRig, TwoFrames

ZERO = np.float32(0)
SATURATION = np.float32(UNIT * LIMIT)  # [m]


@dataclass(frozen=True, eq=False)
class BodyCourse:
    """The character in F frames, and but for `bend` in the two before them, as the points see it.

    Attributes:
        anchors: skinning matrices of the points' anchors about each root, shape (3, 4, F + 2, A).
        affine: what the character's joints add to each point's matrix, shape (3, 4, F + 2, M).
        turns: rotations of the root, shape (F + 2, 3, 3).
        bend: second differences of the root's position [m], shape (F, 3, 1).
        normals, offsets: of the planes of colliders (`network.feedback`), shapes (F + 2, 3, C), (F + 2, C); a point x
            lies offset - normal . x below. C = 0 without any.
    """

    anchors: NDArray
    affine: NDArray
    turns: NDArray
    bend: NDArray
    normals: NDArray
    offsets: NDArray


class ClothPoints:
    """The points that S sees, and what else it sees.

    Args:
        file: the trained garment; decoder: of it.
    """

    def __init__(self, file: ModelFile, decoder: NumpyDecoder) -> None:
        self.decoder, rows = decoder, feedback_vertices(file.scene, file.config)
        self.rig = PointRig(file.scene, file.parameters, decoder, rows)
        self.count, self.hub = len(rows), file.scene.character.skeleton.hub
        self.size = feedback_size(file.scene, file.config)
        self.stopped = stopped_points(file.scene, file.config)

    def course(self, matrices: NDArray, bend: Floats, proximity: Floats | None = None) -> BodyCourse:
        """Return F frames for the points.

        Args:
            matrices: skinning matrices of F + 2 frames, shape (J, 3, 4, F + 2).
            bend: of the F frames, shape (F, 3).
            proximity: to colliders in the F + 2 frames, shape (F + 2, P, 5); None for none.
        """
        own, met = matrices[:, :, COLUMNS].transpose(1, 2, 3, 0), np.zeros((matrices.shape[3], 0, 4))
        if proximity is not None:
            met = proximity[:, : self.stopped, PLANE]
        turns = matrices[self.hub, :, :3].transpose(2, 0, 1)
        return BodyCourse(
            as_float32(own[..., self.rig.anchors]),
            as_float32(own @ self.rig.of_character),
            as_float32(turns),
            as_float32(bend[:, :, None]),
            as_float32(met[..., :3].swapaxes(1, 2)),
            as_float32(met[..., 3]),
        )

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
        outputs: of D in the F frames of the course, which `keep` writes, shape (F, outputs).
        into: features of the next frame, which `look` writes, shape (3 M,).
    """

    def __init__(
        self, points: ClothPoints, course: BodyCourse, first: int, states: NDArray, outputs: NDArray, into: NDArray
    ) -> None:
        self.points, self.course, self.frame, self.outputs, self.into = points, course, first, outputs, into
        self.frames = TwoFrames(points.rig)
        self.before: NDArray | None = None
        *hidden, last = points.decoder.layers
        self.layers, self.last = [LayerBuffers(layer.rows) for layer in hidden], last
        self.state = np.ones(len(self.layers[0].rows), np.float32)  # ends in a one, for the biases
        self.past = np.empty(
            (3, last.rows.shape[1]), np.float32
        )  # outputs at z_{t-2}, z_{t-1}, and as they would go on
        for into, state in zip(self.past, states):
            self._decode(state, into)

    def look(self) -> None:
        """Write what S sees of the cloth in the next frame."""
        points = 3 * self.points.count
        if points:
            self._look_at_points(self.into[:points])
        if self.points.size > points:
            self.into[points:] = self.points.proxies(self.past[:2].T).T.reshape(-1)

    def _look_at_points(self, into: NDArray) -> None:
        older, newer, on = self.past
        np.add(newer, newer, on)
        np.subtract(on, older, on)
        if self.before is None:
            self.before = self._points(self.past[:2], self.frame)[:, 0]
        now, carried = self._points(self.past[1:], self.frame + 1).swapaxes(0, 1)
        away = now + now
        np.subtract(away, self.before, away)
        np.subtract(away, carried, away)
        np.subtract(away, self.course.bend[self.frame], away)
        if self.course.offsets.shape[1]:
            self._stop(away, carried, now)
        np.matmul(away.T, self.course.turns[self.frame + 2], into.reshape(-1, 3))
        np.divide(into, SATURATION, into)
        np.tanh(into, into)
        np.multiply(into, np.float32(LIMIT), into)
        self.before = now

    def _stop(self, away: NDArray, carried: NDArray, now: NDArray) -> None:
        """Let points (3, M) come no deeper into colliders in free flight than they were in the frame before.

        Args:
            away: of the flight from where the points are carried, changed in place.
            carried, now: where they are carried, and where they are in the frame before.
        """
        normals, offsets, frame = self.course.normals, self.course.offsets, self.frame + 1
        count, away_from = offsets.shape[1], normals[frame + 1]
        flight = away[:, :count] + carried[:, :count]
        np.multiply(flight, away_from, flight)
        deeper = np.subtract(offsets[frame + 1], np.add.reduce(flight))
        if not deeper.item(deeper.argmax()) > 0:  # mostly none is inside at all
            return
        was = offsets[frame] - np.add.reduce(normals[frame] * now[:, :count])
        np.subtract(deeper, np.maximum(was, ZERO, out=was), deeper)
        away[:, :count] += away_from * np.maximum(deeper, ZERO, out=deeper)

    def _points(self, outputs: NDArray, first: int) -> NDArray:
        """Return points of outputs (2, outputs) in two frames of the course, counted with the two before it."""
        course, frames = self.course, slice(first, first + 2)
        return self.frames.points(outputs, course.anchors[:, :, frames], course.affine[:, :, frames])

    def keep(self, state: NDArray) -> None:
        """Take the state of the frame that `look` was for, (latent,)."""
        self.past[0] = self.past[1]
        self._decode(state, self.past[1])
        self.outputs[self.frame] = self.past[1]
        self.frame += 1

    def _decode(self, state: NDArray, into: NDArray) -> None:
        self.state[:-1] = state
        hidden = self.state
        for layer in self.layers:
            np.dot(hidden, layer.rows, layer.sums)
            hidden = layer.activate()
        np.dot(hidden, self.last.rows, into)
