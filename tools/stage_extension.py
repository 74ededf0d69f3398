# SPDX-License-Identifier: Apache-2.0
"""Put the Blender extension together in a folder: its own sources, and ssilk itself as a wheel.

    python tools/stage_extension.py build/extension [WHEEL]

Blender puts the wheels that the manifest lists on its path, so that the extension imports `ssilk_core` and
`ssilk_usd` by their names. "Create Environment" installs the same wheel. It is built here unless one is given. The
demo's trained models (16 MB) stay behind: nothing in Blender uses them.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from guide_page import page

ROOT = Path(__file__).parents[1]
ADDON, MANIFEST, WHEELS = ROOT / "blender_addon", "blender_manifest.toml", "wheels"
PROJECT = ("pyproject.toml", "README.md", "LICENSE", "NOTICE", "ssilk_core", "usd/ssilk_usd")
GUIDE = "docs/artist_guide.md"
JUNK = shutil.ignore_patterns("__pycache__", ".*")
NOT_IN_BLENDER = ("ssilk_core/demo/models",)


def stage(target: Path, wheel: Path | None = None) -> None:
    """Write the extension into a folder, in place of what was there."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(ADDON, target, ignore=JUNK)
    write_guide(target / "guide")
    wheels = target / WHEELS
    wheels.mkdir()
    if wheel is None:
        build_wheel(wheels)
    else:
        shutil.copy(wheel, wheels)
    listed = ", ".join(f'"./{WHEELS}/{path.name}"' for path in sorted(wheels.iterdir()))
    manifest = target / MANIFEST
    own, table, rest = manifest.read_text(encoding="utf-8").partition("\n[permissions]\n")
    if not table:
        raise SystemExit(f"{manifest}: no table [permissions]; the list of wheels goes before it.")
    manifest.write_text(f"{own}wheels = [{listed}]\n{table}{rest}", encoding="utf-8")


def write_guide(folder: Path) -> None:
    """Write the artist guide as a page with its pictures."""
    text = (ROOT / GUIDE).read_text(encoding="utf-8")
    (folder / "images").mkdir(parents=True)
    (folder / "index.html").write_text(page(text), encoding="utf-8")
    for name in re.findall(r"\(images/([^)]+)\)", text):
        shutil.copy(ROOT / "docs" / "images" / name, folder / "images")


def build_wheel(folder: Path) -> None:
    """Build ssilk's wheel from a copy of its sources without what Blender has no use for."""
    with tempfile.TemporaryDirectory() as temporary:
        copy_project(Path(temporary))
        stamp_version(Path(temporary))
        pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder)]
        subprocess.run([*pip, temporary], check=True)


def copy_project(target: Path) -> None:
    """Copy what a wheel of ssilk for Blender is built from."""
    for name in PROJECT:
        source = ROOT / name
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=JUNK)
        else:
            shutil.copy(source, target / name)
    for name in NOT_IN_BLENDER:
        shutil.rmtree(target / name)


def stamp_version(project: Path) -> None:
    """Add a hash of its sources to a project's version: Blender keeps an installed wheel of the same version."""
    digest, settings = hashlib.sha256(), project / "pyproject.toml"
    for path in sorted(path for path in project.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(project)).encode() + path.read_bytes())
    text = settings.read_text(encoding="utf-8")
    stamped = re.sub(
        r'^version = "(.+)"$', rf'version = "\1+src.{digest.hexdigest()[:8]}"', text, count=1, flags=re.M
    )
    settings.write_text(stamped, encoding="utf-8")


if __name__ == "__main__":
    stage(*map(Path, sys.argv[1:3]))
