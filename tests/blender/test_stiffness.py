# SPDX-License-Identifier: Apache-2.0
"""A vertex group in which the cloth is stiffer: as the training's stage gets it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.errors import SetupError
from blender_addon.scene.gather import gather


def test_weights_of_a_group_are_a_stiffness(rigged):
    group = rigged.vertex_groups.new(name="Collar")
    group.add([0, 1], 1.0, "REPLACE")
    group.add([2], 0.5, "REPLACE")
    assert gather(rigged).garment.mesh.stiffness is None
    rigged.ssilk.stiff, rigged.ssilk.stiffness = "Collar", 9.0
    found = gather(rigged).garment.mesh.stiffness
    np.testing.assert_allclose(found[:3], [9, 9, 3], rtol=1e-6)
    assert (found[3:] == 1).all()
    rigged.ssilk.stiffness = 1.0
    assert gather(rigged).garment.mesh.stiffness is None


def test_it_is_in_the_stage_of_a_training(rigged, tmp_path):
    from pxr import Usd, UsdGeom

    from blender_addon.scene.garment import armature_of
    from blender_addon.scene.handover import hand_over
    from blender_addon.scene.objects import Pair

    rigged.vertex_groups.new(name="Hem").add([5], 1.0, "REPLACE")
    rigged.ssilk.stiff, rigged.ssilk.stiffness = "Hem", 0.1
    hand_over(gather(rigged), Pair.of(rigged, armature_of(rigged)), tmp_path)
    (written,) = tmp_path.glob("*.usd*")
    stage = Usd.Stage.Open(str(written))
    (mesh,) = (prim for prim in stage.Traverse() if prim.GetName() == "Skirt")
    values = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("ssilk:stiffness").Get())
    assert values[5] == np.float32(0.1) and (np.delete(values, 5) == 1).all()


def test_a_group_that_is_gone_is_told(rigged):
    rigged.ssilk.stiff = "Gone"
    with pytest.raises(SetupError, match="'Skirt' has no vertex group 'Gone' to be stiffer in"):
        gather(rigged)
