# SPDX-License-Identifier: GPL-3.0-or-later
"""Print as one line of JSON which versions and device a Python has. Run by that Python: `python probe.py`."""

import importlib.metadata
import json
import platform
import sys


def version(name):
    """Return the version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def device():
    """Return the name of the device that ssilk would train on, or None without PyTorch."""
    try:
        from ssilk_core.devices import device_name, select_device

        return device_name(select_device("auto"))
    except ImportError:
        return None


if __name__ == "__main__":
    names = ("ssilk", "torch", "usd-core", "libigl", "scipy", "ipctk")
    versions = {"python": platform.python_version(), **{name: version(name) for name in names}}
    print(json.dumps({"event": "result", "task": "probe", "detail": {"versions": versions, "device": device()}}))
    sys.stdout.flush()
