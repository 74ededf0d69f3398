# SPDX-License-Identifier: Apache-2.0
"""The code has the layers, and the public names, that docs/architecture.md promises."""

from __future__ import annotations

import ast
import importlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORE, USD, ADDON = ROOT / "ssilk_core", ROOT / "usd" / "ssilk_usd", ROOT / "blender_addon"
DOCUMENT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
JOIN_CORE_AND_USD = [("delivery", "bake"), ("cli",)]
LOOSE_MODULES = ["errors", "events", "files", "devices", "work_record"]
IN_PARTS = {"scene", "physics", "network", "authoring", "quality", "delivery"}  # the table names all their parts


def section(title: str) -> str:
    """Return the text of a section of the document."""
    return DOCUMENT.partition(f"## {title}\n")[2].partition("\n## ")[0]


def rows(title: str, without: str = "|||") -> list[list[str]]:
    """Return the names in backticks in the first column of a section's table, row by row, of rows without a text."""
    lines = [line for line in section(title).splitlines() if line.startswith("| `") and without not in line]
    return [re.findall(r"`([\w.]+)`", line.split("|")[1]) for line in lines]


def table(title: str) -> dict[str, list[str]]:
    """Return the names in backticks in the second column of a section's table, by the name in the first."""
    lines = [line.split("|") for line in section(title).splitlines() if line.startswith("| `")]
    return {cells[1].strip(" `"): re.findall(r"`(\w+)`", cells[2]) for cells in lines}


ROOMS = table("Rooms of the core")
ORDER = [*LOOSE_MODULES, *ROOMS, "__main__"]
USED_BY_USD = {name for row in rows("What ssilk_usd takes from the core") for name in row}
RUN_BY_USD = {name for row in rows("What ssilk_usd takes from the core", "for type checking alone") for name in row}
PUBLIC = [name for row in rows("Public packages") for name in row]


def modules(folder: Path) -> list[tuple[Path, tuple[str, ...]]]:
    """Return each module under a package's folder with the package that it is in."""
    return [(path, path.relative_to(folder.parent).parts[:-1]) for path in sorted(folder.rglob("*.py"))]


def executed(node: ast.AST, without: type[ast.AST] | tuple[()] = ()) -> Iterator[ast.AST]:
    """Yield all nodes except those under `if TYPE_CHECKING`, and in nodes of a kind."""
    waiting = [node]
    while waiting:
        yield (one := waiting.pop())
        if isinstance(one, ast.expr | ast.Import | ast.ImportFrom):  # which hold no statements
            continue
        for child in reversed(list(ast.iter_child_nodes(one))):
            if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
                continue
            if not isinstance(child, without):
                waiting.append(child)


def loaded(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run when a module is imported: no functions, nothing under `if TYPE_CHECKING`."""
    yield from executed(node, without=ast.FunctionDef)


def written(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements, wherever they are."""
    waiting = [node]
    while waiting:
        yield (one := waiting.pop())
        if not isinstance(one, ast.expr | ast.Import | ast.ImportFrom):
            waiting.extend(ast.iter_child_nodes(one))


Nodes = Callable[[ast.AST], Iterator[ast.AST]]


@cache
def parsed(code: str) -> ast.Module:
    """Return a module's code as a tree, which nobody changes; several tests look at each."""
    return ast.parse(code)


def imports(path: Path, package: tuple[str, ...], nodes: Nodes = executed) -> Iterator[tuple[str, ...]]:
    """Yield what a module imports, as dotted parts; `nodes` picks the code that counts, all that runs by default."""
    yield from _imports(path.read_text(encoding="utf-8"), package, nodes)


@cache
def _imports(code: str, package: tuple[str, ...], nodes: Nodes) -> tuple[tuple[str, ...], ...]:
    return tuple(_each_import(parsed(code), package, nodes))


def _each_import(code: ast.AST, package: tuple[str, ...], nodes: Nodes) -> Iterator[tuple[str, ...]]:
    for node in nodes(code):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            start = (*base, *(node.module.split(".") if node.module else ()))
            yield from ((*start, alias.name) for alias in node.names)


def public_classes(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the name of each public class at the top of a module under a folder, and the module's path."""
    for path, _ in modules(folder):
        for node in parsed(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield node.name, str(path.relative_to(ROOT))


def parts(folder: Path) -> set[str]:
    """Return the names of the modules and packages in a package's folder."""
    found = {path.name.removesuffix(".py") for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
    return found - {"__init__", "__pycache__", "models"}


def resolved(target: tuple[str, ...], home: Path) -> tuple[str, ...]:
    """Return the module of the package at `home` that an import of a name loads, as dotted parts."""
    for length in range(len(target), 0, -1):
        place = home.parent.joinpath(*target[:length])
        if place.with_suffix(".py").is_file():
            return target[:length]
        if place.is_dir():
            return (*target[:length], "__init__")
    raise AssertionError(target)


def graph(home: Path, nodes: Nodes = written) -> dict[str, set[str]]:
    """Return the modules of a package, and which others of it each imports, by default anywhere in its code."""
    found: dict[str, set[str]] = {}
    for path, package in modules(home):
        own = (*package, path.stem)
        targets = imports(path, package, nodes)
        names = {resolved(target, home) for target in targets if target[0] == home.name}
        found[".".join(own)] = {".".join(name) for name in names - {own}}
    return found


def between_folders(found: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return which folders and loose modules of a package import which others, from the graph of its modules."""
    joined: dict[str, set[str]] = defaultdict(set)
    for name, targets in found.items():
        own = name.split(".")[1]
        joined[own] |= {target.split(".")[1] for target in targets} - {own}
    return joined


def need_no_circle(found: dict[str, set[str]]) -> None:
    """Raise `CycleError`, which tells the circle, where one imports itself by way of others."""
    TopologicalSorter(found).prepare()


def test_the_core_has_the_rooms_and_parts_of_the_document():
    assert parts(CORE) == set(ORDER)
    assert len(ROOMS) <= 10 and len(LOOSE_MODULES) <= 5
    for room, named in ROOMS.items():
        present = parts(CORE / room)
        folders = {name for name in present if (CORE / room / name).is_dir()}
        assert set(named) <= present and folders <= set(named), room
        assert room not in IN_PARTS or set(named) == present, room


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_says_at_its_door_what_is_in_it(room):
    text = importlib.import_module(f"ssilk_core.{room}").__doc__ or ""
    assert 3 <= len(text.strip().splitlines()) <= 9
    opened = re.search(r"Open `([\w/.]+)` first", text)
    assert opened and (CORE / room / opened.group(1)).is_file()
    assert re.search(r"^Public: ", text, re.MULTILINE)


def test_the_core_imports_from_inner_rooms_and_parts_alone():
    for path, package in modules(CORE):
        own, *inner = path.relative_to(CORE).with_suffix("").parts
        joins = any((own, *inner)[: len(part)] == part for part in JOIN_CORE_AND_USD)
        named = ROOMS.get(own, [])
        for target in imports(path, package):
            found = f"{path}: {'.'.join(target)}"
            assert target[0] not in ("pxr", "bpy"), found
            assert target[0] != "ssilk_usd" or joins, found
            if target[0] != "ssilk_core" or target[1] == "__version__":
                continue
            if target[1] != own:
                assert own != "__init__" and ORDER.index(target[1]) < ORDER.index(own), found
            elif len(target) > 2 and inner[0] in named and target[2] in named:
                assert named.index(target[2]) <= named.index(inner[0]), found


@pytest.mark.parametrize("home", [CORE, USD, ADDON, ROOT / "benchmarks"], ids=lambda home: home.name)
def test_no_modules_import_each_other_in_a_circle(home):
    need_no_circle(graph(home))


@pytest.mark.parametrize("home", [CORE, USD, ADDON], ids=lambda home: home.name)
def test_no_folders_import_each_other_in_a_circle(home):
    """When they are loaded: a function may ask for a folder that needs its own, as drawing the preferences does."""
    need_no_circle(between_folders(graph(home, loaded)))


def circle(found: dict[str, set[str]]) -> set[str]:
    """Return the names of a circle; none where there is no circle."""
    try:
        need_no_circle(found)
    except CycleError as error:
        return set(error.args[1])
    return set()


def test_circles_of_modules_and_of_folders_are_found(tmp_path):
    package = tmp_path / "house"
    for name, code in (("a/x", "from ..b.y import one"), ("a/z", ""), ("b/y", "from ..a import z")):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / f"{name}.py").write_text(f"{code}\n")
    assert not circle(graph(package)) and circle(between_folders(graph(package))) == {"a", "b"}
    for head in ("if TYPE_CHECKING", "def f()"):
        (package / "b" / "y.py").write_text(f"{head}:\n    from ..a import x\n")
        assert circle(graph(package)) == {"house.a.x", "house.b.y"}
        assert not circle(between_folders(graph(package, loaded)))


def test_imports_within_the_core_are_relative():
    for path, _ in modules(CORE):
        for node in written(parsed(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                found = f"{path}: {ast.unparse(node)}"
                assert node.level or (node.module or "").split(".")[0] != "ssilk_core", found


def test_usd_needs_little_of_the_core():
    for path, package in modules(USD):
        for nodes, allowed in ((written, USED_BY_USD), (executed, RUN_BY_USD)):
            for target in imports(path, package, nodes):
                found = f"{path}: {'.'.join(target)}"
                assert target[0] not in ("torch", "bpy"), found
                assert target[0] != "ssilk_core" or allowed & {target[1], ".".join(target[1:3])}, found


def test_baking_needs_no_training():
    for path, package in modules(CORE / "delivery" / "bake"):
        targets = imports(path, ("ssilk_core", "delivery", *package))
        assert not [target for target in targets if target[:2] == ("ssilk_core", "training")], path


def test_no_public_class_name_is_used_twice():
    homes = defaultdict(list)
    for folder in (CORE, USD, ADDON, ROOT / "benchmarks", ROOT / "tools"):
        for name, home in public_classes(folder):
            homes[name].append(home)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


@pytest.mark.parametrize("package", PUBLIC)
def test_a_public_package_says_what_is_public(package):
    found = importlib.import_module(package)
    assert found.__all__
    assert all(hasattr(found, name) for name in found.__all__)


def test_one_path_leads_to_each_public_name():
    """No name is public in two packages, and nobody reaches past a package for what it makes public."""
    homes = Counter(name for package in PUBLIC for name in importlib.import_module(package).__all__)
    assert [name for name, count in homes.items() if count > 1] == []
    past = []
    for folder in (CORE, USD, ROOT / "benchmarks"):
        for path, package in modules(folder):
            for target in imports(path, package):
                home = next((public for public in PUBLIC if ".".join(target).startswith(f"{public}.")), None)
                if home is None or ".".join(package).startswith(home):
                    continue
                names = importlib.import_module(home).__all__
                if len(target) > len(home.split(".")) + 1 and target[-1] in names:
                    past.append((str(path.relative_to(ROOT)), ".".join(target)))
    assert past == []


def defined(path: Path) -> set[str]:
    """Return the names that a module has, by its code: where there is no Blender it cannot be imported."""
    return _defined(path.read_text(encoding="utf-8"))


@cache
def _defined(code: str) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(parsed(code)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found


def imported_in_vain(folder: Path) -> list[str]:
    """Return what modules under a package's folder import from a package of ours that does not have it."""
    homes = {home.name: home for home in (CORE, USD, folder)}
    vain = []
    for path, package in modules(folder):
        for target in imports(path, package):
            if target[0] not in homes or len(target) < 2:
                continue
            place = homes[target[0]].joinpath(*target[1:-1])
            if (place / target[-1]).is_dir() or (place / f"{target[-1]}.py").is_file():
                continue
            home = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
            if not home.is_file() or target[-1] not in defined(home):
                vain.append(f"{path.relative_to(folder.parent)}: {'.'.join(target)}")
    return vain


def test_the_extension_imports_nothing_that_is_not_there(tmp_path):
    assert imported_in_vain(ADDON) == []
    package = tmp_path / "extension"
    package.mkdir()
    (package / "garment.py").write_text("from .names import HERE\n")
    (package / "names.py").write_text("HERE = 1\n")
    code = "from . import garment\nfrom .garment import GONE, HERE\nfrom .lost import HERE\n"
    (package / "__init__.py").write_text(f"{code}from ssilk_core.errors import fail, gone\n")
    lost = ("extension.garment.GONE", "extension.lost.HERE", "ssilk_core.errors.gone")
    assert imported_in_vain(package) == [f"extension/__init__.py: {name}" for name in lost]


def test_imports_are_seen_through_relative_names_and_functions(tmp_path):
    code = "from ..errors import fail\nfrom . import sibling\ndef f():\n    import torch.nn\n"
    code += "if TYPE_CHECKING:\n    import pxr\n"
    (tmp_path / "module.py").write_text(code)
    found = set(imports(tmp_path / "module.py", ("ssilk_core", "view")))
    assert found == {
        ("ssilk_core", "errors", "fail"),
        ("ssilk_core", "view", "sibling"),
        ("torch", "nn"),
    }
