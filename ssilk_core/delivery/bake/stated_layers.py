# SPDX-License-Identifier: Apache-2.0
"""What the stage of a shot says of garments over one another, while their layers are as they were counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from ...physics.intersections.figures import LAYERS, LayerFigures
from ...scene.plain import from_plain
from .record import ANIMATION, TaskRecord

COUNTED_IN = "counted_in"  # SHA-256 of the outer and of the inner garment's layer

Records = Mapping[str, TaskRecord | None]


def layer_facts(figures: Sequence[LayerFigures], found: Records) -> dict[str, object]:
    """Return figures as the stage of a shot holds them: by the outer garment's name, then by the inner one's.

    Args:
        found: records of the shot's garments, by name.
    """
    facts: dict[str, dict[str, object]] = {}
    for each in figures:
        own = {**each.to_metadata(), COUNTED_IN: _layers(found, each.outer, each.inner)}
        facts.setdefault(each.outer, {})[each.inner] = own
    return {LAYERS: facts} if facts else {}


def current_facts(said: Mapping[str, Any], found: Records) -> dict[str, object]:
    """Return what of such facts is about pairs whose layers are as they were counted.

    Args:
        said: what a stage says, or is to say.
    """
    kept: dict[str, dict[str, Any]] = {}
    for outer, pairs in said.get(LAYERS, {}).items():
        for inner, pair in pairs.items():
            layers = _layers(found, outer, inner)
            if layers and pair.get(COUNTED_IN) == layers:
                kept.setdefault(outer, {})[inner] = dict(pair)
    return {LAYERS: kept} if kept else {}


def worn_pairs(found: Records) -> list[tuple[str, str]]:
    """Return the pairs of garments that one character wears, without levels of quality of other garments."""
    wearers = {name: record.wearer for name, record in found.items() if record and not record.level_of}
    return [(one, other) for one, other in combinations(wearers, 2) if wearers[one] == wearers[other]]


def all_stated(stage: Path, found: Records) -> list[LayerFigures]:
    """Return what `stated_layers` does where a stage tells of each pair that one character wears; else none.

    A garment that was baked since is in no figures, and pairs that do not touch are not, so that these are counted.
    """
    stated = stated_layers(stage, found)
    return stated if len(stated) == len(worn_pairs(found)) else []


def stated_layers(stage: Path, found: Records) -> list[LayerFigures]:
    """Return the figures of these pairs in a stage; none where one is told otherwise than this version does."""
    from ssilk_usd.shots.layers_stage import stage_facts

    said: Any = current_facts(stage_facts(stage), found).get(LAYERS, {})
    pairs = [pair for own in said.values() for pair in own.values()]
    try:
        return [
            from_plain(LayerFigures, {name: value for name, value in pair.items() if name != COUNTED_IN})
            for pair in pairs
        ]
    except (TypeError, ValueError):  # of another version: whoever asks counts for itself
        return []


def _layers(found: Records, *names: str) -> str:
    """Return the SHA-256 of the layers of garments; empty where one is not known."""
    records = [found.get(name) for name in names]
    digests = [record.files.get(ANIMATION, "") if record else "" for record in records]
    return " ".join(digests) if all(digests) else ""
