# SPDX-License-Identifier: Apache-2.0
"""The body that ships: small, watertight, on the mocap rig, valid USD."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import igl
import numpy as np
import pytest
from pxr import Usd, UsdSkel, UsdValidation
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path

from ssilk_core.scene.mesh.topology import edge_use

SHARED = Path(__file__).parents[4] / "shared" / "data" / "character.usdc"


def test_body_is_small_watertight_and_stands_on_the_ground() -> None:
    mesh = read_character(demo_body_path()).merged_body().mesh
    assert demo_body_path().stat().st_size < 400_000
    assert 1000 < mesh.vertex_count < 3000
    assert np.all(edge_use(mesh.faces)[1] == 2)
    assert mesh.points[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    volume = igl.centroid(np.array(mesh.points), np.array(mesh.faces))[1]
    assert 0.04 < volume < 0.1, "an adult has some 50 to 80 litres, positive where faces look outward"


def test_stage_is_valid_and_bound_as_usdskel_asks() -> None:
    stage = Usd.Stage.Open(str(demo_body_path()))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)] == []
    root = stage.GetDefaultPrim()
    assert root.IsA(UsdSkel.Root)
    assert root.HasAuthoredMetadata("kind")
    assert all(prim.HasAPI(UsdSkel.BindingAPI) for prim in (root, *root.GetChildren()))


@pytest.mark.skipif(not SHARED.exists(), reason="the shared character is not here")
def test_rig_is_that_of_the_mocap_clips() -> None:
    ours, theirs = read_character(demo_body_path()).skeleton, read_character(SHARED).skeleton
    assert ours.joint_names == theirs.joint_names
    assert np.abs(ours.rest_transforms - theirs.rest_transforms).max() < 1e-4
    assert np.abs(ours.bind_transforms - theirs.bind_transforms).max() < 1e-4


def test_finding_the_body_loads_no_usd() -> None:
    code = "import sys, ssilk_usd.stages as s; s.demo_body_path(); assert 'pxr' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
