# SPDX-License-Identifier: Apache-2.0
"""A small wardrobe built in code, fitted to a body in its bind pose."""

from __future__ import annotations

import numpy as np

from ..assets import Character, Floats, Garment, Ints, Mesh
from ..errors import need
from .garments_mesh import Fit, fit, loft, relax

CLEARANCE = 0.010  # [m]; more than the 6 mm that must remain, because triangles cut corners


def build_garment(name: str, character: Character) -> Garment:
    """Return one of `GARMENTS` fitted to an upright character in an A-pose, without weights or classes.

    Raises:
        SsilkError: there is no garment of that name.
    """
    need(name in CUTS, f"garment '{name}'", "no such garment in the wardrobe", f"it is one of {', '.join(GARMENTS)}")
    points, faces = CUTS[name](fit(character))
    return Garment(Mesh(f"/{''.join(word.title() for word in name.split('_'))}", points, faces))


def cape(fit: Fit) -> tuple[Floats, Ints]:
    """Cut a cape: collar and yoke on the shoulders, open at the front, flared to the calves."""
    keys = cape_keys(fit)
    grid, depth = through(keys, 81)
    cling = np.interp(depth, [0, 0.09, 0.19], [0.5, 0.5, 0.0])[:, None]
    return loft(relax(fit, grid, CLEARANCE, cling=cling, rounds=60), 0.0205)


def cape_keys(fit: Fit) -> Floats:
    """Return the lines across a cape that shape it, from collar to hem, shape (6, 61, 3)."""
    nape, shoulder, knee = fit.joint("Neck"), fit.joint("LeftArm"), fit.joint("LeftLeg")
    s = shoulder[0] / 0.162
    return np.stack(
        [
            arc(150, 0.078 * s, nape + (0, 0.02 * s, -0.075 * s), nape + (0, -0.04 * s, 0.075 * s)),
            arc(
                115, 0.135 * s, (0, shoulder[1] + 0.055 * s, nape[2] - 0.115 * s), shoulder + (0, 0.045 * s, 0.07 * s)
            ),
            arc(95, 0.215 * s, shoulder + (0, -0.02 * s, -0.125 * s), shoulder + (0, 0.03 * s, 0.02 * s)),
            arc(85, 0.25 * s, shoulder + (0, -0.13 * s, -0.16 * s), shoulder + (0, -0.08 * s, -0.085 * s)),
            arc(
                80,
                0.33 * s,
                (0, knee[1] + 0.46 * s, shoulder[2] - 0.235 * s),
                (0, knee[1] + 0.48 * s, shoulder[2] - 0.115 * s),
            ),
            arc(
                75,
                0.47 * s,
                (0, knee[1] - 0.2 * s, shoulder[2] - 0.37 * s),
                (0, knee[1] - 0.185 * s, shoulder[2] - 0.16 * s),
            ),
        ]
    )


def arc(degrees: float, half_width: float, middle: Floats, end: Floats) -> Floats:
    """Return 61 points of a line round the back, right to left, turning by `degrees` to each side.

    Height and depth go from those of `middle` to those of `end`; the widest point lies at `half_width`.
    """
    angle = np.radians(np.linspace(-degrees, degrees, 61))
    turn = (1 - np.cos(angle)) / (1 - np.cos(angle[0]))
    line = np.asarray(middle) + turn[:, None] * (np.asarray(end) - np.asarray(middle))
    line[:, 0] = half_width * np.sin(angle) / np.sin(angle).max()
    return line


def through(keys: Floats, count: int) -> tuple[Floats, Floats]:
    """Return a smooth grid of `count` rows through key lines (K, C, 3), and each row's depth from the top [m]."""
    from scipy.interpolate import PchipInterpolator

    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(keys, axis=0), axis=-1).mean(axis=1))])
    depth = np.linspace(0, at[-1], count)
    return PchipInterpolator(at, keys)(depth), depth


CUTS = {"cape": cape}
GARMENTS = tuple(CUTS)
