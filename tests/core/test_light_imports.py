# SPDX-License-Identifier: Apache-2.0
"""What importing costs, and which package may import which (docs/architecture.md)."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

HEAVY = ("torch", "pxr", "igl", "scipy", "trimesh", "PIL", "embreex", "imageio_ffmpeg", "anny", "bpy", "triton")
ROOT = Path(__file__).parents[2]
CORE, USD = ROOT / "ssilk_core", ROOT / "usd" / "ssilk_usd"

# From the inside out: a module imports its own layer or those before it.
LAYERS = (
    {"errors"},
    {"schemes"},
    {"assets", "config", "devices", "fabrics", "events", "files", "packing", "tensors"},
    {"mesh", "kinematics", "kernels", "descriptors", "parameters", "sampling", "targets"},
    {"model", "energy"},
    {"checkpoint"},
    {"demo", "view", "simulate", "training", "rollout", "preflight", "setup", "wardrobe", "runtime", "farm"},
    {"cost", "reduction", "refine"},
    {"evaluation", "quality", "stress"},
    {"trade", "report"},
    {"cli"},
    {"__main__"},
)
OF_CORE_IN_USD = {"errors", "assets", "events", "files", "kinematics"}


def run_with_arguments(*arguments: str) -> str:
    return f"import sys, runpy; sys.argv[1:] = {list(arguments)}; runpy.run_module('ssilk_core', run_name='__main__')"


@pytest.mark.parametrize(
    "code",
    ["import ssilk_core", run_with_arguments("--help"), run_with_arguments("train", "--help")],
    ids=["import", "help", "train-help"],
)
def test_nothing_heavy_is_loaded(code):
    monitor = (
        f"import atexit, sys; atexit.register(lambda: print(set({HEAVY}) & sys.modules.keys(), file=sys.stderr))"
    )
    done = subprocess.run([sys.executable, "-c", f"{monitor}\n{code}"], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "set()"
    assert ("usage: ssilk" in done.stdout) == ("help" in code)


def imports(path: Path, package: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield what a module of `package` imports, wherever in its code, as dotted parts; not what only types need."""
    for node in running(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            start = (*base, *(node.module.split(".") if node.module else ()))
            yield from ((*start, alias.name) for alias in node.names)


def running(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes but those under `if TYPE_CHECKING`."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from running(child)


def modules(folder: Path) -> list[tuple[Path, tuple[str, ...]]]:
    """Each module under a package's folder, with the package that it is in."""
    return [(path, path.relative_to(folder.parent).parts[:-1]) for path in sorted(folder.rglob("*.py"))]


def layer(part: str) -> int:
    return next(number for number, names in enumerate(LAYERS) if part in names)


@pytest.mark.parametrize(("path", "package"), modules(CORE), ids=lambda value: getattr(value, "stem", None))
def test_the_core_points_inward(path, package):
    own = path.relative_to(CORE).parts[0].removesuffix(".py")
    for target in imports(path, package):
        assert target[0] not in ("pxr", "bpy"), target
        assert target[0] != "ssilk_usd" or own == "cli", target
        if target[0] == "ssilk_core" and target[1] != "__version__":
            assert layer(target[1]) <= layer(own), target


@pytest.mark.parametrize("verb", ["_baking", "bake", "verify"])
def test_baking_needs_no_training(verb):
    targets = imports(CORE / "cli" / f"{verb}.py", ("ssilk_core", "cli"))
    assert not [target for target in targets if target[:2] == ("ssilk_core", "training")]


@pytest.mark.parametrize(("path", "package"), modules(USD), ids=lambda value: getattr(value, "stem", None))
def test_usd_needs_little_of_the_core(path, package):
    for target in imports(path, package):
        assert target[0] not in ("torch", "bpy"), target
        assert target[0] != "ssilk_core" or target[1] in OF_CORE_IN_USD, target


def test_imports_are_seen_through_relative_names_and_functions(tmp_path):
    code = "from ..errors import need\nfrom . import sibling\ndef f():\n    import torch.nn\n"
    code += "if TYPE_CHECKING:\n    import pxr\n"
    (tmp_path / "module.py").write_text(code)
    found = set(imports(tmp_path / "module.py", ("ssilk_core", "view")))
    assert found == {
        ("ssilk_core", "errors", "need"),
        ("ssilk_core", "view", "sibling"),
        ("torch", "nn"),
    }
