# SPDX-License-Identifier: Apache-2.0
"""Importing stays light."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "pxr", "igl", "scipy", "trimesh", "PIL", "embreex", "imageio_ffmpeg", "anny", "bpy", "triton",
         "matplotlib", "numba")  # fmt: skip


def run_with_arguments(*arguments: str) -> str:
    return f"import sys, runpy; sys.argv[1:] = {list(arguments)}; runpy.run_module('ssilk_core', run_name='__main__')"


# Blender, a command's help or `ssilk inspect` loads these; other modules of their rooms may load what they need.
LIGHT = ("physics.constants", "physics.skin.hidden_faces", "training.settings", "training.prediction",
         "network.runtime", "quality.levels", "delivery.gltf.skinned", "delivery.live.messages",
         "authoring.preflight.inspection", "training.memory", "physics.reach")  # fmt: skip


@pytest.mark.parametrize(
    "code",
    [
        "import ssilk_core",
        "; ".join(f"import ssilk_core.{name}" for name in LIGHT),
        run_with_arguments("--help"),
        run_with_arguments("train", "--help"),
    ],
    ids=["import", "light", "help", "train-help"],
)
def test_nothing_heavy_is_loaded(code):
    monitor = (
        f"import atexit, sys; atexit.register(lambda: print(set({HEAVY}) & sys.modules.keys(), file=sys.stderr))"
    )
    done = subprocess.run([sys.executable, "-c", f"{monitor}\n{code}"], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "set()"
    assert ("usage: ssilk" in done.stdout) == ("help" in code)
