# SPDX-License-Identifier: Apache-2.0
"""A garment whose model knows a range of fabrics: played in each of them, while it is chosen, and baked so."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import fabrics_of, model_of
from blender_addon.scene.handover import STAGE
from ssilk_core.scene.fabric_range import factors_of
from ssilk_core.scene.fabrics import FABRICS

from .scenes import shown
from .test_panels import drawn

EXACT = 2e-5  # [m]
FRAMES = range(1, 41, 3)


RANGED = """
import sys
from dataclasses import replace
import numpy as np
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.fabrics import SeenFabrics
from ssilk_core.scene.fabric_range import FabricRange
path, output, *words = sys.argv[1:]
file, rng = load_model(path), np.random.default_rng(0)
biases = {name: file.parameters[f"{name}.0.bias"] for name in ("initialiser", "stepper")}
columns = {name: 0.2 * rng.normal(size=(len(bias), 5)) for name, bias in biases.items()}
save_model(output, replace(file, fabrics=SeenFabrics(FabricRange.of(file.fabric, words), columns)))
"""


@pytest.fixture
def ranged(ready, trained, tmp_path, ssilk_python):
    """The skirt with a model that knows fabrics, as if it had learned that each moves it otherwise."""
    path, output = model_of(trained), tmp_path / "model.safetensors"
    shutil.copyfile(path.parent / STAGE, tmp_path / STAGE)
    subprocess.run([ssilk_python, "-c", RANGED, str(path), str(output), "4", "silk", "leather"], check=True)
    trained.ssilk.model = str(output)
    return trained


def playing():
    from blender_addon.playback import playing

    return playing


def test_a_slider_turns_what_is_played_at_once_and_back_again(ready, ranged):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    own = shown(ready, ranged, FRAMES)
    ranged.ssilk.played.bending = 3.0
    assert playing().live(ranged).trained.player.file.fabric.bending == pytest.approx(3 * FABRICS["default"].bending)
    stiff = shown(ready, ranged, FRAMES)
    assert np.abs(stiff - own).max() > 0.01
    ready.ops.ssilk.stop_live()
    ready.ops.ssilk.play_live()
    np.testing.assert_array_equal(shown(ready, ranged, FRAMES), stiff)
    ranged.ssilk.played.bending = 1.0
    np.testing.assert_array_equal(shown(ready, ranged, FRAMES), own)


def test_a_preset_sets_factors_of_the_models_own_fabric_and_a_bake_is_what_was_played(ready, ranged):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    ranged.ssilk.played.preset = "silk"
    wanted = factors_of(fabrics_of(ranged)[0], FABRICS["silk"])
    found = [getattr(ranged.ssilk.played, name) for name in ("stretch", "shear", "bending", "density", "drag")]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    played = shown(ready, ranged, FRAMES)
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert playing().live(ranged) is None
    assert np.abs(shown(ready, ranged, FRAMES) - played).max() < EXACT
    ranged.ssilk.played.preset = "OWN"
    assert ranged.ssilk.played.bending == 1.0


def test_keys_show_the_fabric_that_is_played(ready, ranged):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    ranged.ssilk.played.density = 2.5
    seen = shown(ready, ranged, FRAMES)
    playing().stop_listening()  # without handlers keys alone move the garment, as in a render
    try:
        np.testing.assert_allclose(shown(ready, ranged, FRAMES), seen, atol=EXACT)
    finally:
        playing().start_listening()


def test_the_panel_says_what_the_network_does_not_know(ready, trained, ranged, monkeypatch):
    from blender_addon.panels.playback import PlayedFabricPanel

    names = ["preset", "stretch", "shear", "bending", "density", "drag", "friction"]
    assert drawn(PlayedFabricPanel, ready.context) == names
    ranged.ssilk.played.preset = "silk"
    assert len(drawn(PlayedFabricPanel, ready.context)) == len(names)
    monkeypatch.setitem(FABRICS, "silk", replace(FABRICS["silk"], bending=2e-5))
    line = " ".join(drawn(PlayedFabricPanel, ready.context)[len(names) :])
    assert line == "'silk' is the fabric that its training called so; the preset has now: bending 2, not 0.7"
    ranged.ssilk.played.drag = 9.0
    line = " ".join(drawn(PlayedFabricPanel, ready.context)[len(names) :])
    assert line == "The network sees the nearest fabric of its training: drag 9 (trained from 0.25 to 4) is beyond"
    ranged.ssilk.model = ""
    line = " ".join(drawn(PlayedFabricPanel, ready.context)[len(names) :])
    assert line == "The model knows one fabric: train it with Range of Fabrics"


def test_a_model_of_one_fabric_plays_as_before_whatever_is_chosen(ready, trained):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    own = shown(ready, trained, FRAMES)
    trained.ssilk.played.bending = 3.0
    np.testing.assert_array_equal(shown(ready, trained, FRAMES), own)


def test_trainings_are_for_a_range_where_that_is_chosen(ready, skirt):
    from blender_addon.operators.training import train_command

    assert "--fabrics" not in train_command(skirt, "/Skirt", ["walk.usdc"], [])
    skirt.ssilk.training.fabrics = True
    command = train_command(skirt, "/Skirt", ["walk.usdc"], [])
    at = command.index("--fabrics")
    assert command[at + 1 : at + 7] == ["4", "silk", "cotton", "denim", "wool", "leather"]


@pytest.mark.parametrize(("quality", "taken"), [("hero", ["--material", "friction=0.4"]), ("film", [])])
def test_friction_is_taken_by_bakes_that_know_it_and_else_told(ready, trained, monkeypatch, capfd, quality, taken):
    from blender_addon.errors import SetupError
    from blender_addon.operators.baking import BakeGarment

    asked = []

    def commands(bake, folder):
        asked.append(bake.in_fabric)
        raise SetupError("Nothing is baked here.")

    monkeypatch.setattr(BakeGarment, "commands", commands)
    trained.ssilk.played.friction = 0.4
    with pytest.raises(RuntimeError, match="Nothing is baked here"):
        ready.ops.ssilk.bake(quality=quality)
    assert asked == [taken]
    assert ("Friction is left out" in capfd.readouterr().out) == (not taken)
