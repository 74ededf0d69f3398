# SPDX-License-Identifier: Apache-2.0
"""Turn the artist guide into a page that a browser shows, for the extension's zip.

It knows what the guide uses: headings, paragraphs, lists, tables, code, pictures, links.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator

STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:48rem;margin:2rem auto;padding:0 1rem}img{max-width:100%}"
    "table{border-collapse:collapse}td,th{border:1px solid #999;padding:.3rem .6rem;text-align:left}"
    "code{background:#eee}"
)
INLINE = (
    (r"!\[([^\]]*)\]\(([^)]+)\)", r'<img src="\2" alt="\1">'),
    (r"\[([^\]]+)\]\((#[^)]+|https?://[^)]+)\)", r'<a href="\2">\1</a>'),
    (r"\[([^\]]+)\]\([^)]+\)", r"\1"),  # other documents are not in the zip
    (r"\*\*([^*]+)\*\*", r"<strong>\1</strong>"),
    (r"\*([^*]+)\*", r"<em>\1</em>"),
)  # in this order


def page(text: str) -> str:
    """Return a document in Markdown as a page of HTML."""
    blocks = re.split(r"\n(?=```)|(?<=\n```)\n|\n{2,}|\n(?=#)|(?<=\n)(?=#)", text.strip())
    body = "\n".join(line for block in blocks if block.strip() for line in _block(block.strip("\n")))
    title = html.escape(text.lstrip("# ").partition("\n")[0])
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"</head><body>\n{body}\n</body></html>\n"
    )


def slug(heading: str) -> str:
    """Return the name by which links reach a heading, as code hosts form it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _block(block: str) -> Iterator[str]:
    """Yield one block of a document as lines of HTML."""
    lines = block.split("\n")
    if heading := re.match(r"(#+) (.+)", block):
        level = len(heading[1])
        yield f'<h{level} id="{slug(heading[2])}">{_inline(heading[2])}</h{level}>'
    elif block.startswith("```"):
        yield f"<pre>{html.escape(chr(10).join(line for line in lines if not line.startswith('```')))}</pre>"
    elif block.startswith("|"):
        yield "<table>"
        for line in lines:
            if not re.fullmatch(r"[|:\- ]+", line):
                cells = "".join(f"<td>{_inline(cell.strip())}</td>" for cell in line.strip("|").split("|"))
                yield f"<tr>{cells}</tr>"
        yield "</table>"
    elif block.startswith("* "):
        yield "<ul>"
        for item in re.split(r"\n\* ", block[2:]):
            yield f"<li>{_inline(' '.join(item.split()))}</li>"
        yield "</ul>"
    else:
        yield f"<p>{_inline(' '.join(lines))}</p>"


def _inline(text: str) -> str:
    """Return a line with its emphasis, links, pictures and code."""
    parts = text.split("`")
    for index, part in enumerate(parts):
        parts[index] = html.escape(part, quote=False)
        if index % 2:
            parts[index] = f"<code>{parts[index]}</code>"
        else:
            for pattern, replacement in INLINE:
                parts[index] = re.sub(pattern, replacement, parts[index])
    return "".join(parts)
