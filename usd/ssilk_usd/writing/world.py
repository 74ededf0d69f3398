# SPDX-License-Identifier: Apache-2.0
"""Write gravity and wind as a PhysicsScene, and colliders as meshes, as `reading.world` reads them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from ssilk_core.scene.assets import Collider, Floats, ShotWorld

from ..names import GUST_LENGTH, GUST_SEED, GUSTS, WIND
from .author import prim_names

PATH, COLLIDERS = "/Physics", "/Colliders"


def define_world(stage: Usd.Stage, world: ShotWorld, start: float) -> None:
    """Define what a world holds on a stage in metres, y up, with a time code for each frame.

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
    for name, collider in zip(prim_names([each.path for each in world.colliders]), world.colliders):
        _define_collider(stage, f"{COLLIDERS}/{name}", collider, start)


def _define_collider(stage: Usd.Stage, path: str, collider: Collider, start: float) -> None:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(collider.faces)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(collider.faces.reshape(-1).astype(np.int32)))
    points, place = mesh.CreatePointsAttr(), mesh.AddTransformOp()
    enabled = UsdPhysics.CollisionAPI.Apply(mesh.GetPrim()).CreateCollisionEnabledAttr()
    for code, value in _timed(collider.points, start):
        points.Set(Vt.Vec3fArray.FromNumpy(value.astype(np.float32)), code)
    for code, value in _timed(collider.placements, start):
        place.Set(Gf.Matrix4d(value.T.tolist()), code)
    for code, value in _timed(collider.present, start):
        enabled.Set(bool(value), code)


def _set(attribute: Usd.Attribute, values: Floats, start: float) -> None:
    """Set values (F or 1, ...) as time samples, or as the default where one holds for all frames."""
    for code, value in _timed(values, start):
        attribute.Set(Gf.Vec3f(*map(float, value)) if np.ndim(value) else float(value), code)


def _timed(values: np.ndarray, start: float) -> Iterator[tuple[Usd.TimeCode, Any]]:
    """Yield values (F or 1, ...) with their time codes: the default where one holds for all frames."""
    for frame, value in enumerate(values):
        yield Usd.TimeCode.Default() if len(values) == 1 else Usd.TimeCode(start + frame), value
