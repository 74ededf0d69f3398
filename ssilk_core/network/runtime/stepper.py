# SPDX-License-Identifier: Apache-2.0
"""The recurrences of `model.integrators`, one frame at a time, in few numpy calls.

Of `SpringVerlet`:

With p the quasi-static state, w = z_{t-1} - p and v = z_{t-1} - z_{t-2}, the first layer of S is linear in w and v
plus a part that the pose alone decides, as it decides all of what S gives to a garment at rest:

    z_t = p + f + soft_clamp(u - k f),    f = w + beta v,    u = s (S(w, v, pose, m) - S(0, 0, pose held still, 0))

with m what S sees of the cloth, and the norm of u clipped as there.

Of `Verlet`, the first layer of S is linear in zbar, z_{t-1} and m plus what the pose decides.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...physics.loops import installed
from ..feedback import LIMIT
from ..settings import (
    DISTANCE_SCALE,
    DIVERGENCE_BOUND,
    MAX_OUTPUT,
    OUTPUT_SCALE,
    RATE_ALLOWANCE,
    RECOVERY_FRAMES,
    SEEN_ALLOWANCE,
    SPRING_ALLOWANCE,
    VELOCITY_SCALE,
    ModelConfig,
)
from .character import CharacterFrames
from .feedback import SATURATION, BodyCourse, ClothPoints, SeenCloth
from .networks import Layer, LayerBuffers, Parameters, as_float32, evaluate, evaluate_tail, layers

MAX_SCALED_OUTPUT = OUTPUT_SCALE * MAX_OUTPUT
SAFE_SQUARED_NORM = MAX_SCALED_OUTPUT**2  # a vector with a smaller one has no entry that needs clamping


def diverged(states: NDArray) -> NDArray:
    """Return which states (F, latent) have diverged or are not finite, shape (F,)."""
    return ~(np.abs(states).max(axis=1) < DIVERGENCE_BOUND)  # false for NaN too


class SoftClamp:
    """`model.integrators.soft_clamp` in place, with preallocated buffers."""

    def __init__(self, bound: float, shape: tuple[int, ...]) -> None:
        self.half = bound / 2 or np.inf
        self.high = np.full(shape, self.half, dtype=np.float32)
        self.low, self.inner, self.over = -self.high, np.empty_like(self.high), np.empty_like(self.high)

    def __call__(self, values: NDArray) -> None:
        """Clamp values in place."""
        inner, over = self.inner, self.over
        largest = np.abs(values, over).argmax()  # four times as fast as `max`
        if over.item(largest) <= self.half:
            return
        np.minimum(values, self.high, out=inner)
        np.maximum(inner, self.low, out=inner)
        np.subtract(values, inner, over)
        np.divide(over, self.high, over)
        np.tanh(over, over)
        np.multiply(over, self.high, over)
        np.add(inner, over, values)


@dataclass(frozen=True, eq=False)
class StepperInputs:
    """Inputs of the stepper for F frames.

    Attributes:
        history: p of frame t and z_{t-2} in row t, so that one subtraction gives w and v, shape (F + 2, 2, latent).
        pose_sums: contribution of the pose to the sums of S's first layer, shape (F, hidden).
        course: the character as the points that S sees have it; None where it sees none.
        outputs: those of D's network, which S sees, shape (F, outputs); None where it does not.
        first: first frame that the stepper computes; the garment is at rest in earlier ones.
    """

    history: NDArray
    pose_sums: NDArray
    course: BodyCourse | None
    outputs: NDArray | None
    first: int


@dataclass(frozen=True, eq=False)
class SpringInputs(StepperInputs):
    """What the spring needs besides.

    Attributes:
        output_at_rest: s S(0, 0, pose held still), shape (F, latent).
        rate_allowance: limit of |u| due to the pose's rates, shape (F,).
    """

    output_at_rest: NDArray
    rate_allowance: NDArray


Inputs = TypeVar("Inputs", bound=StepperInputs)


class NumpyStepper(ABC, Generic[Inputs]):
    """Rolls out latents.

    Args:
        config: sizes and bounds; points: of the cloth that S sees.

    Attributes:
        first: weights of S's first layer for what changes with the states, shape (inputs, hidden).
        later: its other layers.
    """

    first: NDArray
    later: list[Layer]

    def __init__(self, config: ModelConfig, points: ClothPoints) -> None:
        self.config, self.points = config, points

    @abstractmethod
    def prepare(self, rest: NDArray, character: CharacterFrames, before: NDArray | None) -> Inputs:
        """Return the inputs of F frames.

        Args:
            rest: quasi-static latents (F, latent); character: in these frames.
            before: the two latents before the first frame (2, latent); None at the start of a motion, at rest.
        """

    @abstractmethod
    def _advance(self, inputs: Inputs, start: int) -> None:
        """Compute the latents from frame `start` on, and write them into `inputs`."""

    def _compiled(self) -> Callable[[Inputs, int], None] | None:
        """Return what does as `_advance` in loops that numba compiles; None where nothing does."""
        return None

    def _given(
        self, rest: NDArray, character: CharacterFrames, before: NDArray | None
    ) -> tuple[NDArray, BodyCourse | None, NDArray | None, int]:
        """Return history, course, outputs and first frame of `StepperInputs`."""
        course, outputs = None, None
        if self.points.size:
            course = self.points.course(character.all_matrices, character.bend, character.proximity)
            outputs = np.empty((len(rest), len(self.points.decoder.layers[-1].bias)), np.float32)
        history = np.empty((len(rest) + 2, 2, rest.shape[1]), dtype=np.float32)
        history[:-2, 0] = rest
        if before is None:
            history[2:4, 1] = rest[:2]
            return history, course, outputs, 2
        history[:2, 1] = before
        return history, course, outputs, 0

    def roll(self, inputs: Inputs, compiled: bool = False) -> NDArray:
        """Return the latents of all frames (F, latent), written into `inputs` with the outputs of D there.

        Args:
            compiled: whether loops that numba compiles take the steps, where there are some for these.
        """
        z, rest, start = inputs.history[2:, 1], inputs.history[:-2, 0], inputs.first
        self._decode(inputs, slice(0, start))
        advance = (self._compiled() if compiled else None) or self._advance
        while start < len(z):
            advance(inputs, start)
            bad = diverged(z[start:])
            if not bad.any():
                break
            first = start + int(bad.argmax())
            start = first + RECOVERY_FRAMES
            z[first:start] = rest[first:start]
            self._decode(inputs, slice(first, start))
        return z

    def _decode(self, inputs: Inputs, frames: slice) -> None:
        """Write the outputs of D for frames that are at rest."""
        if inputs.outputs is not None:
            inputs.outputs[frames] = evaluate(self.points.decoder.layers, inputs.history[2:, 1][frames].T).T

    def _seen_cloth(self, inputs: Inputs, start: int, into: NDArray) -> SeenCloth | None:
        """Return what writes features of the frames from `start` on into an array; None where S sees no cloth."""
        if inputs.course is None or inputs.outputs is None:
            return None
        return SeenCloth(
            self.points, inputs.course, start, inputs.history[start : start + 2, 1], inputs.outputs, into
        )

    def _buffers(self) -> list[LayerBuffers]:
        return [LayerBuffers(rows) for rows in (self.first, *(layer.rows for layer in self.later[:-1]))]

    def _evaluate(self, buffers: list[LayerBuffers], state: NDArray, pose_sum: NDArray, out: NDArray) -> None:
        """Write the output of S at `state` (inputs,) into `out` (latent,).

        Args:
            buffers: of `_buffers`; pose_sum: what the pose adds to the first layer, shape (hidden,).
        """
        sums = buffers[0].sums
        np.dot(state, self.first, sums)
        np.add(sums, pose_sum, sums)
        hidden = buffers[0].activate()
        for buffer in buffers[1:]:
            np.dot(hidden, buffer.rows, buffer.sums)
            hidden = buffer.activate()
        np.dot(hidden, self.later[-1].rows, out)


class SpringStepper(NumpyStepper[SpringInputs]):
    """Rolls out latents of `SpringVerlet`.

    Args:
        config: sizes and bounds; parameters: of the whole network.
        static, rates: sizes of the parts of a dynamic descriptor.
        points: of the cloth that S sees.
    """

    def __init__(
        self, config: ModelConfig, parameters: Parameters, static: int, rates: int, points: ClothPoints
    ) -> None:
        super().__init__(config, points)
        beta, share = (parameters[f"integrator.{name}"] for name in ("beta", "share"))
        first, *hidden, last = layers(parameters, "stepper")
        blocks = np.cumsum([config.latent] * 3 + [static, rates])
        of_now, of_speed, of_away, of_static, self.of_rates, of_seen = np.split(first.weights, blocks, axis=1)
        speed, away = VELOCITY_SCALE * of_speed, DISTANCE_SCALE * of_away
        self.bias, self.of_still = first.bias, np.hstack([of_now, of_static])
        self.first = as_float32(np.hstack([of_now - away, speed - away * beta, of_seen]).T)
        self.later = [*hidden, Layer(as_float32(OUTPUT_SCALE * last.rows))]
        self.beta = beta.astype(np.float32)
        self.stiffness = (config.stiffness / (1 + np.exp(-share))).astype(np.float32)

    def prepare(self, rest: NDArray, character: CharacterFrames, before: NDArray | None) -> SpringInputs:
        static, rates = character.static, character.rates
        history, course, outputs, first = self._given(rest, character, before)
        still = self.of_still @ np.hstack([rest, static]).T + self.bias
        pose_sums = np.ascontiguousarray((still + self.of_rates @ rates.T).T)
        output = evaluate_tail(self.later, still).T
        output_at_rest = np.ascontiguousarray(output.clip(-MAX_SCALED_OUTPUT, MAX_SCALED_OUTPUT))
        rate_allowance = RATE_ALLOWANCE * np.linalg.norm(rates, axis=1)
        return SpringInputs(history, pose_sums, course, outputs, first, output_at_rest, rate_allowance)

    def _advance(self, inputs: SpringInputs, start: int) -> None:
        z, of_velocity, history = self.config.latent, self.config.velocity_allowance, inputs.history[start:]
        buffers = self._buffers()
        state = np.zeros(len(self.first), np.float32)
        differences, seen = state[: 2 * z].reshape(2, z), state[2 * z :]
        along, pull, own = (np.empty(z, np.float32) for _ in range(3))
        away, velocity = differences
        clamp_step, clamp = SoftClamp(self.config.max_latent_step, (z,)), self.config.latent_bound or np.inf
        poses = inputs.pose_sums[start:], inputs.output_at_rest[start:], inputs.rate_allowance[start:].tolist()
        frames = zip(history[:-2], history[:-2, 0], history[1:-1, 1], history[2:, 1], *poses)
        with np.errstate(over="ignore", invalid="ignore"):  # `roll` handles diverged states
            cloth = self._seen_cloth(inputs, start, seen)
            for past, rest, now, new, pose_sum, at_rest, rate_limit in frames:
                np.subtract(now, past, differences)
                if cloth:
                    cloth.look()
                    rate_limit += SEEN_ALLOWANCE * sqrt(seen.dot(seen))
                self._evaluate(buffers, state, pose_sum, own)
                if not own.dot(own) < SAFE_SQUARED_NORM:
                    np.clip(own, -MAX_SCALED_OUTPUT, MAX_SCALED_OUTPUT, own)
                np.multiply(self.beta, velocity, along)
                np.add(along, away, along)
                np.multiply(self.stiffness, along, pull)
                np.subtract(own, at_rest, own)
                limit = (
                    SPRING_ALLOWANCE * sqrt(pull.dot(pull)) + of_velocity * sqrt(velocity.dot(velocity)) + rate_limit
                )
                size = sqrt(own.dot(own))
                if size > limit:
                    np.multiply(own, limit / size, own)
                np.subtract(own, pull, own)
                clamp_step(own)
                np.add(own, along, own)
                np.add(own, rest, new)
                np.clip(new, -clamp, clamp, new)
                if cloth:
                    cloth.keep(new)

    @cached_property
    def _arrays(self) -> tuple[tuple[Any, ...], ...]:
        """Spring, limits, weights of S and of D, and the rig of the points, as `compiled.roll_spring` takes them."""
        from .compiled import matrices, rig_arrays

        config, decoder, hidden = self.config, self.points.decoder, np.ones(self.first.shape[1], np.float32)
        allowances = (SPRING_ALLOWANCE, config.velocity_allowance, SEEN_ALLOWANCE)
        clamps = MAX_SCALED_OUTPUT, config.max_latent_step / 2 or np.inf, config.latent_bound or np.inf
        limits = tuple(np.float32(value) for value in (*clamps, *allowances, SATURATION, LIMIT))
        first = tuple(each[0] for each in matrices(decoder.layers[:1]))
        return (
            (self.beta, self.stiffness), limits, (self.first, hidden, matrices(self.later)),
            (first, matrices(decoder.layers[1:])), rig_arrays(self.points.rig),
        )  # fmt: skip

    def _compiled(self) -> Callable[[SpringInputs, int], None] | None:
        points, decoder = self.points, self.points.decoder
        usual = points.size and decoder.tanh and decoder.readout is None
        return self._advance_compiled if usual and installed() else None

    def _advance_compiled(self, inputs: SpringInputs, start: int) -> None:
        from .compiled import roll_spring

        assert inputs.course is not None and inputs.outputs is not None
        course = tuple(vars(inputs.course).values())
        past = np.empty((3, inputs.outputs.shape[1]), np.float32)
        past[:2] = evaluate(self.points.decoder.layers, inputs.history[start : start + 2, 1].T).T
        poses = inputs.pose_sums, inputs.output_at_rest, as_float32(inputs.rate_allowance)
        roll_spring(inputs.history, poses, *self._arrays, course, past, inputs.outputs, start)


class VerletStepper(NumpyStepper[StepperInputs]):
    """Rolls out latents of `Verlet`; arguments as for `SpringStepper`."""

    def __init__(
        self, config: ModelConfig, parameters: Parameters, static: int, rates: int, points: ClothPoints
    ) -> None:
        super().__init__(config, points)
        self.alpha, self.beta = (as_float32(parameters[f"integrator.{name}"]) for name in ("alpha", "beta"))
        first, *self.later = layers(parameters, "stepper")
        blocks = np.cumsum([config.latent] * 2 + [static + rates])
        of_forward, of_now, self.of_pose, of_seen = np.split(first.weights, blocks, axis=1)
        self.bias, self.first = first.bias, as_float32(np.hstack([of_forward, of_now, of_seen]).T)

    def prepare(self, rest: NDArray, character: CharacterFrames, before: NDArray | None) -> StepperInputs:
        history, course, outputs, first = self._given(rest, character, before)
        pose = np.hstack([character.static, character.rates])
        return StepperInputs(history, as_float32((self.of_pose @ pose.T + self.bias).T), course, outputs, first)

    def _advance(self, inputs: StepperInputs, start: int) -> None:
        z, history, buffers = self.config.latent, inputs.history[start:, 1], self._buffers()
        state = np.zeros(len(self.first), np.float32)
        forward, newest, seen = state[:z], state[z : 2 * z], state[2 * z :]
        velocity, added = np.empty(z, np.float32), np.empty(z, np.float32)
        clamp_step, clamp = SoftClamp(self.config.max_latent_step, (z,)), self.config.latent_bound or np.inf
        with np.errstate(over="ignore", invalid="ignore"):  # `roll` handles diverged states
            cloth = self._seen_cloth(inputs, start, seen)
            for past, now, new, pose_sum in zip(history, history[1:], history[2:], inputs.pose_sums[start:]):
                np.subtract(now, past, velocity)
                np.multiply(self.beta, velocity, velocity)
                np.multiply(self.alpha, now, forward)
                np.add(forward, velocity, forward)
                newest[:] = now
                if cloth:
                    cloth.look()
                self._evaluate(buffers, state, pose_sum, added)
                clamp_step(added)
                np.add(forward, added, new)
                np.clip(new, -clamp, clamp, new)
                if cloth:
                    cloth.keep(new)
