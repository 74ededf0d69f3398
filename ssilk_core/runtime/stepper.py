# SPDX-License-Identifier: Apache-2.0
"""The recurrence of `model.integrators.SpringVerlet`, frame after frame, in as few calls as numpy allows.

With p the quasi-static state, u = z_{t-1} - p and v = z_{t-1} - z_{t-2}, the first layer of S is linear in u and v
plus a part that the pose alone decides, as it decides all of what S gives to a garment at rest:

    z_t = p + f + limited(s (S(u, v, pose) - S(0, 0, pose held still)) - k f),    f = alpha u + beta v
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config import ModelConfig
from .networks import Layer, Parameters, continued, layers

VELOCITY, DISTANCE, REACH, MOST = 10.0, 3.0, 0.1, 100.0  # the constants of SpringVerlet


class Limit:
    """`model.integrators.limited`: the identity up to half a bound, a smooth bend beyond; its own room to work in."""

    def __init__(self, bound: float, shape: tuple[int, ...]) -> None:
        self.unlimited = not bound
        self.high = np.full(shape, bound / 2, dtype=np.float32)
        self.low, self.inner, self.over = -self.high, np.empty_like(self.high), np.empty_like(self.high)

    def __call__(self, values: NDArray) -> None:
        """Limit values in place."""
        if self.unlimited:
            return
        inner, over = self.inner, self.over
        np.maximum(values, self.low, inner)
        np.minimum(inner, self.high, inner)
        if inner.tobytes() == values.tobytes():  # nothing to bend, as in most frames: comparing costs least
            return
        np.subtract(values, inner, over)
        np.divide(over, self.high, over)
        np.tanh(over, over)
        np.multiply(over, self.high, over)
        np.add(inner, over, values)


class Room:
    """A hidden or last layer as one frame goes through it, with the memory that it writes to."""

    def __init__(self, layer: Layer) -> None:
        self.dot, self.bias = layer.weights.dot, layer.bias
        # Apart: numpy takes neighbours in memory for overlapping, and its exponential then takes 20 times as long.
        self.sums, self.scale = np.empty_like(layer.bias), np.empty_like(layer.bias)
        self.one = np.ones_like(self.bias)  # an array: numpy takes longer over a number than over 512 of them

    def activated(self, seen: NDArray, bias: NDArray) -> NDArray:
        """Return `networks.activate` of the sums."""
        sums, scale = self.sums, self.scale
        self.dot(seen, sums)
        np.add(sums, bias, sums)
        np.exp(sums, scale)
        np.add(scale, self.one, scale)
        np.divide(sums, scale, sums)
        return sums


@dataclass(frozen=True, eq=False)
class Course:
    """F frames of a motion as the stepper takes them.

    Attributes:
        history: p of frame t and z_{t-2} in row t, so that one subtraction gives u and v, shape (F + 2, 2, latent).
        driven: what the pose adds to the sums of S's first layer, shape (F, hidden).
        held: s S(0, 0, pose held still), shape (F, latent).
    """

    history: NDArray
    driven: NDArray
    held: NDArray


class SpringStepper:
    """Rolls latents.

    Args:
        config: sizes and bounds; parameters: of the whole network.
        static: how many numbers of a dynamic descriptor are static ones.
    """

    def __init__(self, config: ModelConfig, parameters: Parameters, static: int) -> None:
        alpha, beta, share = (parameters[f"integrator.{name}"] for name in ("alpha", "beta", "share"))
        first, *self.later = layers(parameters, "stepper")
        blocks = np.cumsum([config.latent] * 3 + [static])
        of_now, of_speed, of_away, of_static, self.of_rates = np.split(first.weights, blocks, axis=1)
        speed, away = VELOCITY * of_speed, DISTANCE * of_away
        self.first = Layer(np.hstack([of_now - away * alpha, speed - away * beta], dtype=np.float32), first.bias)
        self.of_still = np.hstack([of_now, of_static])
        stiffness = config.stiffness / (1 + np.exp(-share))
        self.inertia = np.array([[alpha, beta], [stiffness * alpha, stiffness * beta]], dtype=np.float32)
        self.config = config

    def prepared(self, rest: NDArray, static: NDArray, rates: NDArray) -> Course:
        """Return what poses decide, from quasi-static latents (F, latent) and descriptors (F, S) and (F, R)."""
        still = self.of_still @ np.hstack([rest, static]).T + self.first.bias[:, None]
        driven = np.ascontiguousarray((still + self.of_rates @ rates.T).T)
        held = REACH * np.ascontiguousarray(continued(self.later, still).T.clip(-MOST, MOST))
        history = np.empty((len(rest) + 2, 2, rest.shape[1]), dtype=np.float32)
        history[:-2, 0], history[2:4, 1] = rest, rest[:2]
        return Course(history, driven, held)

    def rolled(self, course: Course) -> NDArray:
        """Return the latents of all frames (F, latent), written into `course`; the first two are at rest."""
        with np.errstate(over="ignore"):  # an activation of minus infinity is zero
            self._advance(course.history, course.driven, course.held)
        return course.history[2:, 1]

    def _advance(self, history: NDArray, driven: NDArray, held: NDArray) -> None:
        z = history.shape[2]
        differences, forces, parts, given = (np.empty(shape, np.float32) for shape in ((2, z), (2, z), (2, 2, z), z))
        most = np.full(z, REACH * MOST, dtype=np.float32)
        least, state, (along, pull), (of_u, of_v) = -most, differences.reshape(-1), forces, parts.swapaxes(0, 1)
        push, bound = Limit(self.config.push, (z,)), Limit(self.config.bound, (z,))
        first, hidden, last = Room(self.first), [Room(layer) for layer in self.later[:-1]], self.later[-1].weights
        last_dot = (np.float32(REACH) * last).dot
        frames = zip(history[2:-2], history[2:-2, 0], history[3:-1, 1], history[4:, 1], driven[2:], held[2:])
        for past, rest, now, new, drive, calm in frames:
            np.subtract(now, past, differences)
            seen = first.activated(state, drive)
            for layer in hidden:
                seen = layer.activated(seen, layer.bias)
            last_dot(seen, given)
            np.maximum(given, least, given)
            np.minimum(given, most, given)
            np.multiply(self.inertia, differences, parts)
            np.add(of_u, of_v, forces)
            np.subtract(given, calm, given)
            np.subtract(given, pull, given)
            push(given)
            np.add(given, along, given)
            np.add(given, rest, new)
            bound(new)
