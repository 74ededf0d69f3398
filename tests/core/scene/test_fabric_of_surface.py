# SPDX-License-Identifier: Apache-2.0
"""The fabric of a stage's physics material against the closed forms of a thin plate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import Mesh, SurfaceMaterial
from ssilk_core.scene.fabrics import FABRICS, FRICTION, fabric_of_surface, surface_message

YOUNG, POISSON, THICKNESS, WIDTH, LENGTH = 4e5, 0.25, 8e-4, 0.2, 0.5
PLATE = SurfaceMaterial(
    path="set.usda:/Looks/Linen",
    youngs_modulus=YOUNG,
    poissons_ratio=POISSON,
    thickness=THICKNESS,
    density=250.0,
)
DRAWN = 1e-3  # strain, small enough for the linear plate: its square is the relative error


def energy(fabric, points, faces) -> GarmentEnergy:
    return GarmentEnergy(Mesh("/strip", points, faces), fabric, dtype=torch.float64)


def tensor(points: np.ndarray) -> torch.Tensor:
    return torch.tensor(points[..., None])


@pytest.mark.parametrize("changes", [{}, {"stretch_model": "baraff_witkin"}])
def test_strain_and_shear_store_what_a_plate_stores(toy_grid, changes):
    points, faces = toy_grid(9, 4, LENGTH, WIDTH)
    strip = energy(replace(fabric_of_surface(PLATE), **changes), points, faces)
    area, plate = LENGTH * WIDTH, YOUNG * THICKNESS
    (along, across, _), centred = np.ptp(points, axis=0).argsort()[::-1], points - points.mean(axis=0)
    strained, sheared = points.copy(), points.copy()
    strained[:, along] += DRAWN * centred[:, along]
    sheared[:, along] += DRAWN * centred[:, across]
    # Held at its width, a plate stores E h / (1 - nu^2) e^2 / 2 for each area; sheared, G h gamma^2 / 2.
    held, simple = plate / (1 - POISSON**2) * DRAWN**2 / 2, plate / (2 * (1 + POISSON)) * DRAWN**2 / 2
    assert float(strip.stretch(tensor(strained))) == pytest.approx(area * held, rel=3 * DRAWN)
    assert float(strip.stretch(tensor(sheared))) == pytest.approx(area * simple, rel=3 * DRAWN)


def test_a_rolled_strip_stores_what_a_plate_stores(toy_grid):
    facets, width = 200, 0.005
    points, faces = toy_grid(facets + 1, 2, LENGTH, width)
    curvature = 2 * np.pi / LENGTH
    angle = np.repeat(np.arange(facets + 1), 2) * 2 * np.pi / facets
    rolled = np.stack([points[:, 0], np.cos(angle) / curvature, np.sin(angle) / curvature], axis=1)
    strip = energy(fabric_of_surface(PLATE), points, faces)
    rigidity = YOUNG * THICKNESS**3 / (12 * (1 - POISSON**2))
    # A row of facets at either end bends at one side only.
    expected = rigidity * curvature**2 / 2 * LENGTH * width * (facets - 1) / facets
    assert float(strip.bending(tensor(rolled))) == pytest.approx(expected, rel=1e-3)


def test_mass_and_thickness():
    fabric = fabric_of_surface(PLATE)
    assert fabric.name == "Linen" and fabric.thickness == THICKNESS
    assert fabric.density == pytest.approx(250 * THICKNESS)
    weighed = fabric_of_surface(SurfaceMaterial(path="set.usda:/A", density=250.0, area_density=0.3))
    assert weighed.density == 0.3


def test_stated_stiffnesses_go_before_young_and_what_is_not_said_is_the_default():
    stated = SurfaceMaterial(path="set.usda:/A", youngs_modulus=YOUNG, stretch=50.0, shear=20.0, bend=1e-5)
    fabric = fabric_of_surface(stated)
    assert (fabric.lame_mu, fabric.lame_lambda, fabric.bending) == pytest.approx((20.0, 10.0, 4e-5))
    alone = fabric_of_surface(SurfaceMaterial(path="set.usda:/A", stretch=50.0, poissons_ratio=0.2))
    assert (alone.lame_mu, alone.lame_lambda) == pytest.approx((20.0, 10.0))
    default, bare = FABRICS["default"], fabric_of_surface(SurfaceMaterial(path="set.usda:/default"))
    assert bare == default
    assert alone.bending == default.bending and alone.density == default.density


def test_the_sentence_names_what_is_taken_and_what_is_lost():
    told = surface_message(PLATE, fabric_of_surface(PLATE))
    assert "density 0.2 kg/m2" in told and "lame_mu 128 N/m" in told and "leaves out" not in told
    assert "1.07 times the lame_mu of the stiffest preset" in told
    odd = SurfaceMaterial(path="set.usda:/A", stretch=50.0, shear=40.0, others=("physics:dynamicFriction",))
    fabric = fabric_of_surface(odd)
    assert (fabric.lame_mu, fabric.lame_lambda) == (25.0, 0.0)
    told = surface_message(odd, fabric)
    assert told.endswith(
        f"leaves out physics:dynamicFriction, shear that is stiffer than half the stretch; {FRICTION}"
    )


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"youngs_modulus": 0.0}, "youngsModulus"),
        ({"youngs_modulus": 0.0, "stretch": 50.0}, "youngsModulus"),
        ({"stretch": 0.0}, "surfaceStretchStiffness"),
        ({"youngs_modulus": YOUNG, "stretch": 0.0}, "surfaceStretchStiffness"),
        ({"stretch": 50.0, "shear": 0.0}, "surfaceShearStiffness"),
    ],
)
def test_cloth_without_stiffness_in_its_plane_is_refused(wrong, name):
    with pytest.raises(SsilkError, match=f"^set.usda:/A: {name} is 0, so that lame_mu is 0; it must be positive; "):
        fabric_of_surface(SurfaceMaterial(path="set.usda:/A", **wrong))
    assert fabric_of_surface(SurfaceMaterial(path="set.usda:/A", bend=0.0)).bending == 0


@pytest.mark.parametrize("wrong", [{"poissons_ratio": 0.6}, {"thickness": 0.0}, {"bend": -1.0}])
def test_what_no_plate_has_is_refused(wrong):
    with pytest.raises(SsilkError, match=next(iter(wrong))):
        SurfaceMaterial(path="set.usda:/A", **wrong)
