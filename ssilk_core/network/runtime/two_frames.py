# SPDX-License-Identifier: Apache-2.0
"""A few points of the cloth in two consecutive frames, in few numpy calls.

With so few numbers a frame takes as long as its calls are many. So buffers and views of them are kept, each call runs
along rows of joints or points of both frames, and proxies are composed with their ancestors in rounds that double
their reach. Columns of a matrix are ordered origin, x, y, z here, so that a row of numbers 1, x, y, z is a point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Ints, Scene
from .decoder import NumpyDecoder
from .kinematics import SHORTEST
from .networks import Parameters, as_float32
from .skinning import tiles, weights_of_joints

COLUMNS = (3, 0, 1, 2)  # of a matrix [R, t], as they are ordered here


class PointRig:
    """What M vertices of a garment are blended from.

    Args:
        scene, parameters: of the garment; decoder: of it; rows: the vertices, shape (M,).

    Attributes:
        shapes, rest: blendshapes of the points and these at rest [m], coordinate after coordinate, (K, 3 M), (3 M,).
        of_character, of_proxies: weights of their joints, shapes (J, M) and (P, M).
        order: the proxies by generations, shape (P,).
        anchors: the character's joints that proxies hang on, shape (A,).
        rounds: for each, the first in `order` of the proxies that are composed with others, and which these are,
            counted through the anchors and then through `order`.
        pivots: origins of the proxies' bind poses [m], shape (3, P).
    """

    def __init__(self, scene: Scene, parameters: Parameters, decoder: NumpyDecoder, rows: Ints) -> None:
        self.decoder, joints, proxies = decoder, scene.character.skeleton.joint_count, scene.rig.proxy_count
        whole = [tile.shapes.reshape(len(tile.shapes), 3, -1) for tile in tiles(scene, parameters)]
        shapes = np.concatenate(whole, axis=2)[:, :, rows].reshape(len(whole[0]), -1)
        self.shapes, self.rest = as_float32(shapes[:-1]), as_float32(shapes[-1])
        depth = np.zeros(joints + proxies, int)
        for proxy, parent in enumerate(scene.rig.parents, joints):
            depth[proxy] = depth[parent] + 1
        self.order = np.argsort(depth[joints:], kind="stable")
        parents, depth = scene.rig.parents[self.order], np.sort(depth[joints:])
        self.anchors = np.unique(parents[parents < joints])
        count, place = len(self.anchors), np.empty(joints + proxies, int)
        place[self.anchors], place[joints + self.order] = np.arange(count), np.arange(count, count + proxies)
        above = np.concatenate([np.arange(count), place[parents]])
        self.rounds: list[tuple[int, Ints]] = []
        while (first := int(np.searchsorted(depth, 2 ** len(self.rounds)))) < proxies:
            self.rounds.append((first, above[count + first :]))
            above = above[above]
        weights = weights_of_joints(scene, parameters, rows)
        self.of_character = as_float32(weights[:, :joints].T)
        self.of_proxies = as_float32(weights[:, joints + self.order].T)
        self.pivots = as_float32(scene.rig.bind_transforms[self.order, :3, 3].T)


class TwoFrames:
    """Decodes the points of a rig in two frames at once."""

    def __init__(self, rig: PointRig) -> None:
        self.rig, decoder, proxies, anchors = rig, rig.decoder, len(rig.order), len(rig.anchors)
        kinds, points = len(decoder.scale) // 3, rig.of_proxies.shape[1]

        def buffer(*shape: int) -> NDArray:
            return np.zeros(shape, np.float32)

        def whole(values: NDArray, *shape: int) -> NDArray:
            return as_float32(np.broadcast_to(values, shape))

        # What D gives for proxies: by coordinates, then x axis, what makes the y axis, and displacement.
        shape = 3, kinds, 2, proxies
        number = np.arange(3)[:, None, None, None] + 3 * np.arange(kinds)[:, None, None]
        number = number + len(decoder.layers[-1].bias) * np.arange(2)[:, None] + decoder.activation_count
        self.places = number + 3 * kinds * rig.order
        self.scale, self.identity = (
            whole(values.reshape(kinds, 3).T[:, :, None, None], *shape)
            for values in (decoder.scale, decoder.identity)
        )
        self.given = buffer(*shape)
        self.long, self.second = self.given[:, ::2], self.given[:, 1]
        limits = np.array([[SHORTEST, 1], [decoder.reach, decoder.reach]], np.float32)[: self.long.shape[1]]
        self.shortest, self.unit = (whole(each[:, None, None], *self.long.shape[1:]) for each in limits.T)

        # Rows 1, x, y, z, x, y; columns origin, x, y, z, displacement, pivot: what a proxy does about its pivot.
        self.own = own = buffer(6, 6, 2, proxies)
        own[0, 0], own[1:4, 5] = 1, rig.pivots[:, None]
        self.x, self.y, self.z = (own[1:4, column] for column in (1, 2, 3))
        self.limited = own[1:4, 1 : 3 * self.long.shape[1] : 3]
        self.axes, self.again = own[1:3, 1:3], own[4:6, 1:3]
        self.turned = (own[2:5, 1], own[3:6, 2]), (own[3:6, 1], own[2:5, 2])
        self.parts, self.origin = own[1:4, 1:], own[1:4, 0]
        self.shares = whole(np.concatenate([-rig.pivots, np.ones((2, proxies))])[:, None], 5, 2, proxies)

        self.matrices = buffer(4, 4, 2, anchors + proxies)
        self.matrices[0, 0] = 1
        self.roots, self.of_proxies = self.matrices[1:, ..., :anchors], self.matrices[..., anchors:]
        self.blended = self.of_proxies[1:].reshape(24, proxies)
        self.affine, self.rest = buffer(3, 4, 2, points), buffer(2, 3 * points)

    def points(self, outputs: NDArray, anchors: NDArray, affine: NDArray) -> NDArray:
        """Return the points [m], shape (3, 2, M).

        Args:
            outputs: of D's network in both frames, shape (2, outputs).
            anchors: skinning matrices of the rig's anchors, shape (3, 4, 2, A).
            affine: what the character's joints add to the matrix of each point, shape (3, 4, 2, M).
        """
        rig, whole, rest = self.rig, self.affine, self.rest
        self._place_proxies(outputs, anchors)
        np.matmul(self.blended, rig.of_proxies, whole.reshape(24, -1))
        np.add(whole, affine, whole)
        activations = rig.decoder.activations(outputs[:, : rig.decoder.activation_count].T)
        np.matmul(activations.T, rig.shapes, rest)
        np.add(rest, rig.rest, rest)
        np.multiply(whole[:, 1:], rest.reshape(2, 3, -1).swapaxes(0, 1), whole[:, 1:])
        return np.add.reduce(whole, 1)

    def _place_proxies(self, outputs: NDArray, anchors: NDArray) -> None:
        """Fill `matrices` with the skinning matrices of anchors and proxies."""
        self._read_proxies(outputs)
        np.add.reduce(self.parts * self.shares, 1, None, self.origin)
        self.of_proxies[:] = self.own[:4, :4]
        self.roots[:] = anchors
        for first, above in self.rig.rounds:
            below = self.of_proxies[..., first:]
            products = self.matrices[1:].take(above, 3, None, "clip")[:, :, None] * below
            np.add.reduce(products, 1, None, below[1:])

    def _read_proxies(self, outputs: NDArray) -> None:
        """Fill axes and displacements in `own` as `kinematics.rotation_from_six_d` and `limited` have them."""
        given, long, second, x = self.given, self.long, self.second, self.x
        outputs.take(self.places, None, given, "clip")
        np.multiply(given, self.scale, given)
        np.add(given, self.identity, given)
        length = np.sqrt(np.add.reduce(long * long, 0))
        np.maximum(length, self.shortest, out=length)
        np.divide(length, self.unit, length)
        np.divide(long, length, self.limited)
        np.subtract(second, np.add.reduce(x * second, 0) * x, second)
        length = np.sqrt(np.add.reduce(second * second, 0))
        np.divide(second, np.maximum(length, SHORTEST, out=length), self.y)
        self.again[:] = self.axes
        ahead, behind = self.turned
        np.subtract(np.multiply(*ahead), np.multiply(*behind), self.z)
