# SPDX-License-Identifier: Apache-2.0
"""The documents as a site: with `make docs`, Sphinx writes it into build/site from the Markdown that forges show.

What the Markdown lacks is added here: the contents, the Python reference, and players for films.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "usd")]

project = html_title = "SSILK"
root_doc = "docs/index"
include_patterns = ["docs/*.md", "benchmarks/README.md", "CHANGELOG.md"]
exclude_patterns = [".*", "build"]  # environments have tens of thousands of files, which it would match
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
highlight_language = "none"
html_copy_source = html_show_copyright = False

myst_heading_anchors = 4
myst_heading_slug_func = "tools.guide_page.slug"

default_role = "literal"  # of `names` in docstrings
napoleon_use_ivar = True
autodoc_default_options = {"members": True, "imported-members": True}
autodoc_member_order = "groupwise"
autodoc_mock_imports = ["igl", "pxr", "scipy", "torch", "trimesh", "triton"]  # the site shows nothing of them

CONTENTS = """
```{toctree}
:hidden:

artist_guide
pipeline
farm
results
settings
training
architecture
reference
../benchmarks/README
../CHANGELOG
```
"""
REFERENCE = """
## {package}

```{{eval-rst}}
.. automodule:: {package}
```
"""
FILM = r'<a class="reference download internal" download="" href="([^"]+\.mp4)">(.*?)</a>'


def public_packages() -> list[str]:
    """Return the packages in the table of docs/architecture.md."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = text.partition("\n## Public packages\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| `([\w.]+)` \|", section, re.MULTILINE)


def add_directives(app: Any, document: str, source: list[str]) -> None:
    """Add the contents to the start page, and the docstrings of the public packages to the reference."""
    if document == root_doc:
        source[0] += CONTENTS
    elif document == "docs/reference":
        source[0] += "".join(REFERENCE.format(package=package) for package in public_packages())


def escape_bars(app: Any, what: str, name: str, item: object, options: object, lines: list[str]) -> None:
    """Keep the bars of |x| in docstrings, which reStructuredText would take for a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def add_players(app: Any, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Play films: one behind a picture in its place, others beneath the paragraph that links to them."""
    body = re.sub(FILM, _in_place, context.get("body", ""), flags=re.DOTALL)
    context["body"] = re.sub(r"<p>.*?</p>", _with_players, body, flags=re.DOTALL)


def _in_place(link: re.Match[str]) -> str:
    poster = re.search(r'<img[^>]* src="([^"]+)"', link[2])
    return _player(link[1], f' poster="{poster[1]}"') if poster else link[0]


def _with_players(paragraph: re.Match[str]) -> str:
    return paragraph[0] + "".join(_player(address) for address, _ in re.findall(FILM, paragraph[0], re.DOTALL))


def _player(address: str, poster: str = "") -> str:
    return f'<video controls preload="metadata" style="max-width: 100%"{poster} src="{address}"></video>'


def add_entrance(app: Any, error: Exception | None) -> None:
    """Let the site's own address lead to the start page."""
    leads = f'<meta http-equiv="refresh" content="0; url={root_doc}.html">\n'
    (Path(app.outdir) / "index.html").write_text(leads, encoding="utf-8")


def setup(app: Any) -> None:
    """Connect the functions above to Sphinx's events."""
    app.connect("source-read", add_directives)
    app.connect("autodoc-process-docstring", escape_bars)
    app.connect("html-page-context", add_players)
    app.connect("build-finished", add_entrance)
