# SPDX-License-Identifier: Apache-2.0
"""Write defaults, and the presets that differ, into the tables of docs/settings.md: `python -m tools.settings_page`.

A row is "| `name` | default | presets | what it does |"; its name and its last cell are written by hand.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ssilk_core.network.settings import ModelConfig, setting_names
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.training.settings import PRESETS, TrainConfig

PAGE = Path(__file__).parents[1] / "docs" / "settings.md"
ROW = re.compile(r"^\| `(\w+)` \|[^|\n]*\|[^|\n]*\|", re.MULTILINE)


def settings() -> dict[str, tuple[str, str]]:
    """Return the default of each setting by its name, and which presets have another value."""
    models = {name: preset.model for name, preset in PRESETS.items()}
    trainings = {name: preset.train for name, preset in PRESETS.items()}
    return _cells(ModelConfig(), models) | _cells(TrainConfig(), trainings) | _cells(Fabric("default"), FABRICS)


def written(page: str) -> str:
    """Return a page with the cells of its rows as they are now; rows of unknown settings stay."""
    known = settings()

    def row(found: re.Match[str]) -> str:
        name = found[1]
        return f"| `{name}` | {known[name][0]} | {known[name][1]} |" if name in known else found[0]

    return ROW.sub(row, page)


def _cells(default: Any, presets: dict[str, Any]) -> dict[str, tuple[str, str]]:
    cells = {}
    for name in setting_names(default):
        usual = getattr(default, name)
        values = {preset: getattr(config, name) for preset, config in presets.items()}
        others = [f"{preset} {_word(value)}" for preset, value in values.items() if value != usual]
        cells[name] = (_word(usual), ", ".join(others))
    return cells


def _word(value: Any) -> str:
    """Return a value as `--set` takes it."""
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
