# SPDX-License-Identifier: Apache-2.0
"""Help: every panel's header opens the guide where it speaks of that panel."""

from __future__ import annotations

import webbrowser
from types import SimpleNamespace

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from tools.guide_page import page, slug

from .conftest import ROOT
from .test_panels import Layout

GUIDE = (ROOT / "docs" / "artist_guide.md").read_text(encoding="utf-8")


def test_every_panel_has_help_about_itself(bpy, monkeypatch):
    from blender_addon.panels import CLASSES

    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    chapters = {slug(line.lstrip("# ")) for line in GUIDE.splitlines() if line.startswith("#")}
    panels = [kind for kind in CLASSES if issubclass(kind, bpy.types.Panel)]
    assert len(panels) == 13
    for kind in panels:
        layout = Layout()
        kind.draw_header_preset(SimpleNamespace(layout=layout, section=kind.section), bpy.context)
        assert layout.notes == ["ssilk.open_guide"] and kind.section in chapters, kind
        assert bpy.ops.ssilk.open_guide(section=kind.section) == {"FINISHED"}
    assert opened[0] == f"{(ROOT / 'docs' / 'artist_guide.md').as_uri()}#2-garment"
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    with pytest.raises(RuntimeError, match="No browser could be opened; the guide is file:"):
        bpy.ops.ssilk.open_guide()


def test_a_website_in_the_manifest_comes_first_and_a_missing_guide_is_told(bpy, monkeypatch, tmp_path):
    from blender_addon.errors import SetupError
    from blender_addon.operators import help as guides

    monkeypatch.setattr(guides, "GUIDES", (tmp_path / "none.html",))
    with pytest.raises(SetupError, match="There is no guide at"):
        guides.guide("")
    (tmp_path / "manifest.toml").write_text('website = "https://example.org/guide"')
    monkeypatch.setattr(guides, "MANIFEST", tmp_path / "manifest.toml")
    assert guides.guide("5-train") == "https://example.org/guide#5-train"


def test_the_page_in_the_zip_says_what_the_guide_says():
    html = page(GUIDE)
    for line in GUIDE.splitlines():
        if line.startswith("#"):
            assert f'id="{slug(line.lstrip("# "))}"' in html
    assert html.count("<img ") == GUIDE.count("![") and html.count("<table>") == GUIDE.count("\n\n|") > 0
    assert "**" not in html and "](" not in html
    text = "a *b* `c<d>` [e](#f)\n\n* one\n  two\n* three\n\n| a | b |\n|---|---|\n| c | d |"
    _, _, body = page(text).partition("<body>")
    assert body.split("\n")[1:8] == [
        '<p>a <em>b</em> <code>c&lt;d&gt;</code> <a href="#f">e</a></p>', "<ul>", "<li>one two</li>",
        "<li>three</li>", "</ul>", "<table>", "<tr><td>a</td><td>b</td></tr>",
    ]  # fmt: skip
