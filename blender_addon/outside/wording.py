# SPDX-License-Identifier: GPL-3.0-or-later
"""Sentences of ssilk about files that were made for it, in the words of artists, who know objects and motions.

Names are by what was made, as seen from its folder: a file, "dressed.usdc", or a prim of one,
"dressed.usdc:/Character/Skirt".
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

NAMES, BONES = "names.json", "bones.json"  # in a folder that outlives Blender
PRIMS = r"(?::(?:/\w+)+)?"  # any prim of a file


def remember(folder: Path, names: Mapping[str, str], kind: str = NAMES) -> None:
    """Keep names of what lies in a folder, or with `BONES` those of bones by the paths of their joints."""
    (folder / kind).write_text(json.dumps(dict(names)), encoding="utf-8")


def recall(folder: Path, kind: str = NAMES) -> dict[str, str]:
    """Return the names that were kept in a folder; none where there are none."""
    try:
        document = json.loads((folder / kind).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # nothing was kept, or it is gone
        return {}
    return {str(made): str(name) for made, name in document.items()} if isinstance(document, dict) else {}


CLASSES = "primvars:ssilk:class"  # which is what artists paint


def with_bones(sentence: str, bones: Mapping[str, str]) -> str:
    """Return a sentence with names of bones in place of joints, by their paths or the last parts of these."""
    names = {path: name for path, name in bones.items() if path != name}
    leaves = [(path.rpartition("/")[2], name) for path, name in bones.items()]
    names |= {leaf: name for leaf, name in leaves if leaf != name and leaf not in bones}
    if names:
        places = "|".join(map(re.escape, sorted(names, key=len, reverse=True)))
        sentence = re.sub(rf"(?<![\w/.])(?:{places})(?![\w/])", lambda found: names[found[0]], sentence)
    return sentence.replace(CLASSES, "its classes")


def reworded(sentence: str, folder: Path, names: Mapping[str, str]) -> str:
    """Return a sentence with names in place of what lies in a folder."""
    places = "|".join(re.escape(place) for place in {str(folder), folder.as_posix()})
    for made in sorted(names, key=len, reverse=True):
        end = r"(?![\w/])" if ":" in made else PRIMS
        pattern = rf"(?:(?:{places})[/\\]|(?<![\w./\\-])){re.escape(made)}{end}"
        sentence = re.sub(pattern, lambda _, name=names[made]: name, sentence)  # type: ignore[misc]
    return sentence
