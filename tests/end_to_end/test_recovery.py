# SPDX-License-Identifier: Apache-2.0
"""A bake whose rollout runs away: the garment is put to rest, and the command, the file and its proof say so."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.scene.assets import PINNED


def test_a_bake_says_where_its_rollout_was_lost(toy, tmp_path, capsys):
    file = load_model(toy.folder / "model.safetensors")
    free = replace(file.config, latent_bound=0.0, max_latent_step=0.0)
    wild = {**file.parameters, "integrator.beta": np.full(free.latent, -9, dtype=np.float32)}
    model, shot = tmp_path / "wild.safetensors", tmp_path / "shot.usda"
    save_model(model, replace(file, config=free, parameters=wild))
    words = [str(model), "--stage", str(toy.folder / "rigged.usda"), "--motion", str(toy.folder / "clip.usda")]
    assert main(["bake", *words, "-o", str(shot), "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    warned = [event["text"] for event in events if event["event"] == "message" and event["level"] == "warning"]
    spans = list(read_provenance(shot)["recovered"])
    assert spans and warned == [
        f"frames {span}: the rollout was lost, and the garment is put to rest" for span in spans
    ]
    assert events[-1]["event"] == "result" and events[-1]["detail"]["put to rest"] == spans
    assert all(0 < int(word) < 40 for span in spans for word in span.split(" to "))
    assert main(["verify", str(shot)]) == 0


def test_a_bake_tells_how_much_skin_shows(toy, tmp_path):
    """What it says of the frames that it counted is what a page measures of the shot's own points."""
    file, model = load_model(toy.folder / "model.safetensors"), tmp_path / "model.safetensors"
    inward = file.parameters["decoder.shapes"].copy()
    free = file.scene.garment.mesh.points[file.scene.classes != PINNED]
    inward[:, [0, 2]] = -0.3 * free[:, [0, 2], None]  # towards the pillar's axis
    last = max(name for name in file.parameters if re.fullmatch(r"output.\d.bias", name))
    active = file.parameters[last].copy()
    active[: inward.shape[2]] += np.linspace(0.2, 0.5, inward.shape[2])
    save_model(model, replace(file, parameters={**file.parameters, "decoder.shapes": inward, last: active}))
    for options, frames in ([], 6), (["--refine", "1"], 3):  # such crumpled cloth takes long to refine
        clip = toy.write_clip(tmp_path / "clip.usda", frames=frames)
        words = ["--stage", str(toy.folder / "rigged.usda"), "--motion", str(clip)]
        shot, page = tmp_path / "shot.usda", tmp_path / "page.html"
        assert main(["bake", str(model), *words, "-o", str(shot), *options]) == 0
        found = read_provenance(shot)["shown_skin"]
        assert found["covered"] > 1000 and found["frames"] == frames and found["clip"] == "clip"
        assert main(["report", str(shot), "-o", str(page)]) == 0
        least = 0 if options else 0.001  # refined cloth is lifted off the skin
        assert least <= found["mean"] <= found["worst"] < 0.9
        shown = re.search(r"covered skin that shows \[%\]</td>(?:<td[^>]*>([^<]*)</td>){4}", page.read_text())
        assert float(shown[1]) == pytest.approx(100 * found["worst"], rel=0.02, abs=0.05)


def test_a_calm_bake_says_nothing_of_it(toy):
    assert "recovered" not in read_provenance(toy.folder / "shot.usda")
