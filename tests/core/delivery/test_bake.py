# SPDX-License-Identifier: Apache-2.0
"""Bake requests: what is refused, what a shot stores of one, and what importing the package costs."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from ssilk_core.delivery.bake import BakeRequest
from ssilk_core.errors import SsilkError
from ssilk_core.quality.reduction import ModelSize

INPUTS = {"model": "cape.safetensors", "stage": "hero.usdc", "motion": "walk.usdc:/Clip"}
CHANGED = BakeRequest(
    **INPUTS, root="/Hero", fps=24.0, samples_per_frame=2, pre_roll=0.5, target="game8", refine=3, feedback=True,
    latent_iterations=2, latent_elements="few", refined_output="points", hide_covered=True,
    keep=ModelSize(shapes=8, joints=4, influences=2), device="cuda", garment="cape", shot="walk",
    range="1001-1100", handles=8, level_of="coat", asset_version="v012", asset_identifier="studio:/cape",
    colliders=("/Floor", "/Wall"), wind="0,0,5", gusts="2", gravity="0,-3,0", hold=1, loop=True,
    fabric="silk", material=("bending=2x", "drag=0.1"), start_cloth="before.usdc@1000",
)  # fmt: skip


def test_importing_is_light():
    heavy = {"torch", "pxr", "scipy", "igl", "trimesh"}
    code = f"import sys, ssilk_core.delivery.bake; print({heavy} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_shot_stores_what_differs_from_the_defaults():
    assert BakeRequest(**INPUTS).to_metadata() == INPUTS
    stored = CHANGED.to_metadata()
    assert stored.keys() == {item.name for item in fields(BakeRequest)} - {"lbs", "certify"}  # not with all others
    assert all(isinstance(value, str | int | float | bool) for value in stored.values())  # as USD's metadata holds


ALONE = [BakeRequest(**INPUTS, lbs=True), BakeRequest(**INPUTS, certify=True)]


@pytest.mark.parametrize("request_", [BakeRequest(**INPUTS), CHANGED, *ALONE])
def test_a_stored_request_is_read_again(request_):
    assert BakeRequest.from_metadata(request_.to_metadata()) == request_


@pytest.mark.parametrize(
    "document",
    [None, [], {}, {**INPUTS, "plain": True}, {**INPUTS, "fps": "24"}, {**INPUTS, "refine": True},
     {**INPUTS, "keep": "8,4"}, {**INPUTS, "keep": "a,b,c"}, {**INPUTS, "keep": 3}, {"model": "cape.safetensors"}],
)  # fmt: skip
def test_what_is_no_request_is_not_read(document):
    with pytest.raises((TypeError, ValueError)):
        BakeRequest.from_metadata(document)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"target": "abacus"}, "--target: 'abacus'; it is one of usd, "),
        ({"samples_per_frame": 0}, "--samples-per-frame: 0 samples in each frame; 1 to 64 are allowed"),
        ({"pre_roll": float("nan")}, "--pre-roll: nan seconds; 0 to 600 are allowed"),
        ({"asset_version": "v\n1"}, "--asset-version: 'v.*'; 1 to 1000 printable characters are allowed"),
        ({"lbs": True, "fabric": "silk"}, "linear blend skinning has no fabric"),
        ({"hold": 101}, "--hold: 101 frames; 1 to 100 are allowed"),
        ({"hold": 2, "refine": 4}, "--hold: poses that are held for 2 frames, and --refine"),
        ({"asset_identifier": ""}, "--asset-identifier: ''; 1 to 1000 printable characters are allowed"),
        ({"refined_output": "voxels"}, "--refined-output: 'voxels'; it is one of joints, points"),
        ({"lbs": True, "keep": ModelSize(shapes=1, joints=1, influences=1)}, "leave keep out"),
    ],
)
def test_values_out_of_range_are_refused(change, says):
    with pytest.raises(SsilkError, match=says):
        BakeRequest(**INPUTS, **change)


def test_few_elements_are_sampled():
    assert CHANGED.samples_elements and not BakeRequest(**INPUTS).samples_elements


def test_paths_are_as_good_as_text():
    assert BakeRequest(**{name: Path(value) for name, value in INPUTS.items()}) == BakeRequest(**INPUTS)


def test_inputs_can_lie_elsewhere():
    moved = CHANGED.relocated(lambda path: f"/farm/{path}")
    assert moved.inputs == {name: f"/farm/{path}" for name, path in INPUTS.items()} and moved.fps == CHANGED.fps


def test_a_start_is_relocated_as_inputs_are():
    moved = CHANGED.relocated(lambda path: f"/there/{path}")
    assert moved.start_cloth == "/there/before.usdc@1000" and moved.model == "/there/cape.safetensors"
    plain = BakeRequest(**INPUTS, start_cloth="a@b.usdc").relocated(lambda path: f"/there/{path}")
    assert plain.start_cloth == "/there/a@b.usdc"
