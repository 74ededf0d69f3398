# SPDX-License-Identifier: Apache-2.0
"""How the presets of fabrics hang: bending length and Cusick's drape coefficient, as textiles are measured.

    python benchmarks/drape.py --spacings 0.01 0.005 --name drape --picture docs/images/drape.jpg

The bending length is measured on a strip of 25 mm whose end hangs over an edge until its tip lies 41.5 degrees below
it, c = l (cos(a / 2) / (8 tan a))^(1/3) with the overhang l and that angle a, about half of l [Peirce 1930].
The drape coefficient is the shadow of a disc of 300 mm diameter that lies on one of 180 mm, less the inner disc, as a
share of the ring [Cusick 1965]. The reference simulator's energy is minimised for both, without contact of cloth with
cloth: the cloth on the table is held, and hangs free beyond. A disc may hang in more or fewer waves. It is let go
with several numbers of them on the coarsest mesh, and the one with the least energy is measured on all. The picture
shows the presets on the finest mesh, from the side and from above.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from helpers.reports import save_results
from scipy.spatial import Delaunay

from ssilk_core.delivery.view.camera import Camera
from ssilk_core.delivery.view.colours import fabric_colour
from ssilk_core.delivery.view.panels import add_captions, contact_sheet
from ssilk_core.delivery.view.render import render
from ssilk_core.delivery.view.surface import Surface
from ssilk_core.events import Progress, TextReporter
from ssilk_core.files import replacing
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    Body,
    Character,
    Floats,
    Garment,
    Ints,
    Mesh,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.fabrics import FABRICS, Fabric

OUTER, INNER = 0.15, 0.09  # radii [m]
WIDTH, ANGLE = 0.025, np.radians(41.5)  # of the strip [m], and how far its tip hangs below the edge
STEP = 0.1  # [s] of implicit Euler, whose inertia damps
STILL = 2e-5  # [m] by which no vertex moves in a step any more
PANEL, FLOOR = 300, -0.11  # pixels, and height [m], of the picture
WAVES, HEIGHT = (5, 6, 7, 8, 9), 2e-3  # of the disc that is let go, and their height [m]


@dataclass(frozen=True, eq=False)
class LevelCloth:
    """Level cloth, of triangles as regular as rows allow.

    The hinges at the end of what is held bend half a row on either side of them. So that no more bends than hangs
    over, cloth is held half a row beyond the edge.

    Attributes:
        points: vertices [m], shape (V, 3).
        faces: seen from above, +y, shape (F, 3).
        held: which vertices lie on the table, shape (V,).
    """

    points: Floats
    faces: Ints
    held: np.ndarray

    @classmethod
    def of(cls, flat: Floats, held: np.ndarray) -> LevelCloth:
        """Return the triangulation of points in the plane [m] (V, 2)."""
        faces = Delaunay(flat).simplices
        a, b, c = (flat[faces[:, corner]] for corner in range(3))
        area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        faces = np.where(area[:, None] > 0, faces[:, ::-1], faces)[np.abs(area) > 1e-12]
        return cls(np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1), faces, held)


def disc(spacing: float) -> LevelCloth:
    """Return Cusick's disc."""
    rows = round((OUTER - INNER) / spacing - 0.5)
    edge = INNER + 0.5 * (OUTER - INNER) / (rows + 0.5)
    radii = [*np.linspace(0, edge, round(edge / spacing) + 1)[1:], *np.linspace(edge, OUTER, rows + 1)[1:]]
    rings = [np.zeros((1, 2))]
    for number, radius in enumerate(radii):
        count = max(6, round(2 * np.pi * radius / spacing))
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (number % 2)) / count
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    flat = np.concatenate(rings)
    return LevelCloth.of(flat, np.hypot(*flat.T) < edge + 1e-6)


def strip(overhang: float, spacing: float) -> LevelCloth:
    """Return Peirce's strip, along x from the edge of a table at 0."""
    rows = max(2, round(overhang / (spacing * 0.75**0.5) - 0.5))
    height = overhang / (rows + 0.5)
    even = np.linspace(0, WIDTH, max(2, round(WIDTH / spacing)) + 1)
    odd = np.array([0, *(even[1:] + even[:-1]) / 2, WIDTH])
    lines = [(height * (row + 0.5), odd if row % 2 else even) for row in range(-2, rows + 1)]
    flat = np.concatenate([np.stack([np.full(len(along), x), along], axis=1) for x, along in lines])
    return LevelCloth.of(flat, flat[:, 0] < 0.5 * height + 1e-6)


def dressed(cloth: LevelCloth) -> Scene:
    """Return a scene of this cloth, held by one joint, far above a body, since a character has one."""
    count = len(cloth.points)
    skin = SkinWeights("/cloth", np.zeros((count, 1), dtype=int), np.ones((count, 1)))
    skeleton = Skeleton("/rig", ("Root",), np.array([-1]), np.eye(4)[None], np.eye(4)[None])
    garment = Garment(Mesh("/cloth", cloth.points, cloth.faces), skin, np.where(cloth.held, PINNED, LOOSE))
    rig = ProxyRig("/cloth", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) - [0.0, 9.0, 0.0]
    solid = Mesh("/body", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    body = Body(solid, SkinWeights("/body", np.zeros((4, 1), dtype=int), np.ones((4, 1))))
    return Scene(Character("/rig", skeleton, (body,)), garment, rig)


@dataclass(frozen=True, eq=False)
class Rest:
    """Cloth at rest: its vertices [m] (V, 3), its energy [J], and by how much it still moved in a step [m]."""

    points: Floats
    energy: float
    moved: float


def at_rest(cloth: LevelCloth, fabric: Fabric, start: Floats, most: int) -> Rest:
    """Return where cloth comes to rest from vertices `start` [m] (V, 3), in so many steps at most."""
    potential = IncrementalPotential(dressed(cloth), fabric, device=torch.device("cpu"))
    down = torch.tensor([[0.0], [-GRAVITY], [0.0]], dtype=torch.float64)
    x = last = torch.as_tensor(start)[:, :, None]
    moved = np.inf
    for _ in range(most):
        inputs = StepInputs(None, down, 2 * x - last, x, STEP)
        last, x = x, minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-5, iterations=60)).x
        moved = float((x - last).norm(dim=1).max())
        if moved < STILL:
            break
    energy = float(potential.energy(x, StepInputs(None, down), None).sum())
    return Rest(x[:, :, 0].numpy(), energy, moved)


def draped(fabric: Fabric, spacing: float, waves: int, most: int) -> Rest:
    """Return a disc at rest that is let go with so many waves."""
    cloth = disc(spacing)
    angle, radius = np.arctan2(cloth.points[:, 2], cloth.points[:, 0]), np.hypot(*cloth.points[:, [0, 2]].T)
    start = cloth.points.copy()
    start[:, 1] = HEIGHT * np.sin(waves * angle) * np.clip((radius - INNER) / (OUTER - INNER), 0, 1)
    start[cloth.held, 1] = 0
    return at_rest(cloth, fabric, start, most)


def bending_length(fabric: Fabric, spacing: float, most: int) -> float:
    """Return the bending length of a strip [m] whose tip hangs within half a degree of the angle for it."""
    length = of_rigidity(fabric)
    for _ in range(6):
        overhang = length / overhang_share(ANGLE)
        cloth = strip(overhang, spacing)
        x, y, _ = at_rest(cloth, fabric, cloth.points, most).points[cloth.points[:, 0] > overhang - 1e-6].mean(0)
        angle = float(np.arctan2(-y, x))
        length = overhang * overhang_share(angle)
        if abs(angle - ANGLE) < np.radians(0.5):
            return length
    raise RuntimeError(f"the strip of {fabric.name} came to no overhang with {np.degrees(ANGLE)} degrees")


def overhang_share(angle: float) -> float:
    """Return the bending length as a share of the overhang whose tip hangs at an angle [Peirce 1930]."""
    return float((np.cos(angle / 2) / (8 * np.tan(angle))) ** (1 / 3))


def of_rigidity(fabric: Fabric) -> float:
    """Return (D / w)^(1/3), the bending length of a rigidity and weight [m]; `Fabric.bending` is four times D."""
    return (fabric.bending / 4 / (fabric.density * GRAVITY)) ** (1 / 3)


def drape_coefficient(points: Floats, faces: Ints, cells: int = 1200) -> float:
    """Return the shadow of draped cloth from above, less the inner disc, as a share of the ring."""
    from matplotlib.path import Path as Outline

    grid = (np.arange(cells) + 0.5) / cells * 2 * OUTER - OUTER
    across, along = np.meshgrid(grid, grid, indexing="ij")
    centres = np.stack([across.reshape(-1), along.reshape(-1)], axis=1)
    shaded = np.hypot(*centres.T) <= INNER
    for face in points[faces][:, :, [0, 2]]:
        low, high = (np.searchsorted(grid, ends) for ends in (face.min(axis=0), face.max(axis=0)))
        rows = (np.arange(low[0], high[0])[:, None] * cells + np.arange(low[1], high[1])).reshape(-1)
        if len(rows):
            shaded[rows[Outline(face).contains_points(centres[rows])]] = True
    area = shaded.sum() * (2 * OUTER / cells) ** 2
    return float((area - np.pi * INNER**2) / (np.pi * (OUTER**2 - INNER**2)))


def measured(fabric: Fabric, spacings: Sequence[float], most: int) -> tuple[dict[str, object], Rest]:
    """Return the figures of a fabric on each mesh, the coarsest first, and its disc at rest on the finest."""
    starts = {waves: draped(fabric, spacings[0], waves, most) for waves in WAVES}
    waves = min(starts, key=lambda number: starts[number].energy)
    found: dict[str, object] = {
        "density [g/m2]": 1000 * fabric.density,
        "bending [N m]": fabric.bending,
        "rigidity's bending length [mm]": round(1000 * of_rigidity(fabric), 1),
        "let go with waves": waves,
        "drape coefficients with other waves [%]": {
            number: round(100 * drape_coefficient(rest.points, disc(spacings[0]).faces), 1)
            for number, rest in starts.items()
        },
    }
    for spacing in spacings:
        rest = starts[waves] if spacing == spacings[0] else draped(fabric, spacing, waves, most)
        found[f"{1000 * spacing:g} mm"] = {
            "bending length [mm]": round(1000 * bending_length(fabric, spacing, most), 1),
            "drape coefficient [%]": round(100 * drape_coefficient(rest.points, disc(spacing).faces), 1),
            "last step [mm]": float(f"{1000 * rest.moved:.2g}"),
        }
    return found, rest


def draw(path: Path, discs: Mapping[str, tuple[Floats, Ints]]) -> None:
    """Write a picture of discs at rest, named by their captions: from the side, and below from above."""
    from PIL import Image as Pictures

    cameras = [
        Camera(np.array([0.0, 0.34, 0.62]), np.array([0.0, -0.045, 0.0]), fov=27),
        Camera(np.array([0.0, 0.75, 1e-3]), np.array([0.0, -0.03, 0.0]), np.array([0.0, 0.0, -1.0]), fov=27),
    ]
    panels = []
    for camera in cameras:
        for caption, (points, faces) in discs.items():
            cloth = Surface("disc", points, faces, fabric_colour(1), two_sided=True)
            shown = render([cloth], camera, PANEL, PANEL, ground=FLOOR)
            panels.append(add_captions(shown, top=caption) if camera is cameras[0] else shown)
    with replacing(path) as temporary:
        Pictures.fromarray(contact_sheet(panels, columns=len(discs))).save(temporary, "JPEG", quality=82)


def main() -> None:
    """Measure all presets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--fabrics", nargs="+", choices=FABRICS, default=[name for name in FABRICS if name != "paper"]
    )
    parser.add_argument(
        "--spacings", type=float, nargs="+", default=[0.01], help="of the vertices of meshes [m] (default 0.01)"
    )
    parser.add_argument("--steps", type=int, default=300, help="of 0.1 s, at most (default 300)")
    parser.add_argument("--picture", type=Path, metavar="FILE.jpg", help="of the discs (default: none)")
    parser.add_argument("--name", help="of the result file (default: none)")
    parser.set_defaults(device="cpu", threads=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    spacings = sorted(options.spacings, reverse=True)
    report, rows, discs = TextReporter(), dict[str, dict[str, object]](), dict[str, tuple[Floats, Ints]]()
    for number, name in enumerate(options.fabrics):
        report(Progress(number, len(options.fabrics)))
        rows[name], rest = measured(FABRICS[name], spacings, options.steps)
        if name != "default":
            faces = disc(spacings[-1]).faces
            discs[f"{name}, {100 * drape_coefficient(rest.points, faces):.0f} %"] = rest.points, faces
        print(name, rows[name], flush=True)
    if options.name:
        save_results(options, rows)
    if options.picture:
        draw(options.picture, discs)


if __name__ == "__main__":
    main()
