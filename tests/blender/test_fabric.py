# SPDX-License-Identifier: Apache-2.0
"""Fabrics: the extension's are ssilk's, and what an artist sets reaches the command line."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from blender_addon import fabrics
from ssilk_core.fabrics import FABRICS, STRETCH_MODELS


def test_presets_are_the_cores():
    assert fabrics.STRETCH_MODELS == STRETCH_MODELS
    cores = {name: {key: value for key, value in asdict(fabric).items() if isinstance(value, float)}
             for name, fabric in FABRICS.items()}  # fmt: skip
    assert cores == fabrics.PRESETS


def test_only_what_differs_is_said():
    silk = fabrics.PRESETS["silk"]
    assert fabrics.options("silk", "stvk", silk) == ["--fabric", "silk"]
    given = fabrics.options("silk", "baraff_witkin", {**silk, "density": 0.2, "bending": 3.0000001e-6})
    assert given == ["--fabric", "silk", "--material", "stretch_model=baraff_witkin", "--material", "density=0.2"]


def test_a_preset_sets_the_values_and_these_may_be_changed(bpy, skirt):
    from blender_addon.fabric_properties import CHOICES, fabric_options

    fabric = skirt.ssilk.fabric
    assert fabric_options(fabric) == ["--fabric", "default"]
    for name, *_ in CHOICES:
        fabric.preset = name
        assert fabric_options(fabric) == ["--fabric", name]
    assert fabric.density == pytest.approx(0.6)
    fabric.bending = 1e-3
    assert fabric_options(fabric) == ["--fabric", "leather", "--material", "bending=0.001"]


def test_each_garment_has_its_own(bpy, skirt):
    other = skirt.copy()
    other.ssilk.fabric.preset = "denim"
    assert skirt.ssilk.fabric.preset == "default"


def test_the_margin_is_shown_in_the_scenes_units(bpy, skirt):
    from blender_addon.fabric_properties import fabric_options

    fabric = skirt.ssilk.fabric
    assert fabric.margin == pytest.approx(0.004)
    bpy.context.scene.unit_settings.scale_length = 0.01
    assert fabric.margin == pytest.approx(0.4)
    fabric.margin = 0.5
    assert fabric_options(fabric) == ["--fabric", "default", "--material", "margin=0.005"]


def test_ssilk_takes_the_options(ready, skirt, ssilk_python):
    import subprocess

    from blender_addon.fabric_properties import fabric_options

    skirt.ssilk.fabric.preset = "wool"
    skirt.ssilk.fabric.stretch_model = "baraff_witkin"
    skirt.ssilk.fabric.margin = 0.006
    program = (
        "import argparse, sys; from ssilk_core.cli.options import add_fabric, fabric; "
        "verb = argparse.ArgumentParser(); add_fabric(verb); print(fabric(verb.parse_args()))"
    )
    command = [ssilk_python, "-c", program, *fabric_options(skirt.ssilk.fabric)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, env={}).stdout
    for word in ("name='wool'", "stretch_model='baraff_witkin'", "margin=0.006", "density=0.3"):
        assert word in said


def test_the_panel_shows_the_values_of_the_model(bpy, skirt):
    from blender_addon.panels.fabric import FabricPanel

    from .test_panels import drawn

    assert {"preset", "lame_mu", "margin"} <= set(drawn(FabricPanel, bpy.context))
    skirt.ssilk.fabric.stretch_model = "baraff_witkin"
    notes = drawn(FabricPanel, bpy.context)
    assert "shear" in notes and "lame_mu" not in notes
