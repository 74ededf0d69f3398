# SPDX-License-Identifier: Apache-2.0
"""No module of the extension or of `ssilk_usd` imports itself by way of others, and no package does."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = (ROOT / "blender_addon", ROOT / "usd" / "ssilk_usd")


def imports(folder: Path) -> dict[str, set[str]]:
    """Return the modules that each module under a package's folder imports at its top, by relative imports."""
    homes = {}
    for path in folder.rglob("*.py"):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        homes[".".join(parts[:-1] if path.stem == "__init__" else parts)] = path
    found: dict[str, set[str]] = {name: set() for name in homes}
    for name, path in homes.items():
        package = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.level:
                start = [*package[: len(package) + 1 - node.level], *(node.module or "").split(".")]
                module = ".".join(filter(None, start))
                found[name] |= {f"{module}.{each.name}" for each in node.names} & set(homes) or {module}
    return found


def package_of(module: str) -> str:
    """Return the package at the door that a module is in; a loose module is its own."""
    return ".".join(module.split(".")[:2])


def by_package(found: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return which packages at the door import which others."""
    joined: dict[str, set[str]] = {}
    for name, targets in found.items():
        joined.setdefault(package_of(name), set()).update({*map(package_of, targets)} - {package_of(name)})
    return joined


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_there_is_no_import_circle(folder):
    found = imports(folder)
    TopologicalSorter(found).prepare()
    TopologicalSorter(by_package(found)).prepare()


def test_circles_of_modules_and_of_packages_are_seen(tmp_path):
    package = tmp_path / "house"
    for name, text in (("a/x", "from ..b.y import one"), ("a/z", ""), ("b/y", "from ..a import z")):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / f"{name}.py").write_text(f"{text}\n")
    found = imports(package)
    TopologicalSorter(found).prepare()
    with pytest.raises(CycleError):
        TopologicalSorter(by_package(found)).prepare()
    (package / "a" / "z.py").write_text("from .x import one\n")
    with pytest.raises(CycleError):
        TopologicalSorter(imports(package)).prepare()
