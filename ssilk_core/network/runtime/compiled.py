# SPDX-License-Identifier: Apache-2.0
"""Loops that numba compiles: the recurrence of `SpringStepper` with what S sees of the cloth, and skinning.

A frame's matrices are read in the time of some dozens of calls of numpy, which are spared here. Matrices that files
store as 16-bit integers stay integers: half as much is read. `stepper`, `feedback` and `skinning` are the reference,
which plays where numba is not installed, and short motions, which end before numba is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...physics.loops.compiling import compiled
from ...scene.assets import Floats
from ..packing import dequantize, quantize
from .kinematics import SHORTEST
from .networks import Layer, as_float32
from .skinning import TILE, Tile
from .two_frames import PointRig

ONE, TWO, HALF = np.float32(1), np.float32(2), np.float32(0.5)
LARGEST = np.float32(88)  # of an exponent whose exponential is finite
PER_LN2, LN2, LN2_REST = np.float32(1 / np.log(2)), np.float32(0.693359375), np.float32(np.log(2) - 0.693359375)
C2, C3, C4, C5, C6, C7 = (np.float32(1 / np.prod(np.arange(1.0, n + 1))) for n in range(2, 8))
LANES = 8  # frames that are skinned at once, in one vector register
SAME = 1e-6  # of a row's largest entry: by how much integers times their scale may miss it, which is rounding


def matrices(layers: list[Layer]) -> tuple[tuple[NDArray, ...], ...]:
    """Return the weights (inputs, outputs) of layers, the scales (outputs,) of these, and biases (outputs,).

    Weights are integers where those of all layers are such, as files have them.
    """
    packed = [quantize(layer.weights) for layer in layers]
    if all(
        (np.abs(dequantize(*pack) - layer.weights) <= SAME * np.abs(layer.weights).max(axis=1, keepdims=True)).all()
        for pack, layer in zip(packed, layers)
    ):
        weights = [(np.ascontiguousarray(integers.T), as_float32(scales[:, 0])) for integers, scales in packed]
    else:
        weights = [(as_float32(layer.rows[:-1]), np.ones(layer.rows.shape[1], np.float32)) for layer in layers]
    return tuple(zip(*((*pair, as_float32(layer.rows[-1])) for pair, layer in zip(weights, layers))))


def rig_arrays(rig: PointRig) -> tuple[Any, ...]:
    """Return order, parents, scales and identity of what D gives, reach, pivots, weights, shapes, ones and rest."""
    decoder = rig.decoder
    above = rig.rounds[0][1] if rig.rounds else rig.order
    ends = as_float32(decoder.scale[:, 0]), as_float32(decoder.identity[:, 0]), decoder.reach
    return rig.order, above, *ends, rig.pivots, rig.of_proxies, rig.shapes, np.ones_like(rig.rest), rig.rest


@compiled
def _exp(values, powers, out):
    """Write the exponentials of values (N,), of which those beyond `LARGEST` count as that, into out (N,).

    2^k times a Taylor series in what is left, at most ln(2) / 2; powers (N,) is a buffer of 32-bit integers.
    """
    twos = powers.view(np.float32)
    for n in range(len(values)):
        x = min(max(values[n], -LARGEST + ONE), LARGEST)
        k = np.floor(x * PER_LN2 + HALF)
        powers[n] = (np.int32(k) + np.int32(127)) << np.int32(23)
        r = (x - k * LN2) - k * LN2_REST
        tail = C2 + r * (C3 + r * (C4 + r * (C5 + r * (C6 + r * C7))))
        out[n] = ONE + (r + r * r * tail)
    for n in range(len(values)):
        out[n] *= twos[n]


@compiled
def _tanh(values, powers, scale, out):
    """Write scale times the hyperbolic tangents of values (N,) into out (N,), another array; values are doubled."""
    for n in range(len(values)):
        values[n] = TWO * values[n]
    _exp(values, powers, out)
    for n in range(len(values)):
        out[n] = scale * (ONE - TWO / (out[n] + ONE))


@compiled
def _product(given, weights, scales, added, out):
    """Write given (I,) times weights (I, O), scaled (O,), plus what is added (O,), into out (O,)."""
    inputs, outputs = weights.shape
    whole = inputs - inputs % 4
    for o in range(outputs):
        out[o] = np.float32(0)
    for i in range(0, whole, 4):
        a, b, c, d = given[i], given[i + 1], given[i + 2], given[i + 3]
        for o in range(outputs):
            total = out[o] + a * np.float32(weights[i, o])  # one instruction for each product and sum
            total = total + b * np.float32(weights[i + 1, o])
            total = total + c * np.float32(weights[i + 2, o])
            out[o] = total + d * np.float32(weights[i + 3, o])
    for i in range(whole, inputs):
        for o in range(outputs):
            out[o] += given[i] * np.float32(weights[i, o])
    for o in range(outputs):
        out[o] = scales[o] * out[o] + added[o]


@compiled
def _perceptron(first, tail, powers, sums, scale, out):
    """Write the outputs of the layers of `tail` into out, from the sums of the layer before them in `first`."""
    weights, scales, biases = tail
    count = len(first)
    for n in range(count):
        sums[n] = first[n]
    for layer in range(len(weights)):
        _exp(sums[:count], powers[:count], scale[:count])
        for n in range(count):
            sums[n] = sums[n] / (scale[n] + ONE)  # signs as in `networks`
        into = out if layer == len(weights) - 1 else scale
        _product(sums[:count], weights[layer], scales[layer], biases[layer], into)
        count = weights[layer].shape[1]
        if layer < len(weights) - 1:
            for n in range(count):
                sums[n] = scale[n]


@compiled
def _length(vector):
    return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@compiled
def _place(outputs, rig, anchors, affine, powers, work, points):
    """Write points (3, M) of outputs of D, of which the first activate blendshapes, in one frame.

    Args:
        rig: a `PointRig`, as `rig_arrays` has it.
        anchors, affine: of the frame, as `TwoFrames.points` has them, shapes (3, 4, A) and (3, 4, M).
    """
    order, above, scale, identity, reach, pivots, of_proxies, shapes, ones, rest = rig
    size, count, kept = len(scale), anchors.shape[2], points.shape[1]
    own, placed, shaped, active, doubled = work
    for place in range(12):
        for a in range(count):
            placed[a, place // 4, place % 4] = anchors[place // 4, place % 4, a]
    first = shapes.shape[0]
    for p in range(len(order)):
        at = first + size * order[p]
        for axis in range(3):
            own[axis, 0] = outputs[at + axis] * scale[axis] + identity[axis]
            own[axis, 1] = outputs[at + 3 + axis] * scale[3 + axis] + identity[3 + axis]
            own[axis, 3] = outputs[at + 6 + axis] * scale[6 + axis] + identity[6 + axis] if size > 6 else 0 * reach
        length = max(_length(own[:, 0]), SHORTEST)
        along = np.float32(0)
        for axis in range(3):
            own[axis, 0] /= length
            along += own[axis, 0] * own[axis, 1]
        for axis in range(3):
            own[axis, 1] -= along * own[axis, 0]
        length = max(_length(own[:, 1]), SHORTEST)
        moved = max(_length(own[:, 3]), reach) / reach
        for axis in range(3):
            own[axis, 1] /= length
            own[axis, 3] /= moved
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            own[axis, 2] = own[one, 0] * own[two, 1] - own[two, 0] * own[one, 1]
        for axis in range(3):
            turned = own[axis, 0] * pivots[0, p] + own[axis, 1] * pivots[1, p] + own[axis, 2] * pivots[2, p]
            own[axis, 3] += pivots[axis, p] - turned
        parent, into = placed[above[p]], placed[count + p]
        for axis in range(3):
            x, y, z = parent[axis, 1], parent[axis, 2], parent[axis, 3]
            into[axis, 0] = x * own[0, 3] + y * own[1, 3] + z * own[2, 3] + parent[axis, 0]
            for column in range(3):
                into[axis, column + 1] = x * own[0, column] + y * own[1, column] + z * own[2, column]
    for k in range(first):
        doubled[k] = outputs[k]
    _tanh(doubled, powers[:first], ONE, active)
    _product(active, shapes, ones, rest, shaped)
    for axis in range(3):
        for m in range(kept):
            points[axis, m] = affine[axis, 0, m]
            for column in range(3):
                points[axis, m] += affine[axis, column + 1, m] * shaped[column * kept + m]
        for p in range(len(order)):
            row = placed[count + p, axis]
            origin, x, y, z = row[0], row[1], row[2], row[3]
            for m in range(kept):
                share = x * shaped[m] + y * shaped[kept + m] + z * shaped[2 * kept + m] + origin
                points[axis, m] += of_proxies[p, m] * share


@compiled
def roll_spring(history, poses, spring, limits, stepper, decoder, rig, course, past, outputs, start):
    """Write the latents from frame `start` on into history, and the outputs of D there, as `SpringStepper` does.

    Args:
        history, outputs: of `StepperInputs`, from its first frame on; the latter ends with the frames.
        poses: `pose_sums`, `output_at_rest`, `rate_allowance` of `SpringInputs`, shapes (F, ...).
        spring: beta and stiffness, shape (latent,).
        limits: clamps of outputs, steps and latents, allowances of spring, velocity and features, and the unit and
            limit of features, as `SpringStepper.limits` has them.
        stepper, decoder: S's first weights, shape (inputs, hidden), with its later layers, and D's layers.
        rig, course: as `rig_arrays` has it; the arrays of `BodyCourse`.
        past: outputs of D in the two frames before `start`, and room for one more, shape (3, outputs), overwritten.
    """
    pose_sums, at_rests, allowances = poses
    beta, stiffness = spring
    most, step, bound, of_spring, of_velocity, of_seen, unit, limit = limits
    first, ones, later = stepper
    first_of_d, tail_of_d = decoder
    anchors, affine, turns, bend, normals, offsets = course
    z, points, stopped, shapes = len(beta), affine.shape[3], offsets.shape[1], len(rig[7])
    widest = max(past.shape[1], pose_sums.shape[1], len(first_of_d[2]), 3 * points)
    for layer in range(len(later[2])):
        widest = max(widest, len(later[2][layer]))
    for layer in range(len(tail_of_d[2])):
        widest = max(widest, len(tail_of_d[2][layer]))
    powers, sums, scale = np.empty(widest, np.int32), np.empty(widest, np.float32), np.empty(widest, np.float32)
    hidden, state = np.empty(widest, np.float32), np.zeros(len(first), np.float32)
    own, ahead, pull = np.empty(z, np.float32), np.empty(z, np.float32), np.empty(z, np.float32)
    work = (np.empty((3, 4), np.float32), np.empty((anchors.shape[3] + len(rig[0]), 3, 4), np.float32),
            np.empty(3 * points, np.float32), np.empty(shapes, np.float32), np.empty(shapes, np.float32))  # fmt: skip
    away, seen = np.empty((3, points), np.float32), np.empty(3 * points, np.float32)
    placed = np.empty((3, 3, points), np.float32)  # in the frame before the last, in that, and carried on
    before, now, carried = placed[0], placed[1], placed[2]
    for frame in range(start, len(pose_sums)):
        rest, older, newer, into = history[frame, 0], history[frame, 1], history[frame + 1, 1], history[frame + 2, 1]
        for n in range(z):
            state[n] = newer[n] - rest[n]
            state[z + n] = newer[n] - older[n]
        # What S sees of the cloth (`SeenCloth.look`).
        for n in range(past.shape[1]):
            past[2, n] = TWO * past[1, n] - past[0, n]
        for which in range(0 if frame == start else 1, 3):
            at = frame + which
            _place(past[which], rig, anchors[:, :, at], affine[:, :, at], powers, work, placed[which])
        for axis in range(3):
            for m in range(points):
                away[axis, m] = TWO * now[axis, m] - before[axis, m] - carried[axis, m] - bend[frame, axis, 0]
        for m in range(stopped):
            a, b = normals[frame + 1, :, m], normals[frame + 2, :, m]
            was, depth = offsets[frame + 1, m], offsets[frame + 2, m]
            for axis in range(3):
                was -= a[axis] * now[axis, m]
                depth -= b[axis] * (away[axis, m] + carried[axis, m])
            deeper = max(depth - max(was, ONE - ONE), ONE - ONE)
            for axis in range(3):
                away[axis, m] += b[axis] * deeper
        turn = turns[frame + 2]
        for m in range(points):
            for axis in range(3):
                found = away[0, m] * turn[0, axis] + away[1, m] * turn[1, axis] + away[2, m] * turn[2, axis]
                seen[3 * m + axis] = found / unit
        _tanh(seen, powers[: 3 * points], limit, state[2 * z :])
        for axis in range(3):
            for m in range(points):
                before[axis, m] = now[axis, m]
        # The step itself.
        strength = np.float32(0)
        for n in range(3 * points):
            strength += state[2 * z + n] * state[2 * z + n]
        _product(state, first, ones, pose_sums[frame], hidden[: first.shape[1]])
        _perceptron(hidden[: first.shape[1]], later, powers, sums, scale, own)
        pulled, speed, size = np.float32(0), np.float32(0), np.float32(0)
        for n in range(z):
            ahead[n] = beta[n] * state[z + n] + state[n]
            pull[n] = stiffness[n] * ahead[n]
            own[n] = min(max(own[n], -most), most) - at_rests[frame, n]
            pulled += pull[n] * pull[n]
            speed += state[z + n] * state[z + n]
            size += own[n] * own[n]
        allowed = of_spring * sqrt(pulled) + of_velocity * sqrt(speed) + of_seen * sqrt(strength) + allowances[frame]
        long = sqrt(size)
        share = np.float32(allowed / long) if long > allowed else ONE
        for n in range(z):
            taken = share * own[n] - pull[n]
            inner = min(max(taken, -step), step)
            if inner != taken:
                inner += step * np.float32(np.tanh((taken - inner) / step))
            into[n] = min(max(inner + ahead[n] + rest[n], -bound), bound)
        # What D makes of it (`SeenCloth.keep`).
        _product(into, *first_of_d, hidden[: len(first_of_d[2])])
        for n in range(past.shape[1]):
            past[0, n] = past[1, n]
        _perceptron(hidden[: len(first_of_d[2])], tail_of_d, powers, sums, scale, past[1])
        for n in range(past.shape[1]):
            outputs[frame, n] = past[1, n]


@dataclass(frozen=True, eq=False)
class SparseSkin:
    """A garment's blendshapes and influences, vertex after vertex.

    Attributes:
        shapes: blendshapes, then the rest shape [m], shape (3 V, K + 1).
        joints, weights: of the influences, the strongest first, shape (V, I).
        counts: how many of these each vertex has, shape (V,).
    """

    shapes: NDArray
    joints: NDArray
    weights: NDArray
    counts: NDArray

    @classmethod
    def of(cls, garment: list[Tile]) -> SparseSkin:
        """Return the skin of all tiles of a garment."""
        counts = np.concatenate([np.count_nonzero(tile.weights, axis=0) for tile in garment])
        joints, weights = np.zeros((len(counts), counts.max()), np.int32), np.zeros((len(counts), counts.max()))
        for tile in garment:
            order = np.argsort(-tile.weights, axis=0, kind="stable")[: counts.max()]
            joints[tile.vertices, : len(order)] = tile.joints[order].T
            weights[tile.vertices, : len(order)] = np.take_along_axis(tile.weights, order, axis=0).T
        shapes = [tile.shapes.reshape(len(tile.shapes), 3, -1).transpose(2, 1, 0) for tile in garment]
        rows = np.concatenate(shapes).reshape(-1, len(garment[0].shapes))
        return cls(as_float32(rows), joints, as_float32(weights), counts)

    def skin(self, activations: NDArray, matrices: NDArray, origins: Floats) -> Floats:
        """Return vertices in world space [m], shape (F, V, 3), as `skin_garment` does."""
        frames, count = len(origins), len(self.counts)
        active = as_float32(np.vstack([activations, np.ones((1, frames), np.float32)]))
        packed, found = _packed(matrices), np.empty((frames, count, 3))
        for start in range(0, count, TILE):  # whose points stay in the cache
            points = self.shapes[3 * start : 3 * (start + TILE)] @ active
            _skin(points, packed, self.joints, self.weights, self.counts, origins, start, found)
        return found


def _packed(matrices: NDArray) -> NDArray:
    """Return matrices (J, 3, 4, F) by `LANES` frames, zero behind the last one, shape (blocks, J, 12 LANES)."""
    joints, frames = len(matrices), matrices.shape[3]
    packed = np.zeros((-(-frames // LANES) * LANES, joints, 12), np.float32)
    packed[:frames] = matrices.reshape(joints, 12, frames).transpose(2, 0, 1)
    return as_float32(packed.reshape(-1, LANES, joints, 12).transpose(0, 2, 3, 1)).reshape(-1, joints, 12 * LANES)


@compiled
def _skin(points, matrices, joints, weights, counts, origins, start, found):
    """Write points (3 T, F), moved by matrices as `_packed` has them and origins (F, 3), into (F, V, 3) from `start`.

    The matrices of a block of frames stay in the nearest cache.
    """
    frames = len(origins)
    blend, out = np.empty(12 * LANES, np.float32), np.empty((3, LANES), np.float32)
    for block in range(len(matrices)):
        first, turn = block * LANES, matrices[block]
        here = min(LANES, frames - first)
        for t in range(len(points) // 3):
            v = start + t
            blend[:] = np.float32(0)
            for entry in range(counts[v]):
                weight, row = weights[v, entry], turn[joints[v, entry]]
                for n in range(12 * LANES):
                    blend[n] += weight * row[n]
            for axis in range(3):
                at = 4 * axis * LANES
                for n in range(here):
                    x, y, z = blend[at + n], blend[at + LANES + n], blend[at + 2 * LANES + n]
                    p, q, r = points[3 * t, first + n], points[3 * t + 1, first + n], points[3 * t + 2, first + n]
                    out[axis, n] = x * p + y * q + z * r + blend[at + 3 * LANES + n]
            for n in range(here):
                for axis in range(3):
                    found[first + n, v, axis] = out[axis, n] + origins[first + n, axis]
