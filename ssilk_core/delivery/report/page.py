# SPDX-License-Identifier: Apache-2.0
"""A self-contained page of HTML: style, charts and pictures are inside it, and it loads nothing."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from io import BytesIO
from typing import Any

from ..view.render import Image

# Whatever a name or a message in the figures contains, the browser fetches nothing, and runs the player alone.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
STYLE = """
:root { color-scheme: light dark; --ink: #22262b; --paper: #fff; --faint: #d9dde2; --bad: #b03a48; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #dfe3e8; --paper: #17191c; --faint: #3a3f46; --bad: #ef8792; }
}
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 60rem;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid var(--faint); }
svg { width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .2rem .6rem; text-align: left; border-bottom: 1px solid var(--faint); vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.bad td { color: var(--bad); }
td:first-child { white-space: nowrap; }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; } figure { margin: 0; width: 13rem; } img { width: 100%; }
figcaption, .note { font-size: 13px; opacity: .8; }
.player canvas { width: 100%; aspect-ratio: 16 / 10; display: block; cursor: grab; touch-action: none; }
.controls { display: flex; flex-wrap: wrap; gap: .6rem; align-items: center; margin-top: .4rem; font-size: 13px; }
.controls input[type=range] { flex: 1; } .controls output { min-width: 8rem; font-variant-numeric: tabular-nums; }
[data-seconds] img { cursor: pointer; }
"""


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading, its HTML, figures of it for programs, and whether a shot plays in it."""

    title: str
    body: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    plays: bool = False


def page(title: str, sections: Sequence[Section]) -> str:
    """Return a whole page."""
    parts = "\n".join(f"<section><h2>{escape(part.title)}</h2>\n{part.body}\n</section>" for part in sections)
    code = script() if any(part.plays for part in sections) else ""
    allowed = f"; script-src '{_hash(code)}'" if code else ""
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}{allowed}">'
        f'<meta name="viewport" content="width=device-width"><title>{escape(title)}</title><style>{STYLE}</style>'
    )
    body = f"<h1>{escape(title)}</h1>\n{parts}" + (f"\n<script>{code}</script>" if code else "")
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def script() -> str:
    """Return the script that plays every shot of a page."""
    return files(__package__).joinpath("player.js").read_text(encoding="utf-8")


def _hash(code: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], bad: Sequence[int] = ()) -> str:
    """Return a table; figures are aligned to the right, and rows whose numbers are in `bad` are highlighted."""
    lines = []
    for number, row in enumerate(rows):
        kind = ' class="bad"' if number in bad else ""
        lines.append(f"<tr{kind}>{''.join(map(_cell, row))}</tr>")
    heading = "".join(f"<th>{escape(word)}</th>" for word in header)
    rows_of = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{heading}</tr></thead>\n<tbody>{rows_of}</tbody></table></div>'


def _cell(words: str) -> str:
    kind = ' class="number"' if words[:1] in set("+-0123456789") and len(words) < 24 else ""
    return f"<td{kind}>{escape(words)}</td>"


def facts(document: Mapping[str, Any]) -> str:
    """Return nested plain values as a table of names and values, inner names after a dot."""
    return table(("what", "value"), [(name, words) for name, words in flattened(document).items()])


def flattened(document: Mapping[str, Any], above: str = "") -> dict[str, str]:
    """Return nested plain values by their names joined with dots, as words."""
    found: dict[str, str] = {}
    for name, value in document.items():
        path = f"{above}{name}"
        if isinstance(value, Mapping):
            found |= flattened(value, f"{path}.")
        else:
            found[path] = worded(value)
    return found


def worded(value: object) -> str:
    """Return a plain value as words for people."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(worded, value))
    return str(value)


def figure(image: Image, caption: str, seconds: float | None = None) -> str:
    """Return a picture (H, W, 3) with words below it; a click takes the player to `seconds` of the shot."""
    from PIL import Image as Pictures

    stream = BytesIO()
    Pictures.fromarray(image).save(stream, format="PNG", optimize=True)
    data = base64.b64encode(stream.getvalue()).decode()
    words = escape(caption)
    moment = "" if seconds is None else f' data-seconds="{seconds:.6g}"'
    picture = f'<img alt="{words}" src="data:image/png;base64,{data}">'
    return f"<figure{moment}>{picture}<figcaption>{words}</figcaption></figure>"
