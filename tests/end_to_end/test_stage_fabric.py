# SPDX-License-Identifier: Apache-2.0
"""The fabric of a garment's physics material: inspected, rigged, simulated and trained; options go before it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.errors import EXIT_WORSE
from ssilk_core.network.checkpoint import load_model
from ssilk_core.scene.fabrics import FABRICS, FRICTION

TOLD = "with density 0.4 kg/m2, thickness 0.0008 m, lame_mu 20 N/m, lame_lambda 10 N/m, bending 2e-05 N m"


@pytest.fixture
def cloth(toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The skirt in a file of its own, in centimetres; the Xform above it is bound to a physics material."""
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "brief.usda", frames=4)
    hero = Usd.Stage.Open("hero.usda")
    skirt = UsdGeom.Mesh(hero.GetPrimAtPath("/Hero/Skirt"))
    stage = Usd.Stage.CreateNew("cloth.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    material = UsdShade.Material.Define(stage, "/Looks/Linen")
    for name, number in (
        ("density", 500e-6),
        ("surfaceStretchStiffness", 50),
        ("surfaceShearStiffness", 20),
        ("surfaceBendStiffness", 5e-6 * 1e4),
        ("dynamicFriction", 0.3),
    ):
        material.GetPrim().CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float).Set(number)
    top = UsdGeom.Xform.Define(stage, "/Dress").GetPrim()
    UsdShade.MaterialBindingAPI.Apply(top).Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    mesh = UsdGeom.Mesh.Define(stage, "/Dress/Kilt")
    mesh.CreatePointsAttr([point * 100 for point in skirt.GetPointsAttr().Get()])
    mesh.CreateFaceVertexCountsAttr(skirt.GetFaceVertexCountsAttr().Get())
    mesh.CreateFaceVertexIndicesAttr(skirt.GetFaceVertexIndicesAttr().Get())
    mesh.GetPrim().CreateAttribute("physics:thicknesses", Sdf.ValueTypeNames.FloatArray).Set([0.08])
    stage.GetRootLayer().Save()
    return tmp_path


def test_the_stage_says_what_the_garment_is_made_of(cloth, toy, capsys):
    assert main(["inspect", "hero.usda", "--garment", "cloth.usda", "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    findings = next(event for event in events if event["event"] == "result")["detail"]["findings"]
    (found,) = (finding["found"] for finding in findings if finding["code"] == "fabric")
    assert TOLD in found and found.endswith(f"leaves out physics:dynamicFriction; {FRICTION}")
    assert main(["rig", "hero.usda", "--garment", "cloth.usda", "--proxies", "2", "-o", "own.usda"]) == 0
    assert f"cloth.usda:/Looks/Linen: the fabric is that of the stage's physics material, {TOLD}" in (
        capsys.readouterr().err
    )
    words = ["train", "own.usda", "--motions", "clip.usda", "-o", "own.safetensors", "--material", "bending=0"]
    assert main([*words, *toy.training]) in (0, EXIT_WORSE)
    assert "own.usda:/Hero/Linen: the fabric is" in capsys.readouterr().err
    trained = load_model("own.safetensors").fabric
    assert trained.name == "Linen" and trained.drag == FABRICS["default"].drag and trained.bending == 0
    assert (trained.lame_mu, trained.lame_lambda) == pytest.approx((20.0, 10.0), rel=1e-5)
    assert (trained.density, trained.thickness) == pytest.approx((0.4, 8e-4), rel=1e-5)
    simulate = ["simulate", "own.usda", "--no-body", "--tolerance", "50", "--motion", "brief.usda", "--points", "-o"]
    for out, more, name in (("own_sim.usda", [], "Linen"), ("silk.usda", ["--fabric", "silk"], "silk")):
        assert main([*simulate, out, *more]) == 0
        assert ("the fabric is that of the stage's" in capsys.readouterr().err) == (not more)
        assert read_provenance(cloth / out)["simulated"]["fabric"] == name
