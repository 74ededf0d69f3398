# SPDX-License-Identifier: Apache-2.0
"""Fabrics: what an artist sets reaches the command line."""

from __future__ import annotations

import pytest


def test_every_fabric_and_model_can_be_chosen(bpy, skirt):
    from blender_addon.settings.fabric import CHOICES, MODELS, NUMBERS
    from ssilk_core.scene.fabrics import FABRICS, STRETCH_MODELS

    assert [name for name, *_ in CHOICES] == list(FABRICS)
    assert {name for name, *_ in MODELS} == set(STRETCH_MODELS)
    assert all(hasattr(skirt.ssilk.fabric, name) for name in NUMBERS)


def test_only_what_differs_is_said(bpy, skirt):
    from blender_addon.settings.fabric import fabric_options

    fabric = skirt.ssilk.fabric
    fabric.preset, fabric.stretch_model, fabric.density = "silk", "baraff_witkin", 0.2
    given = ["--fabric", "silk", "--material", "stretch_model=baraff_witkin", "--material", "density=0.2"]
    assert fabric_options(fabric) == given


def test_a_preset_sets_the_values_and_these_may_be_changed(bpy, skirt):
    from blender_addon.settings.fabric import CHOICES, fabric_options

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
    from blender_addon.settings.fabric import fabric_options

    fabric = skirt.ssilk.fabric
    assert fabric.margin == pytest.approx(0.008)
    bpy.context.scene.unit_settings.scale_length = 0.01
    assert fabric.margin == pytest.approx(0.8)
    fabric.margin = 0.5
    assert fabric_options(fabric) == ["--fabric", "default", "--material", "margin=0.005"]


def test_ssilk_takes_the_options(ready, skirt, ssilk_python):
    import subprocess

    from blender_addon.settings.fabric import fabric_options

    skirt.ssilk.fabric.preset = "wool"
    skirt.ssilk.fabric.stretch_model = "baraff_witkin"
    skirt.ssilk.fabric.margin = 0.006
    program = (
        "import argparse, sys; from ssilk_core.cli.options.fabric import add_fabric, asked_fabric; "
        "verb = argparse.ArgumentParser(); add_fabric(verb); print(asked_fabric(verb.parse_args()))"
    )
    command = [ssilk_python, "-c", program, *fabric_options(skirt.ssilk.fabric)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, env={}).stdout
    for word in ("name='wool'", "stretch_model='baraff_witkin'", "margin=0.006", "density=0.3"):
        assert word in said


def test_the_panel_shows_the_values_of_the_model(bpy, skirt):
    from blender_addon.panels.garment import FabricPanel

    from .test_panels import drawn

    assert {"preset", "lame_mu", "margin"} <= set(drawn(FabricPanel, bpy.context))
    skirt.ssilk.fabric.stretch_model = "baraff_witkin"
    notes = drawn(FabricPanel, bpy.context)
    assert "shear" in notes and "lame_mu" not in notes
    assert "contact" in notes and "collision" not in notes
    skirt.ssilk.fabric.preset = "paper"
    assert skirt.ssilk.fabric.contact_model == "vertex"
    notes = drawn(FabricPanel, bpy.context)
    assert "collision" in notes and "contact" not in notes
