# SPDX-License-Identifier: Apache-2.0
"""Every figure in the documents is that of the file it comes from, and none is without such a file.

A figure is a number in prose or in a table. Code, links and names that hold digits are none. What `quoted.py` makes
of the results must stand in the document, word for word; what is left must be one of `CONSTANTS`.
"""

from __future__ import annotations

import re
import shlex

import pytest
from ssilk_usd.checking.shot import TOLERANCE, WORLD
from ssilk_usd.reading.motion import FARTHEST

from benchmarks.helpers.paper_schemes import PAPER_SCHEMES
from ssilk_core.cli import parser
from ssilk_core.delivery.bake.shown_skin import SKIN_FRAMES
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig, apply_overrides
from ssilk_core.physics.skin.covered_skin import SKIN_POINTS
from ssilk_core.physics.skin.figures import COVER_REACH, SHOW_DEPTH
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training.settings import TrainConfig
from tests.documents import measured
from tests.documents.measured import RESULTS, ROOT
from tests.documents.quoted import QUOTED

COLUMNS = 118
LARGEST_DATA, LARGEST_PICTURE, LARGEST_FOLDER = 64_000, 200_000, 700_000  # bytes of a file, and of all

CONSTANTS: dict[str, tuple[str, ...]] = {
    "a number in the paper": (r"\b(Table|Figure|Section|Eqs?\.) \d+( (and|to) \d+)*",),
    "a version": (r"\b(Blender|bpy|Python|USD) \d+(\.\d+)*( and( bpy)? \d+(\.\d+)*)?", r"^## \d+\.\d+\.\d+"),
    "a licence": (r"(Apache|GPL)-\d\.\d(-or-later)?", r"\bCC0\b"),
    "the number of a heading or of a step": (r"^(#+ )?\d+\. ", r"\(step \d\)"),
    "an exit code": (
        r"^\| (0|1|2|3|4|5|130) \|",
        r"exit code 2 \(3 when a",
        r"\b4 when some tasks",
        r"\b130 when\s+interrupted",
    ),
    "part of a definition": (r"\[(0|−1), 1\]", r"gravity \(0, −9\.81, 0\)", r"at most 1 cm/s|under 1 cm/s"),
    "part of the definition of the skin that shows": (
        rf"\b{SKIN_POINTS:,} points are spread",
        rf"within {1000 * COVER_REACH:.0f} mm above",
        rf"within {1000 * SHOW_DEPTH:.0f} mm beneath",
        rf"at most {SKIN_FRAMES} samples",
    ),
    "part of what a vertex may be off": (
        rf"by {1e6 * TOLERANCE:.0f} µm, plus",
        rf"growing\s+{WORLD / 1000:.0f} km away",
        rf"more than {FARTHEST / 1000:.0f} km away",
    ),
    "an example of a message": (r"\*12 of 900 vertices",),
    "the shape of a tensor": (r"the shape \(\w+(, \w+)*\)",),
    "a rate of motion": (r"at 30 frames\s+a second",),
}
"""Numbers that nothing measures, as patterns, with the reason."""

NO_PROSE = (
    r"```.*?```",  # blocks of code
    r"`[^`\n]+`",  # code
    r"(?<=\])\([^)\s]+\)",  # targets of links
    r"https?://\S+",
)
FIGURE = r"(?<![\w.])[−+-]?\d[\d.,]*(?![\w])"


def blanked(text: str, pattern: str) -> str:
    """Return the text with every match made blank, so that lines keep their numbers."""
    return re.sub(pattern, lambda match: re.sub(r"\S", " ", match[0]), text, flags=re.DOTALL | re.MULTILINE)


def words(quote: str) -> str:
    """Return a pattern for text whose lines may be broken anywhere, and which does not end within a number."""
    first, *rest = map(re.escape, quote.split())
    return first + rf"(?<![\d.]{first})" + "".join(rf"\s+{word}" for word in rest) + r"(?!\d|\.\d)"


def unsourced(text: str, quotes: list[str]) -> list[str]:
    """Return the lines with figures that are neither quoted nor constant."""
    left = text
    for quote in sorted(quotes, key=len, reverse=True):
        left = blanked(left, words(quote))
    for pattern in (*NO_PROSE, *(pattern for patterns in CONSTANTS.values() for pattern in patterns)):
        left = blanked(left, pattern)
    lines = zip(text.splitlines(), left.splitlines(), strict=True)
    return [
        f"line {number}: {', '.join(re.findall(FIGURE, rest))} in '{whole.strip()}'"
        for number, (whole, rest) in enumerate(lines, 1)
        if re.search(FIGURE, rest)
    ]


@pytest.mark.parametrize("document", QUOTED)
def test_figures_are_those_of_the_files_that_they_come_from(document):
    text = (ROOT / document).read_text()
    missing = [quote for quote in QUOTED[document]() if not re.search(words(quote), text)]
    assert not missing, f"{document} does not say:\n" + "\n".join(missing)


@pytest.mark.parametrize("document", QUOTED)
def test_no_figure_is_without_a_file(document):
    found = unsourced((ROOT / document).read_text(), list(QUOTED[document]()))
    assert not found, f"{document}: quote these in tests/documents/quoted.py, or leave them out:\n" + "\n".join(found)


def test_every_document_is_looked_at():
    documents = {str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))}
    assert documents == set(QUOTED)


@pytest.mark.parametrize(
    "text",
    ["It takes 12.3 ms.", "| cape | 0.21 |", "97 % of them", "3,000 frames", "ends at 5.", "−0.2 J", "took 35 s"],
)
def test_a_new_figure_is_noticed(text):
    assert unsourced(text, ["takes 12 ms", "took 3 s"])


@pytest.mark.parametrize(
    "text", ["It takes\n12 ms.", "as `width=12`", "float32 and 02_04", "[x](a_12.png)", "Table 3"]
)
def test_what_has_a_source_or_is_no_figure_is_left_alone(text):
    assert not unsourced(text, ["takes 12 ms"])


def test_results_are_quoted_and_small():
    for quotes in QUOTED.values():
        list(quotes())
    documents = "".join((ROOT / document).read_text() for document in QUOTED)
    files = [path for path in RESULTS.rglob("*") if path.is_file()]
    unused = [
        p.name for p in files if p.name not in documents and not (p.suffix == ".json" and p.stem in measured.read)
    ]
    assert not unused, f"no document quotes {unused}"
    sizes = {path: path.stat().st_size for path in files}
    large = [p.name for p, size in sizes.items() if size > (LARGEST_DATA if p.suffix == ".json" else LARGEST_PICTURE)]
    assert not large, f"{large}: keep what documents quote"
    assert sum(sizes.values()) <= LARGEST_FOLDER, sizes


def test_pictures_are_shown():
    documents = "".join((ROOT / document).read_text() for document in QUOTED)
    unshown = [path.name for path in (ROOT / "docs" / "images").iterdir() if path.name not in documents]
    assert not unshown


@pytest.mark.parametrize("document", QUOTED)
def test_lines_fit_a_terminal(document):
    lines = (ROOT / document).read_text().splitlines()
    assert not [f"line {number}: {len(line)}" for number, line in enumerate(lines, 1) if len(line) > COLUMNS]


@pytest.mark.parametrize("document", QUOTED)
def test_links_lead_to_files(document):
    text = blanked((ROOT / document).read_text(), NO_PROSE[0])
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target]
    missing = [target for target in targets if target and not ((ROOT / document).parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("document", ["docs/training.md", "docs/results.md"])
def test_settings_exist_and_take_these_values(document, monkeypatch):
    for name, scheme in PAPER_SCHEMES.items():  # the paper's recipe needs one of them
        monkeypatch.setitem(SCHEMES, name, scheme)
    text = (ROOT / document).read_text()
    said = re.findall(r"(?:`|--set )([a-z_]+=[^`\s]+)", text)
    assert said
    for assignment in said:
        config = next(
            (c for c in (ModelConfig(), TrainConfig(), Fabric("")) if hasattr(c, assignment.partition("=")[0])), None
        )
        assert config is not None, f"{document}: no setting '{assignment}'"
        if not isinstance(config, Fabric):
            apply_overrides(config, [assignment])


def test_commands_are_those_of_the_command_line():
    blocks = "".join("".join(re.findall(r"```sh\n(.*?)```", (ROOT / name).read_text(), re.DOTALL)) for name in QUOTED)
    commands = [shlex.split(line, comments=True) for line in blocks.replace("\\\n", " ").splitlines()]
    ours = [words for words in commands if words[:1] == ["ssilk"] and "..." not in words]
    assert ours
    for words in ours:
        parser().parse_args(words[1:])


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", QUOTED)
def test_links_to_headings_find_them(document):
    path = ROOT / document
    for name, anchor in re.findall(r"\]\(([^)\s#:]*)#([^)\s]+)\)", path.read_text()):
        target = path.parent / name if name else path
        assert anchor in anchors(target.read_text()), f"{document}: no heading {name}#{anchor}"
