# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that has ssilk installed: where it may be, whether it fits, and how to make one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from ssilk_core import __version__

NEEDED = tuple(map(int, __version__.split(".")[:2]))  # of ssilk: major and minor version
REQUIRED = ("usd-core", "libigl", "scipy")  # what classes and rigs need beside ssilk itself
EXTRAS = "train,bake"
PROBE = Path(__file__).with_name("probe.py")
WHEELS = Path(__file__).parents[1] / "wheels"  # of the zip: ssilk itself, as `make extension` packs it
VENV_NAMES = (".venv", "venv", "env", ".env")


@dataclass(frozen=True)
class Handshake:
    """What a Python said of itself: versions by distribution (None where missing), and its device."""

    python: str
    versions: Mapping[str, str | None]
    device: str | None

    @classmethod
    def of(cls, python: str, detail: Mapping[str, object]) -> Handshake:
        """Read the result of `probe.py`."""
        versions = detail.get("versions")
        device = detail.get("device")
        return cls(python, versions if isinstance(versions, dict) else {}, str(device) if device else None)

    @property
    def mismatch(self) -> str:
        """One sentence that says why it does not fit; empty if it does."""
        wanted, found = ".".join(map(str, NEEDED)), self.versions.get("ssilk")
        if not found:
            return f"{self.python} has no ssilk; install it there, or choose a Python that has it."
        if _major_minor(found) != NEEDED:
            return f"{self.python} has ssilk {found}, and this extension needs {wanted}; update the older of the two."
        missing = [name for name in REQUIRED if not self.versions.get(name)]
        if missing:
            return f"{self.python} has ssilk but not {', '.join(missing)}; install ssilk[{EXTRAS}] there."
        return ""

    @property
    def no_certificates(self) -> str:
        """One sentence that says what bakes with a certificate lack; empty if nothing."""
        if self.versions.get("ipctk"):
            return ""
        return f"To certify bakes, install ssilk[certify] in {self.python}, then check it again in the preferences"

    @property
    def summary(self) -> str:
        """Versions and device in one line."""
        shown = [f"{name} {self.versions[name]}" for name in ("ssilk", "python", "torch") if self.versions.get(name)]
        return ", ".join([*shown, self.device or "no PyTorch: nothing can be trained"])


def _major_minor(version: str) -> tuple[int, ...]:
    parts = version.split(".")[:2]
    return tuple(int(part) if part.isdigit() else -1 for part in parts)


def probe_command(python: str) -> list[str]:
    """Return the command by which a Python says what it has."""
    return [python, str(PROBE)]


def venv_commands(base: str, folder: Path, source: str) -> list[list[str]]:
    """Return the commands that make a virtual environment and install ssilk in it.

    Args:
        base: the Python to make it with.
        folder: where it goes.
        source: a wheel of ssilk, or the folder of its project.
    """
    python = str(venv_python(folder))
    pip = [python, "-m", "pip", "install", "--no-input", "--disable-pip-version-check", "--progress-bar", "off"]
    return [[base, "-m", "venv", "--clear", str(folder)], [*pip, f"{source}[{EXTRAS}]"]]


def bundled(folder: Path = WHEELS) -> str:
    """Return the wheel of ssilk that came with the extension, empty where it came without."""
    return next((str(wheel) for wheel in sorted(folder.glob("ssilk-*.whl"))), "")


def venv_python(folder: Path) -> Path:
    """Return where the interpreter of a virtual environment stands."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def find(places: Iterable[Path]) -> list[str]:
    """Return the Pythons that have ssilk installed, most likely first, by looking at files alone.

    Args:
        places: folders (such as the blend file's or an extension's own) that may be or hold a virtual environment.
    """
    candidates = (*_on_path(), *_environments(places))
    return list(dict.fromkeys(str(python) for python in candidates if _has_ssilk(python)))


def _on_path() -> Iterator[Path]:
    """Yield the Python that a command `ssilk` names as its own, then the Pythons on PATH."""
    script = shutil.which("ssilk")
    if script:
        yield from (Path(script).with_name(name) for name in ("python", "python3", "python.exe"))
        yield from _shebang(Path(script))
    for name in ("python3", "python"):
        found = shutil.which(name)
        if found:
            yield Path(found)


def _shebang(script: Path) -> Iterator[Path]:
    """Yield the interpreter in a script's first line."""
    with script.open("rb") as stream:
        first = stream.readline(4096)
    if first.startswith(b"#!"):
        yield Path(os.fsdecode(first[2:].strip()))


def _environments(places: Iterable[Path]) -> Iterator[Path]:
    active = (Path(os.environ[name]) for name in ("VIRTUAL_ENV", "CONDA_PREFIX") if os.environ.get(name))
    known = [Path.home() / folder for folder in (".virtualenvs", "miniconda3/envs", "anaconda3/envs")]
    inside = (child for folder in known if folder.is_dir() for child in sorted(folder.iterdir()))
    for place in (*active, *places, *inside):
        for folder in (place, *(place / name for name in VENV_NAMES)):
            yield venv_python(folder)


def _has_ssilk(python: Path) -> bool:
    """Return whether the environment of an interpreter holds the distribution, without running it."""
    if not python.is_file():
        return False
    top = python.parent.parent
    libraries = [top / "Lib", *sorted((top / "lib").glob("python3*"))]
    return any(True for library in libraries for _ in (library / "site-packages").glob("ssilk-*.dist-info"))
