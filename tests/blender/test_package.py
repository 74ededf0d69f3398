# SPDX-License-Identifier: Apache-2.0
"""The built zip: valid by Blender's own rules, installed in a private profile, enabled, disabled, enabled again."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from .conftest import ROOT
from .test_outside import write_wheel

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

ADDON = ROOT / "blender_addon"
GUIDE = (ROOT / "docs" / "artist_guide.md").read_text(encoding="utf-8")
INSTALL = """
import importlib, sys, bpy
package = "bl_ext.user_default.ssilk"
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
for _ in range(2):
    assert package in bpy.context.preferences.addons
    assert "paint_classes" in dir(bpy.ops.ssilk) and hasattr(bpy.types.Object, "ssilk")
    for name in ("ssilk_core.network.runtime", "ssilk_usd.units"):
        assert ".local" in importlib.import_module(name).__file__  # where Blender puts wheels
    bpy.ops.preferences.addon_disable(module=package)
    assert not dir(bpy.ops.ssilk) and not hasattr(bpy.types.Object, "ssilk")
    bpy.ops.preferences.addon_enable(module=package)
settings = bpy.context.preferences.addons[package].preferences
assert not bpy.ops.ssilk.create_environment.poll()
bpy.context.preferences.system.use_online_access = True
try:
    bpy.ops.ssilk.create_environment()
except RuntimeError as error:
    print("TOLD", str(error).strip())
print("PYTHON", settings.python)
"""


def command_line(*arguments: str) -> str:
    """Run the tool that Blender has for extensions."""
    import addon_utils

    tool = Path(addon_utils.__file__).parents[1] / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    done = subprocess.run([sys.executable, str(tool), *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip as `make extension` packs it, but with a wheel that has no dependencies: nothing is downloaded."""
    folder = tmp_path_factory.mktemp("package")
    stage = [sys.executable, str(ROOT / "tools" / "stage_extension.py"), str(folder / "staged")]
    subprocess.run([*stage, str(write_wheel(folder))], check=True)
    command_line("build", "--source-dir", str(folder / "staged"), "--output-filepath", str(folder / "ssilk.zip"))
    return folder / "ssilk.zip"


def test_the_zip_is_valid_and_holds_what_it_needs(package):
    assert "Success" in command_line("validate", str(package))
    with zipfile.ZipFile(package) as files:
        names = set(files.namelist())
    sources = {str(path.relative_to(ADDON)) for path in ADDON.rglob("*.py")}
    pictures = {name for name in names if name.startswith("guide/images/")}
    assert len(pictures) == GUIDE.count("](images/") and "guide/index.html" in names
    sources |= {*pictures, "guide/index.html"}
    assert names == {*sources, "LICENSE", "blender_manifest.toml", "wheels/ssilk-0.1.9-py3-none-any.whl"}


def test_the_wheel_for_blender_is_built_without_the_demos_models(tmp_path):
    sys.path.insert(0, str(ROOT / "tools"))
    from stage_extension import copy_project, stamp_version

    copy_project(tmp_path)
    for folder in ("ssilk_core", "usd/ssilk_usd"):
        own = {path.relative_to(ROOT) for path in (ROOT / folder).rglob("*.py")}
        assert {path.relative_to(tmp_path) for path in (tmp_path / folder).rglob("*.py")} == own
    assert not list(tmp_path.rglob("*.safetensors")) and (tmp_path / "NOTICE").is_file()
    stamp_version(tmp_path)
    version, own = (
        tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"] for root in (tmp_path, ROOT)
    )
    assert re.fullmatch(rf"{re.escape(own)}\+src\.[0-9a-f]{{8}}", version)  # or Blender would keep an older wheel


def test_the_manifest_says_what_the_code_says():
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert manifest["version"] == project["version"]
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    (holder,) = manifest["copyright"]
    assert re.fullmatch(rf"20\d\d {manifest['maintainer']}", holder)
    assert manifest["blender_version_min"] == "4.2.0"
    for path in ADDON.rglob("*.py"):
        assert path.read_text().startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n"), path


def test_the_zip_is_installed_and_makes_an_environment(package, tmp_path):
    """In a profile of its own, from the wheel that the zip holds."""
    program = tmp_path / "install.py"
    program.write_text(INSTALL)
    profile = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "profile")}
    profile.pop("PYTHONPATH", None)  # it may name the repository, which would come before the wheel
    command = [sys.executable, str(program), str(package)]
    done = subprocess.run(command, capture_output=True, text=True, env=profile, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = dict(line.split(" ", 1) for line in done.stdout.splitlines() if line.startswith(("TOLD ", "PYTHON ")))
    assert "has ssilk but not usd-core" in lines["TOLD"]
    assert Path(lines["PYTHON"]).is_relative_to(tmp_path / "profile")
