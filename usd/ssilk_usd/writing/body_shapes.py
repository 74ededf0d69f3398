# SPDX-License-Identifier: Apache-2.0
"""Write how a shot shapes a character's bodies, over its stage and into its motion."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.files import replacing
from ssilk_core.scene.assets import Floats

from ..opening.stage import open_stage
from ..reading.skeleton import find_skeleton
from ..units import StageUnits
from .author import define_blendshapes, free_name
from .export import new_stage, save


def write_body_shapes(
    path: str | Path, stage: str | Path, motion: str | Path, bodies: Mapping[str, Mapping[str, tuple[Floats, Floats]]]
) -> None:
    """Write a stage over a character's, which stays as it is, with blendshapes that a motion weighs from then on.

    Args:
        path: the file to write.
        stage: the character's file; its bind pose is its world, as `write_scene` writes it.
        motion: of `write_motion`; it is written anew, and weighs nothing yet.
        bodies: by the path of a body's mesh, its shapes by name: offsets [m], shape (V, 3), and weights (F,).

    Raises:
        SsilkError: a file cannot be read or written.
    """
    below = open_stage(stage)
    units, root, courses = StageUnits.of(below), find_skeleton(below).root, dict[str, Floats]()
    with replacing(path) as temporary:
        over = new_stage(temporary, units)
        over.GetRootLayer().subLayerPaths.append(os.path.relpath(stage, Path(path).parent))
        over.GetRootLayer().defaultPrim = root.GetPath().name
        for body, shapes in bodies.items():
            names = []
            for name, (_, weights) in shapes.items():
                names.append(free_name(name, courses))
                courses[names[-1]] = weights
            mesh = UsdGeom.Mesh(over.OverridePrim(body))
            define_blendshapes(mesh, names, np.array([offsets for offsets, _ in shapes.values()]), units)
        save(over.GetRootLayer(), path)
        del over
    _weigh(motion, courses)


def _weigh(motion: str | Path, courses: Mapping[str, Floats]) -> None:
    """Let the animation of a motion weigh blendshapes by name, (F,) each."""
    with replacing(motion) as temporary:
        layer = Sdf.Layer.CreateNew(str(temporary))
        layer.TransferContent(Sdf.Layer.FindOrOpen(str(motion)))
        stage = Usd.Stage.Open(layer, None)
        animation = UsdSkel.Animation(stage.GetDefaultPrim())
        animation.CreateBlendShapesAttr(Vt.TokenArray(list(courses)))
        weights, start = animation.CreateBlendShapeWeightsAttr().GetPath(), stage.GetStartTimeCode()
        del animation, stage
        for frame, row in enumerate(np.array(list(courses.values()), dtype=np.float32).T):
            values = Vt.FloatArray.FromNumpy(np.ascontiguousarray(row))
            layer.SetTimeSample(weights, start + frame, values)
        save(layer, motion)
        del layer
