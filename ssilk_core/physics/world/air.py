# SPDX-License-Identifier: Apache-2.0
"""Wind and its turbulence: a velocity at each place and time, the same for the same seed.

Turbulence is a sum of `MODES` random Fourier modes (Kraichnan, Phys. Fluids 13, 1970), each across its wave vector,
so that none of the air is compressed. Wave numbers run over eddies from the largest size down to a sixteenth of it,
with the energy of Kolmogorov's spectrum, k^(-5/3). The wind carries the eddies along (Taylor's hypothesis), and they
turn over in the time that gusts take through them.
"""

from __future__ import annotations

import numpy as np

from ...scene.assets import Air, Floats
from ...scene.assets.world import interpolated

MODES = 48
SMALLEST = 1 / 16  # of the largest eddy


class MovingAir:
    """The air of a shot; times are seconds since its first frame.

    Args:
        fps: frames per second of what changes [1/s].
    """

    def __init__(self, air: Air, fps: float) -> None:
        self._air, self._fps = air, fps
        steps = 0.5 * (air.velocity[1:] + air.velocity[:-1]) / fps
        self._travelled = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        rng = np.random.default_rng(air.seed)
        number = 2 * np.pi / air.length * SMALLEST ** -np.linspace(0, 1, MODES)  # equal steps of the logarithm
        along = rng.normal(size=(MODES, 3))
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.cross(along, rng.normal(size=(MODES, 3)))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        share = number ** (-2 / 3)  # k E(k), the energy in equal steps of log k
        self._waves, self._phase = along * number[:, None], rng.uniform(0, 2 * np.pi, MODES)
        self._across = across * np.sqrt(2 * share / share.sum())[:, None]
        self._turning = number * air.gusts.max()

    def velocity(self, points: Floats, seconds: float) -> Floats:
        """Return the velocity of the air [m/s] at points (V, 3) in the world [m], shape (V, 3)."""
        return self.velocities(points[None], np.array([seconds]))[0]

    def velocities(self, points: Floats, seconds: Floats) -> Floats:
        """Return the velocity of the air [m/s] at points (N, V, 3) at times (N,), shape (N, V, 3)."""
        wind, gusts = self._at(seconds)
        found = np.broadcast_to(wind[:, None], points.shape)
        if not self.has_gusts:
            return found
        return found + gusts[:, None, None] * (np.cos(2 * np.pi * self._turns(points, seconds)) @ self._across)

    def mean_velocities(self, points: Floats, seconds: Floats) -> Floats:
        """Return the mean over points of `velocities`, shape (N, 3); cosines, which take most of it, in float32."""
        wind, gusts = self._at(seconds)
        if not self.has_gusts:
            return wind
        turns = self._turns(points, seconds)
        turns -= np.rint(turns)
        mean = np.cos(np.float32(2 * np.pi) * turns.astype(np.float32)).mean(axis=1)
        return wind + gusts[:, None] * (mean @ self._across)

    @property
    def has_gusts(self) -> bool:
        """Whether its velocity depends on the place."""
        return bool((self._air.gusts > 0).any())

    def _at(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return the wind (N, 3) and the speed of gusts (N,) at times [m/s]."""
        wind, gusts = (interpolated(values, seconds, self._fps) for values in (self._air.velocity, self._air.gusts))
        return wind, gusts

    def _turns(self, points: Floats, seconds: Floats) -> Floats:
        """Return the phases of the modes at points (N, V, 3) at times (N,), in turns, shape (N, V, MODES)."""
        waves = self._waves.T / (2 * np.pi)
        turned = (self._turning * (self._air.begins + seconds)[:, None] + self._phase) / (2 * np.pi)
        found: Floats = (points.reshape(-1, 3) @ waves).reshape(*points.shape[:2], -1)
        found += (turned - self._carried(seconds) @ waves)[:, None]
        return found

    def _carried(self, seconds: Floats) -> Floats:
        """Return how far the wind has carried the air since time zero [m], shape (N, 3).

        Before the first frame it blew as it does then.
        """
        velocity, now = self._air.velocity, interpolated(self._air.velocity, seconds, self._fps)
        at = (seconds * self._fps).clip(0.0, len(velocity) - 1.0)
        low = at.astype(int)
        since = ((at - low) / self._fps)[:, None]
        inside = self._travelled[low] + 0.5 * since * (velocity[low] + now)
        return self._air.begins * velocity[0] + inside + (seconds - at / self._fps)[:, None] * now
