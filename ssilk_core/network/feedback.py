# SPDX-License-Identifier: Apache-2.0
"""What the stepper S sees of the decoded cloth (paper, Figure 2): where inertia would carry points of it.

Latents are opaque, and live in the turning frame of the body. A few points of the cloth say the same in metres. With
x_{t-1}, x_{t-2} their last two positions, and x^_t where the pose at t puts them if the outputs of D went on as they
changed last,

    m_t = R_t^T (2 x_{t-1} - x_{t-2} - x^_t)

is how far the free flight of each point departs from what the latents would do without a force, in the root's frame
R_t. It knows no position, no heading and no steady velocity. It is zero for a garment at rest on a body at rest, so
that the quasi-static state stays an equilibrium.

Free flight ends at colliders. Points at which the network sees them (`network.proximity`) know a plane of the nearest
one in each frame, with the normal n_t and the depth e_t(x) below it, about where the body carries the point. To them

    m_t += R_t^T n_t max(e_t(2 x_{t-1} - x_{t-2}) - max(e_{t-1}(x_{t-1}), 0), 0)

is added: they come no deeper than they were. It is zero, too, where nothing moves.

S sees m_t in `UNIT`, saturated at `LIMIT`; it knows gravity from the pose.

In the paper each state is decoded to give the garment "and the proxy animation feedback to the stepper module", and
no equation says in what form. With `feedback_proxies` S sees, after the points, the proxies of z_{t-2} and then those
of z_{t-1}: of each its local 6D rotation less that of the rig, and its displacement [dm] where proxies move.
"""

from __future__ import annotations

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Scene
from .schemes import SCHEMES
from .settings import ModelConfig

UNIT, LIMIT = 0.05, 4.0  # [m] of a feature of one, and where features saturate


def feedback_vertices(scene: Scene, config: ModelConfig) -> Ints:
    """Return the vertices that S sees, shape (M,); empty without S."""
    return spread_vertices(scene, config.feedback_points if SCHEMES[config.scheme].states else 0)


def stopped_points(scene: Scene, config: ModelConfig) -> int:
    """Return how many of the first of `feedback_vertices` colliders stop: those that see them, too."""
    return min(len(feedback_vertices(scene, config)), config.proximity_points)


def spread_vertices(scene: Scene, count: int) -> Ints:
    """Return so many vertices, or all, spread over the cloth that is not pinned.

    The lowest one comes first, then always the one furthest from those before. Sums are taken in one order on every
    machine, so that each finds the same vertices.
    """
    free = np.flatnonzero(scene.classes != PINNED)
    return free[spread_rows(scene.garment.sewn_mesh.points[free], count)]


def spread_rows(points: Floats, count: int) -> Ints:
    """Return which of points (P, 3) `spread_vertices` chooses."""
    count = min(count, len(points))
    chosen: list[int] = []
    nearest, columns = np.full(len(points), np.inf), np.ascontiguousarray(points.T)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()) if chosen else int(points[:, 1].argmin()))
        x, y, z = columns - columns[:, chosen[-1:]]
        nearest = np.minimum(nearest, x * x + y * y + z * z)
    return np.array(chosen, dtype=np.int64)


def bends(origins: Floats) -> Floats:
    """Return second differences o_t - 2 o_{t-1} + o_{t-2} of positions (F, 3), zero for the first two."""
    found = np.zeros_like(origins)
    found[2:] = origins[2:] - 2 * origins[1:-1] + origins[:-2]
    return found


def feedback_points(scene: Scene, config: ModelConfig) -> int:
    """Return how many vertices S sees."""
    if not SCHEMES[config.scheme].states:
        return 0
    return min(config.feedback_points, int((scene.classes != PINNED).sum()))


def feedback_size(scene: Scene, config: ModelConfig) -> int:
    """Return the number of features that S sees: three for each vertex of `feedback_vertices`, and of proxies."""
    if not SCHEMES[config.scheme].states:
        return 0
    proxies = 2 * config.proxy_outputs * scene.rig.proxy_count if config.feedback_proxies else 0
    return 3 * feedback_points(scene, config) + proxies
