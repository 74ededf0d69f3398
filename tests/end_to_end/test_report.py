# SPDX-License-Identifier: Apache-2.0
"""ssilk report: pages about shots and models, opened in a browser where there is one."""

import json
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.delivery.bake.opened import add_provenance

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
SIZE = 900, 1200  # [pixels]


@pytest.fixture(autouse=True, scope="module")
def pages_have_no_charts() -> None:
    """They have them here."""


@pytest.fixture(scope="module")
def pages(toy, tmp_path_factory) -> Path:
    """A folder with shot.html, with figures, and model.html, with a shot of its own."""
    folder = tmp_path_factory.mktemp("pages")
    figures = folder / "stress.json"
    model, stage = str(toy.folder / "model.safetensors"), str(toy.folder / "rigged.usda")
    stress = ["stress", model, "--stage", stage, "--quick", "--only", "upside", "NaN", "-o", str(figures)]
    assert main(stress) == 0
    counted = shutil.copy(toy.folder / "shot.usda", folder)
    said = read_provenance(counted)["shown_skin"]
    add_provenance(Path(counted), {"shown_skin": {**said, "pierced": 0.25, "limbs": {"Head": 0.125}}})
    shot = ["report", counted, "-o", str(folder / "shot.html"), "--figures", str(figures)]
    assert main(shot) == 0
    motion = str(toy.folder / "clip.usda")
    assert main(["report", model, "--stage", stage, "--motion", motion, "-o", str(folder / "model.html")]) == 0
    return folder


class Outline(HTMLParser):
    """Headings, and how many there are of each element."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.headings, self.counts, self._within = [], {}, ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self._within = tag

    def handle_data(self, data):
        if self._within == "h2" and data.strip():
            self.headings.append(data)


def test_a_page_holds_what_was_asked_for(pages):
    shot = Outline((pages / "shot.html").read_text())
    opening = ["Skirt: verdict", "The shot", "Skirt: its worst frames", "Skirt: over time"]
    assert shot.headings == [*opening, "Extremes", "Provenance"]
    assert shot.counts["svg"] == 1 and 1 <= shot.counts["img"] <= 4
    assert shot.counts["script"] == 3  # the points of skirt and body, and what plays them
    model = Outline((pages / "model.html").read_text())
    assert model.headings == [*opening, "Training", "Provenance"]
    text = (pages / "shot.html").read_text()
    assert "model_sha256" in text and "first number 7" in text
    through = "A limb is through the cloth in 25.0 % of the frames (Head in 12.5 %), as its bake counted."
    assert through in text.partition("Provenance")[0]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize("name", ["shot", "model"])
def test_a_browser_draws_the_page_and_fetches_nothing(pages, name, tmp_path):
    from PIL import Image

    picture = tmp_path / "page.png"
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--v=0",
               "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}",
               f"--window-size={SIZE[0]},{SIZE[1]}"]  # fmt: skip
    address = (pages / f"{name}.html").as_uri()
    shot = subprocess.run([*command, f"--screenshot={picture}", address], capture_output=True, text=True, timeout=120)
    told = [line for line in shot.stderr.splitlines() if "CONSOLE" in line and "GL Driver Message" not in line]
    assert told == []  # where a refused request or an error would be told
    drawn = np.asarray(Image.open(picture).convert("RGB"), dtype=int)
    assert drawn.shape[:2] == (SIZE[1], SIZE[0])
    assert (np.ptp(drawn, axis=2) > 60).sum() > 300  # coloured lines, marks and cloth, not a blank or an error page
    dom = subprocess.run([*command, "--dump-dom", address], capture_output=True, text=True, timeout=120).stdout
    seen, written = Outline(dom), Outline((pages / f"{name}.html").read_text())
    assert seen.headings == written.headings
    assert all(seen.counts[tag] == written.counts[tag] for tag in ("svg", "path", "text", "img", "table", "tr"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("{shot} -o {out}.pdf", "it ends in .html"),
        ("{shot} -o {out}.html --stage {stage} --motion {clip}", "shots hold their character"),
        ("{model} -o {out}.html --stage {stage}", "one of --stage and --motion"),
        ("{out}/none.usda -o {out}.html", "there is no such file"),
        ("{layers} -o {out}.html", "name the stage of a shot, such as "),
        ("{stage} -o {out}.html --figures {stage}", "not a JSON file"),
        ("{shot} -o {out}.html --figures {other}", "not figures of a known kind"),
    ],
)
def test_bad_input_is_one_sentence(toy, tmp_path, capsys, words, said):
    (tmp_path / "other.json").write_text(json.dumps({"a": 1}))
    files = {"shot": "shot.usda", "model": "model.safetensors", "stage": "rigged.usda", "clip": "clip.usda"}
    names = {name: toy.folder / file for name, file in files.items()}
    (tmp_path / "layers/shots/walk").mkdir(parents=True)
    (tmp_path / "layers/shots/walk/shot.usda").touch()
    names["layers"] = tmp_path / "layers"
    filled = words.format(**names, out=tmp_path / "out", other=tmp_path / "other.json").split()
    assert main(["report", *filled]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out.html").exists()
