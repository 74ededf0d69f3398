# SPDX-License-Identifier: Apache-2.0
"""The recurrence of `model.integrators.SpringVerlet`, frame after frame, in as few calls as numpy allows.

With p the quasi-static state, w = z_{t-1} - p and v = z_{t-1} - z_{t-2}, the first layer of S is linear in w and v
plus a part that the pose alone decides, as it decides all of what S gives to a garment at rest:

    z_t = p + f + limited(u - k f),    f = w + beta v,    u = s (S(w, v, pose) - S(0, 0, pose held still))

where u is shortened to what the spring and motion allow it, |u| <= (|k f| + |v|) / 2 + |rates of the pose| / 20.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from ..config import (
    DISTANCE_SCALE,
    LOST,
    MAX_OUTPUT,
    OUTPUT_SCALE,
    RATE_ALLOWANCE,
    RECOVERY,
    STATE_ALLOWANCE,
    VELOCITY_SCALE,
    ModelConfig,
)
from .networks import Layer, Parameters, continued, layers, single

LARGEST = OUTPUT_SCALE * MAX_OUTPUT  # of each scaled output of S
SAFE = LARGEST**2  # no entry of a vector with a smaller square passes it


def lost(states: NDArray) -> NDArray:
    """Return which states (F, latent) are not finite or leave all bounds, shape (F,)."""
    return ~(np.abs(states).max(axis=1) < LOST)  # NaN is not less than anything


class Limit:
    """`model.integrators.limited`: the identity up to half a bound, a smooth bend beyond; its own room to work in."""

    def __init__(self, bound: float, shape: tuple[int, ...]) -> None:
        self.half = bound / 2 or np.inf
        self.high = np.full(shape, self.half, dtype=np.float32)
        self.low, self.inner, self.over = -self.high, np.empty_like(self.high), np.empty_like(self.high)

    def __call__(self, values: NDArray) -> None:
        """Limit values in place."""
        inner, over = self.inner, self.over
        largest = np.abs(values, over).argmax()  # four times as fast as their maximum
        if over.item(largest) <= self.half:
            return
        np.minimum(values, self.high, inner)
        np.maximum(inner, self.low, inner)
        np.subtract(values, inner, over)
        np.divide(over, self.high, over)
        np.tanh(over, over)
        np.multiply(over, self.high, over)
        np.add(inner, over, values)


class Room:
    """A hidden layer as one frame goes through it, with the memory that it writes to."""

    def __init__(self, rows: NDArray) -> None:
        """Take weights (inputs, hidden), with biases as a row more where no other ones are added."""
        self.rows, hidden = rows, rows.shape[1]
        # Apart: numpy takes neighbours in memory for overlapping, and its exponential then takes 20 times as long.
        self.active, self.scale = np.ones(hidden + 1, np.float32), np.empty(hidden, np.float32)
        self.sums = self.active[:-1]  # the last one meets the next layer's biases
        self.one = np.ones_like(self.scale)  # an array: numpy takes longer over a number than over 512 of them

    def activate(self) -> NDArray:
        """Turn the sums into activations; return these and a one."""
        sums, scale = self.sums, self.scale
        np.exp(sums, scale)
        np.add(scale, self.one, scale)
        np.divide(sums, scale, sums)
        return self.active


@dataclass(frozen=True, eq=False)
class StepperInputs:
    """F frames of a motion as the stepper takes them.

    Attributes:
        history: p of frame t and z_{t-2} in row t, so that one subtraction gives w and v, shape (F + 2, 2, latent).
        driven: what the pose adds to the sums of S's first layer, shape (F, hidden).
        at_rest: s S(0, 0, pose held still), shape (F, latent).
        allowed: what the pose's rates allow S to give, shape (F,).
        first: frame that the stepper begins with; those before it are at rest.
    """

    history: NDArray
    driven: NDArray
    at_rest: NDArray
    allowed: NDArray
    first: int


class SpringStepper:
    """Rolls latents.

    Args:
        config: sizes and bounds; parameters: of the whole network.
        static: how many numbers of a dynamic descriptor are static ones.
    """

    def __init__(self, config: ModelConfig, parameters: Parameters, static: int) -> None:
        beta, share = (parameters[f"integrator.{name}"] for name in ("beta", "share"))
        first, *hidden, last = layers(parameters, "stepper")
        blocks = np.cumsum([config.latent] * 3 + [static])
        of_now, of_speed, of_away, of_static, self.of_rates = np.split(first.weights, blocks, axis=1)
        speed, away = VELOCITY_SCALE * of_speed, DISTANCE_SCALE * of_away
        self.bias, self.of_still = first.bias, np.hstack([of_now, of_static])
        self.first = single(np.hstack([of_now - away, speed - away * beta]).T)
        self.later = [*hidden, Layer(single(OUTPUT_SCALE * last.rows))]
        self.beta = beta.astype(np.float32)
        self.stiffness = (config.stiffness / (1 + np.exp(-share))).astype(np.float32)
        self.config = config

    def prepared(self, rest: NDArray, static: NDArray, rates: NDArray, before: NDArray | None) -> StepperInputs:
        """Return what poses decide.

        Args:
            rest: quasi-static latents (F, latent); static, rates: descriptors (F, S) and (F, R).
            before: the two latents before the first frame (2, latent); None where a motion begins, at rest.
        """
        still = self.of_still @ np.hstack([rest, static]).T + self.bias
        driven = np.ascontiguousarray((still + self.of_rates @ rates.T).T)
        at_rest = np.ascontiguousarray(continued(self.later, still).T.clip(-LARGEST, LARGEST))
        allowed = RATE_ALLOWANCE * np.linalg.norm(rates, axis=1)
        history = np.empty((len(rest) + 2, 2, rest.shape[1]), dtype=np.float32)
        history[:-2, 0] = rest
        if before is None:
            history[2:4, 1] = rest[:2]
            return StepperInputs(history, driven, at_rest, allowed, 2)
        history[:2, 1] = before
        return StepperInputs(history, driven, at_rest, allowed, 0)

    def rolled(self, inputs: StepperInputs) -> NDArray:
        """Return the latents of all frames (F, latent), written into `inputs`."""
        z, rest, start = inputs.history[2:, 1], inputs.history[:-2, 0], inputs.first
        while start < len(z):
            self._advance(inputs, start)
            bad = lost(z[start:])
            if not bad.any():
                break
            first = start + int(bad.argmax())
            start = first + RECOVERY
            z[first:start] = rest[first:start]
        return z

    def _advance(self, inputs: StepperInputs, start: int) -> None:
        z, history = self.config.latent, inputs.history[start:]
        rooms = [Room(rows) for rows in (self.first, *(layer.rows for layer in self.later[:-1]))]
        differences = np.empty((2, z), np.float32)
        along, pull, own = (np.empty(z, np.float32) for _ in range(3))
        state, (away, velocity) = differences.reshape(-1), differences
        sums, last = rooms[0].sums, self.later[-1].rows
        limit_step, limit_state = Limit(self.config.max_latent_step, (z,)), Limit(self.config.latent_bound, (z,))
        poses = inputs.driven[start:], inputs.at_rest[start:], inputs.allowed[start:].tolist()
        frames = zip(history[:-2], history[:-2, 0], history[1:-1, 1], history[2:, 1], *poses)
        with np.errstate(over="ignore", invalid="ignore"):  # `rolled` looks for lost states
            for past, rest, now, new, drive, calm, turning in frames:
                np.subtract(now, past, differences)
                np.dot(state, self.first, sums)
                np.add(sums, drive, sums)
                seen = rooms[0].activate()
                for room in rooms[1:]:
                    np.dot(seen, room.rows, room.sums)
                    seen = room.activate()
                np.dot(seen, last, own)
                if not own.dot(own) < SAFE:
                    np.clip(own, -LARGEST, LARGEST, own)
                np.multiply(self.beta, velocity, along)
                np.add(along, away, along)
                np.multiply(self.stiffness, along, pull)
                np.subtract(own, calm, own)
                most = STATE_ALLOWANCE * (sqrt(pull.dot(pull)) + sqrt(velocity.dot(velocity))) + turning
                size = sqrt(own.dot(own))
                if size > most:
                    np.multiply(own, most / size, own)
                np.subtract(own, pull, own)
                limit_step(own)
                np.add(own, along, own)
                np.add(own, rest, new)
                limit_state(new)
