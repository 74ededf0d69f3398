# SPDX-License-Identifier: Apache-2.0
"""Write gravity and wind as a PhysicsScene, as `reading.world` reads them."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdPhysics

from ssilk_core.scene.assets import Floats, ShotWorld

from ..names import GUST_LENGTH, GUST_SEED, GUSTS, WIND

PATH = "/Physics"


def define_world(stage: Usd.Stage, world: ShotWorld, start: float) -> None:
    """Define the gravity and the wind of a world on a stage in metres, y up, with a time code for each frame.

    Args:
        start: time code of the first frame.
    """
    scene = UsdPhysics.Scene.Define(stage, PATH)
    prim = scene.GetPrim()
    if world.gravity is not None:
        strength = np.linalg.norm(world.gravity, axis=1)
        toward = world.gravity / np.maximum(strength, np.finfo(float).tiny)[:, None]
        _set(scene.CreateGravityDirectionAttr(), toward, start)
        _set(scene.CreateGravityMagnitudeAttr(), strength, start)
    if world.air:
        _set(prim.CreateAttribute(WIND, Sdf.ValueTypeNames.Vector3f), world.air.velocity, start)
        _set(prim.CreateAttribute(GUSTS, Sdf.ValueTypeNames.Float), world.air.gusts, start)
        prim.CreateAttribute(GUST_LENGTH, Sdf.ValueTypeNames.Float).Set(world.air.length)
        prim.CreateAttribute(GUST_SEED, Sdf.ValueTypeNames.Int).Set(world.air.seed)


def _set(attribute: Usd.Attribute, values: Floats, start: float) -> None:
    """Set values (F or 1, ...) as time samples, or as the default where one holds for all frames."""
    for frame, value in enumerate(values):
        code = Usd.TimeCode.Default() if len(values) == 1 else Usd.TimeCode(start + frame)
        attribute.Set(Gf.Vec3f(*map(float, value)) if np.ndim(value) else float(value), code)
