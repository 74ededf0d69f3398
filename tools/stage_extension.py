# SPDX-License-Identifier: Apache-2.0
"""Put the Blender extension together in a folder: its own sources, and of the core what plays a garment in Blender.

    python tools/stage_extension.py dist/extension

Nothing of the core is copied but the modules that `ssilk_core.runtime` imports when it is imported; they need numpy
alone.
"""

from __future__ import annotations

import ast
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
ADDON, CORE, VENDOR = ROOT / "blender_addon", ROOT / "ssilk_core", "vendor"
KEPT = {".py", ".toml", ""}  # suffixes of the extension's own files; LICENSE has none


def stage(target: Path) -> None:
    """Write the extension into a folder, in place of what was there."""
    shutil.rmtree(target, ignore_errors=True)
    for path in sorted(ADDON.rglob("*")):
        if path.is_file() and path.suffix in KEPT and "__pycache__" not in path.parts:
            _copy(path, target / path.relative_to(ADDON))
    for path in sorted(needed(CORE / "runtime" / "__init__.py")):
        _copy(path, target / VENDOR / path.relative_to(ROOT))
    for name in ("LICENSE", "NOTICE"):
        _copy(ROOT / name, target / VENDOR / name)


def needed(start: Path) -> set[Path]:
    """Return the modules of the core that a module loads, itself and the packages around it included."""
    found, waiting = set(), [start]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [*_around(path), *_imported(path)]
    return found


def _around(path: Path) -> Iterator[Path]:
    for folder in path.parents:
        if folder == ROOT:
            return
        yield folder / "__init__.py"


def _imported(path: Path) -> Iterator[Path]:
    """Yield what a module imports at its top level; all imports within the core are relative."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
        modules = [base, *(base / alias.name for alias in node.names)]
        for candidate in (*(module.with_suffix(".py") for module in modules), base / "__init__.py"):
            if candidate.is_file():
                yield candidate


def _copy(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


if __name__ == "__main__":
    stage(Path(sys.argv[1]))
