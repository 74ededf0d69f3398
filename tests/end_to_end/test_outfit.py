# SPDX-License-Identifier: Apache-2.0
"""A garment over another, from training to a folder of layers and its page."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt

from ssilk_core.cli import main
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory) -> Path:
    """The toy with a wider skirt, trained over the toy's own, and one that was trained alone."""
    folder = toy.copy(tmp_path_factory.mktemp("outfit"))
    toy.write_clip(folder / "walk.usda", frames=9)
    stage = Usd.Stage.Open(str(folder / "rigged.usda"))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Skirt")).GetPointsAttr()
    wider = np.array(points.Get()) * [1.08, 1, 1.08]
    points.Set(Vt.Vec3fArray.FromNumpy(wider.astype(np.float32)))
    stage.Export(str(folder / "wide.usda"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "model.safetensors").rename(folder / "skirt.safetensors")
        train = shlex.split("train wide.usda --motions clip.usda --over skirt.safetensors -o coat.safetensors")
        assert main([*train, *toy.training]) in (0, 5)
        train = shlex.split("train rigged.usda --motions clip.usda -o tights.safetensors --set seed=5")
        assert main([*train, *toy.training]) in (0, 5)
    return folder


def baked(capsys: pytest.CaptureFixture[str], models: str, folder: str) -> list[dict]:
    capsys.readouterr()
    assert main(shlex.split(f"bake {models} --stage rigged.usda --motion walk.usda -o {folder} --json")) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def told(events: list[dict]) -> list[str]:
    return [event["text"] for event in events if event["event"] == "message" and event["level"] == "warning"]


def test_what_lies_beneath_is_what_was_trained_over(copy, capsys):
    """Counted once both are there, in whatever order; another model beneath is warned of, and none at all is not."""
    assert load_model("coat.safetensors").provenance["over"] == {"skirt": sha256(Path("skirt.safetensors"))}
    alone = baked(capsys, "coat.safetensors", "layers")
    assert not any("trained over" in text for text in told(alone))
    events = baked(capsys, "skirt.safetensors", "layers")
    figures = [event["detail"] for event in events if event["event"] == "result" and "over" in event["detail"]]
    assert [(each["shot"], each["garment"], each["over"]) for each in figures] == [("walk", "coat", "skirt")]
    assert figures[0]["triangles that intersect skirt"].endswith("%") or "at time code" in str(figures[0])
    assert not any("trained over" in text for text in told(events))
    capsys.readouterr()
    assert main(shlex.split("report layers/shots/walk/shot.usda -o page.html --json")) == 0
    page = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]["garments"]
    (pairs,) = page["layers"].values()
    assert len(pairs) == 1 and pairs[0]["frames"] == 3 and 0 <= pairs[0]["mean"] <= pairs[0]["worst"] <= 1
    assert "Garments over one another" in Path("page.html").read_text()
    other = baked(capsys, "coat.safetensors tights.safetensors", "other")
    (text,) = [text for text in told(other) if "trained over" in text]
    assert "walk/coat: it was trained over 'skirt', and tights of this shot is another model" in text
