# SPDX-License-Identifier: Apache-2.0
"""A small wardrobe built in code, fitted to a body in its bind pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..errors import fail_unknown
from ..scene.assets import Character, Floats, Garment, Ints, Mesh
from .garments_dress import hooded_dress
from .garments_fit import BodyFit, fit, outline, relax, through
from .garments_mesh import loft

CLEARANCE = 0.012  # [m]; more than the 6 mm that must remain, because triangles cut corners


def build_garment(name: str, character: Character) -> Garment:
    """Return one of `GARMENTS` or `OVER` fitted to an upright character in an A-pose, without weights or classes.

    Raises:
        SsilkError: there is no garment of that name.
    """
    if name in OVER:
        return settled(name, character)
    if name not in CUTS:
        fail_unknown(f"garment '{name}'", "no such garment in the wardrobe", name, [*GARMENTS, *OVER])
    points, faces = CUTS[name](fit(character))
    return Garment(Mesh(_path(name), points, faces))


def settled(name: str, character: Character) -> Garment:
    """Return a garment of `OVER` as 'ssilk inspect --over' settles it off the one beneath."""
    from ..authoring.preflight.settle import settle

    outer, inner = (build_garment(each, character).mesh for each in OVER[name])
    offsets = settle(outer, character.merged_body().mesh, inner=[inner]).offsets
    return Garment(Mesh(_path(name), outer.points + offsets, outer.faces))


def _path(name: str) -> str:
    return f"/{''.join(word.title() for word in name.split('_'))}"


def cape(fit: BodyFit) -> tuple[Floats, Ints]:
    """Cut a cape: collar and yoke on the shoulders, open at the front, flared to the calves."""
    s = fit.size
    grid, depth = through(cape_keys(fit, s), 81)
    cling = np.interp(depth, [0, 0.055 * s, 0.12 * s], [0.5, 0.4, 0.0])[:, None]
    return loft(relax(fit, grid, CLEARANCE, cling=cling, rounds=60), 0.0205 * s)


def cape_keys(fit: BodyFit, s: float) -> Floats:
    """Return the lines across a cape that shape it, from collar to hem, shape (6, 61, 3)."""
    nape, shoulder, knee = fit.joint("Neck"), fit.joint("LeftArm"), fit.joint("LeftLeg")
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


def arc(degrees: float, half_width: float, middle: ArrayLike, end: ArrayLike) -> Floats:
    """Return 61 points of a line round the back, right to left, turning by `degrees` to each side.

    Height and depth go from those of `middle` to those of `end`; the widest point lies at `half_width`.
    """
    angle = np.radians(np.linspace(-degrees, degrees, 61))
    turn = (1 - np.cos(angle)) / (1 - np.cos(angle[0]))
    line = np.asarray(middle) + turn[:, None] * (np.asarray(end) - np.asarray(middle))
    line[:, 0] = half_width * np.sin(angle) / np.sin(angle).max()
    return line


def fringe_skirt(fit: BodyFit) -> tuple[Floats, Ints]:
    """Cut a skirt: a waistband on the hips, and 32 strips that hang from it to the knees, free of each other."""
    strips, band = 32, 8
    grid = skirt_surface(fit, strips * 3 + 1, band)[:, :-1]
    rows, columns = grid.shape[:2]
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    kept = (row < band) | (column % 3 < 2)
    row, column = row[kept], column[kept]
    after = (column + 1) % columns
    above, below = row * columns, (row + 1) * columns
    corners = [above + column, above + after, below + after, below + column]
    return grid.reshape(-1, 3), halve(np.stack(corners, axis=1), (row + column) % 2 == 0)


def halve(quads: Ints, forward: Ints) -> Ints:
    """Return two triangles for each quad (N, 4), cut along its first diagonal where `forward`."""
    a, b, c, d = quads.T
    first = np.where(forward, np.stack([a, b, c]), np.stack([a, b, d])).T
    second = np.where(forward, np.stack([a, c, d]), np.stack([b, c, d])).T
    return np.concatenate([first, second])


def skirt_surface(fit: BodyFit, columns: int, band: int) -> Floats:
    """Return a closed grid from the waist to the knees whose first `band` rows cling to the hips."""
    s, hips, knee = fit.size, fit.joint("Hips"), fit.joint("LeftLeg")
    top, hem, edge = hips[1] + 0.125 * s, knee[1] - 0.01 * s, 0.0125 * s
    heights = np.arange(top, hem, -edge)
    rows = [outline(fit, height, CLEARANCE, half_width=0.27 * s, count=columns) for height in heights]
    grid = np.stack(rows)
    centre = grid[:, :-1].mean(axis=1, keepdims=True)
    spoke = grid[band:] - centre[band:]
    reach = np.linalg.norm(spoke[..., [0, 2]], axis=-1, keepdims=True)
    wide = np.maximum.accumulate(reach, axis=0) + 0.16 * (heights[band] - heights[band:])[:, None, None]
    grid[band:] = centre[band:] + spoke * [1, 0, 1] * wide / reach
    cling = np.where(np.arange(len(grid)) < band, 0.5, 0.0)[:, None]
    return relax(fit, grid, CLEARANCE, cling=cling, rounds=25, closed=True)


CUTS = {"cape": cape, "fringe_skirt": fringe_skirt, "hooded_dress": hooded_dress}
GARMENTS = tuple(CUTS)
OVER = {"cape_over_dress": ("cape", "hooded_dress")}  # garments that are worn over another one
