# SPDX-License-Identifier: Apache-2.0
"""How the presets of fabrics hang: bending length and Cusick's drape coefficient, as textiles are measured.

    python benchmarks/drape.py --spacing 0.0075 --name drape --picture docs/images/drape.jpg

The bending length is that of a strip which overhangs under its own weight, c = (D / w)^(1/3) with the rigidity D and
the weight w of each area [Peirce 1930]. The drape coefficient is the shadow of a disc of 300 mm diameter that lies on
one of 180 mm, less the inner disc, as a share of the ring [Cusick 1965]. The reference simulator's energy is
minimised for it from a disc that is waved a little, without contact of cloth with cloth: the cloth on the inner disc
is held, and hangs free beyond. Presets for which the add-on of another simulator states a coefficient are measured
with a `bending` that comes to it as well. The picture shows the presets from the side and from above.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
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
STEP = 0.1  # [s] of implicit Euler, whose inertia damps
STILL = 2e-5  # [m] by which no vertex moves in a step any more
STIFFER = {"silk": 9.5e-6, "cotton": 8e-5, "denim": 4.8e-4}  # bending [N m], see above
PANEL, FLOOR = 300, -0.11  # pixels, and height [m], of the picture
WAVES, HEIGHT = 7, 2e-3  # of the disc that is let go [m]


def disc(spacing: float) -> tuple[Floats, Ints]:
    """Return a level disc of triangles as regular as rings allow: vertices [m] (V, 3) and faces (F, 3).

    Rings lie on both radii.
    """
    inner, outer = round(INNER / spacing), round((OUTER - INNER) / spacing)
    radii = [*np.linspace(0, INNER, inner + 1)[1:], *np.linspace(INNER, OUTER, outer + 1)[1:]]
    rings = [np.zeros((1, 2))]
    for number, radius in enumerate(radii):
        count = max(6, round(2 * np.pi * radius / spacing))
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (number % 2)) / count
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    flat = np.concatenate(rings)
    faces = Delaunay(flat).simplices
    a, b, c = (flat[faces[:, corner]] for corner in range(3))
    turned = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] > 0
    faces = np.where(turned[:, None], faces[:, ::-1], faces)  # seen from above, +y
    return np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1), faces


def dressed(points: Floats, faces: Ints, pinned: np.ndarray) -> Scene:
    """Return a scene of this cloth, held by one joint, far above a body, since a character has one."""
    skin = SkinWeights("/cloth", np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    skeleton = Skeleton("/rig", ("Root",), np.array([-1]), np.eye(4)[None], np.eye(4)[None])
    garment = Garment(Mesh("/cloth", points, faces), skin, np.where(pinned, PINNED, LOOSE))
    rig = ProxyRig("/cloth", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) - [0.0, 9.0, 0.0]
    solid = Mesh("/body", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    body = Body(solid, SkinWeights("/body", np.zeros((4, 1), dtype=int), np.ones((4, 1))))
    return Scene(Character("/rig", skeleton, (body,)), garment, rig)


def draped(fabric: Fabric, spacing: float, most: int) -> tuple[Floats, Ints, float]:
    """Return the vertices of a disc at rest [m] (V, 3), its faces, and by how much it still moved in a step [m]."""
    points, faces = disc(spacing)
    radius = np.linalg.norm(points, axis=1)
    potential = IncrementalPotential(
        dressed(points, faces, radius < INNER + 1e-6), fabric, device=torch.device("cpu")
    )
    angle = np.arctan2(points[:, 2], points[:, 0])
    waved = points.copy()
    waved[:, 1] = HEIGHT * np.sin(WAVES * angle) * np.clip((radius - INNER) / (OUTER - INNER), 0, 1)
    down = torch.tensor([[0.0], [-GRAVITY], [0.0]], dtype=torch.float64)
    x = last = torch.as_tensor(waved)[:, :, None]
    moved = np.inf
    for _ in range(most):
        inputs = StepInputs(None, down, 2 * x - last, x, STEP)
        last, x = x, minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-5, iterations=60)).x
        moved = float((x - last).norm(dim=1).max())
        if moved < STILL:
            break
    return x[:, :, 0].numpy(), faces, moved


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


def bending_length(fabric: Fabric) -> float:
    """Return the length of a strip's own weight that its rigidity bears [m]; `Fabric.bending` is four times D."""
    return (fabric.bending / 4 / (fabric.density * GRAVITY)) ** (1 / 3)


def measured(fabric: Fabric, spacing: float, steps: int) -> tuple[dict[str, float], Floats, Ints]:
    """Return the figures of a fabric, and its disc at rest as `draped` does."""
    points, faces, moved = draped(fabric, spacing, steps)
    return {
        "bending length [mm]": round(1000 * bending_length(fabric), 1),
        "drape coefficient [%]": round(100 * drape_coefficient(points, faces), 1),
        "last step [mm]": float(f"{1000 * moved:.2g}"),
    }, points, faces  # fmt: skip


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
    parser.add_argument("--spacing", type=float, default=0.01, help="of the disc's vertices [m] (default 0.01)")
    parser.add_argument("--steps", type=int, default=150, help="of 0.1 s, at most (default 150)")
    parser.add_argument("--picture", type=Path, metavar="FILE.jpg", help="of the discs (default: none)")
    parser.add_argument("--name", help="of the result file (default: none)")
    parser.set_defaults(device="cpu", threads=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    report, rows, discs = TextReporter(), dict[str, dict[str, float]](), dict[str, tuple[Floats, Ints]]()
    for number, name in enumerate(options.fabrics):
        report(Progress(number, len(options.fabrics)))
        fabric = FABRICS[name]
        found, points, faces = measured(fabric, options.spacing, options.steps)
        rows[name] = {"density [g/m2]": 1000 * fabric.density, "bending [N m]": fabric.bending, **found}
        if name != "default":
            discs[f"{name}, {found['drape coefficient [%]']:.0f} %"] = points, faces
        if name in STIFFER:
            found, *_ = measured(replace(fabric, bending=STIFFER[name]), options.spacing, options.steps)
            stiffer = {"bending [N m]": STIFFER[name], **found}
            rows[name] |= {f"stiffer: {key}": value for key, value in stiffer.items()}
        print(name, rows[name], flush=True)
    if options.name:
        save_results(options, rows)
    if options.picture:
        draw(options.picture, discs)


if __name__ == "__main__":
    main()
