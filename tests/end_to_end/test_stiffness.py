# SPDX-License-Identifier: Apache-2.0
"""Cloth that is stiffer in one place than in another: from a stage to the simulator, the model and the shot."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from ssilk_core.cli import main
from ssilk_core.errors import EXIT_OK, EXIT_WORSE
from ssilk_core.network.checkpoint import load_model

from .conftest import TRAINING, run
from .test_direction import points_of

NUMBERS = ("lame_mu=22.2", "lame_lambda=41.8", "bending=1e-5")  # of the default fabric


@pytest.fixture
def stage(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "sway.usda", frames=6)
    return tmp_path


def stiffen(path: str, values, prim: str = "/Hero/Skirt", *, indices=None, interpolation: str = "vertex") -> None:
    opened = Usd.Stage.Open(path)
    primvar = UsdGeom.PrimvarsAPI(opened.GetPrimAtPath(prim)).CreatePrimvar(
        "ssilk:stiffness", Sdf.ValueTypeNames.FloatArray, interpolation
    )
    primvar.Set(list(map(float, values)))
    if indices is not None:
        primvar.SetIndices(list(indices))
    opened.GetRootLayer().Save()


def count_of(path: str) -> int:
    opened = Usd.Stage.Open(path)
    return len(UsdGeom.Mesh(opened.GetPrimAtPath("/Hero/Skirt")).GetPointsAttr().Get())


def simulated(name: str, *more: str) -> np.ndarray:
    assert main(["simulate", "rigged.usda", "--motion", "sway.usda", "-o", name, "--points", *more]) == 0
    return points_of(name)


@pytest.mark.slow
def test_the_simulator_has_it_as_another_fabric_has_its_own(stage, capsys):
    plain = simulated("plain.usdc")
    wanted = simulated("fabric.usdc", *(part for each in NUMBERS for part in ("--material", _times(each, 16.0))))
    stiffen("rigged.usda", np.full(count_of("rigged.usda"), 16.0))
    capsys.readouterr()
    found = simulated("stiff.usdc")
    assert "another stiffness than the fabric's, which is multiplied by 16\n" in capsys.readouterr().err
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    assert np.abs(found - plain).max() > 2e-3


def _times(number: str, factor: float) -> str:
    name, value = number.split("=")
    return f"{name}={factor * float(value):.10g}"


def test_rig_model_and_shot_keep_it(stage, capsys):
    count = count_of("hero.usda")
    values = np.where(np.arange(count) % 2, 4.0, 1.0)
    stiffen("hero.usda", [1.0, 4.0], indices=(np.arange(count) % 2).tolist())
    assert run("rig hero.usda --garment Skirt --proxies 4 -o own.usda") == 0
    rigged = Usd.Stage.Open("own.usda")
    again = UsdGeom.PrimvarsAPI(rigged.GetPrimAtPath("/Hero/Skirt")).GetPrimvar("ssilk:stiffness")
    np.testing.assert_array_equal(again.ComputeFlattened(), values)
    capsys.readouterr()
    run("inspect own.usda --motion sway.usda")
    assert f"{count // 2} of {count} vertices have another stiffness" in capsys.readouterr().out
    assert run("train own.usda --motions clip.usda -o own.safetensors", *TRAINING) in (EXIT_OK, EXIT_WORSE)
    np.testing.assert_array_equal(load_model("own.safetensors").scene.garment.mesh.stiffness, values)
    assert run("bake own.safetensors --stage own.usda --motion sway.usda -o own.usdc") == 0
    shot = Usd.Stage.Open("own.usdc")
    (mesh,) = (prim for prim in shot.Traverse() if prim.GetName() == "Skirt")
    np.testing.assert_array_equal(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("ssilk:stiffness").Get(), values)


def test_what_was_painted_after_the_training_is_told(stage, capsys):
    bake = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "clip.usda", "-o"]
    assert main([*bake, "plain.usdc"]) == 0 and "stiffness" not in capsys.readouterr().err
    values = np.ones(count_of("rigged.usda"))
    values[:5] = 10
    stiffen("rigged.usda", values)
    assert main([*bake, "painted.usdc"]) == 0
    assert (
        "/Hero/Skirt: its stiffness is painted otherwise than when the garment was trained" in capsys.readouterr().err
    )
    np.testing.assert_array_equal(points_of("painted.usdc"), points_of("plain.usdc"))


def test_one_that_changes_in_time_is_told_and_counts_as_at_first(stage, capsys):
    count = count_of("hero.usda")
    stiffen("hero.usda", np.full(count, 4.0))
    opened = Usd.Stage.Open("hero.usda")
    attribute = UsdGeom.PrimvarsAPI(opened.GetPrimAtPath("/Hero/Skirt")).GetPrimvar("ssilk:stiffness").GetAttr()
    for time, value in ((3.0, 4.0), (9.0, 4.0)):
        attribute.Set([value] * count, time)
    opened.GetRootLayer().Save()
    assert run("rig hero.usda --garment Skirt --proxies 4 -o own.usda") == 0
    assert "changes from time code" not in capsys.readouterr().err
    attribute.Set([5.0] * count, 9.0)
    opened.GetRootLayer().Save()
    assert run("rig hero.usda --garment Skirt --proxies 4 -o own.usda") == 0
    told = capsys.readouterr().err
    assert "ssilk:stiffness changes from time code 3 to 9; cloth has its value at the first of these" in told
    rigged = Usd.Stage.Open("own.usda")
    found = UsdGeom.PrimvarsAPI(rigged.GetPrimAtPath("/Hero/Skirt")).GetPrimvar("ssilk:stiffness")
    np.testing.assert_array_equal(found.Get(), np.full(count, 4.0))


def test_a_model_without_it_has_the_file_that_it_had(stage):
    assert load_model("model.safetensors").scene.garment.mesh.stiffness is None
    assert b"scene.mesh.stiffness" not in (stage / "model.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("values", "interpolation", "complaint"),
    [
        ([200.0], "vertex", "values of stiffness for"),
        (None, "vertex", "a stiffness of 200 at"),
        ([2.0], "constant", "primvars:ssilk:stiffness has constant interpolation"),
    ],
)
def test_what_is_no_stiffness_is_refused_in_one_sentence(stage, capsys, values, interpolation, complaint):
    count = count_of("rigged.usda")
    stiffen("rigged.usda", np.full(count, 200.0) if values is None else values, interpolation=interpolation)
    before = sorted(stage.iterdir())
    assert main(["simulate", "rigged.usda", "--motion", "sway.usda", "-o", "no.usdc"]) == 2
    assert complaint in capsys.readouterr().err
    assert sorted(stage.iterdir()) == before
