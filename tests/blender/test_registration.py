# SPDX-License-Identifier: Apache-2.0
"""Enabling and disabling leaves nothing behind."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

import addon_utils

from .conftest import ROOT


def footprint(bpy) -> set[str]:
    """Everything that an extension may leave in Blender: classes, operators, properties, handlers, timers."""
    found = {f"type {name}" for name in dir(bpy.types)}
    found |= {f"operator ssilk.{name}" for name in dir(bpy.ops.ssilk)}
    found |= {f"object.{name}" for name in dir(bpy.types.Object)}
    for name in dir(bpy.app.handlers):
        handlers = getattr(bpy.app.handlers, name)
        found |= {f"{name} {handler}" for handler in handlers} if isinstance(handlers, list) else set()
    return found


def test_nothing_is_left_after_disabling(bpy):
    enabled = footprint(bpy)
    addon_utils.disable("blender_addon")
    clean = footprint(bpy)
    own = {name for name in enabled - clean if name.startswith("operator")}
    assert {"operator ssilk.paint_classes", "operator ssilk.generate_rig", "operator ssilk.cancel"} <= own
    for _ in range(2):
        addon_utils.enable("blender_addon")
        assert footprint(bpy) == enabled
        addon_utils.disable("blender_addon")
        assert footprint(bpy) == clean


def test_disabling_stops_what_runs_outside(bpy, tmp_path):
    from blender_addon.operators import tasks
    from blender_addon.outside.work import Work

    program = [sys.executable, "-c", "import time; time.sleep(60)"]
    tasks.current = Work("Waiting", lambda _: [program], parent=str(tmp_path))
    process = tasks.current._process
    addon_utils.disable("blender_addon")
    assert not process.running
    assert tasks.current is None
    assert not list(tmp_path.iterdir())


def test_everything_explains_itself(bpy):
    from blender_addon.registration import CLASSES

    for kind in CLASSES:
        if issubclass(kind, bpy.types.Operator):
            assert kind.bl_idname.startswith("ssilk.")
            assert kind.__doc__
        own = getattr(kind.bl_rna, "properties", ())
        for prop in (prop for prop in own if prop.identifier in kind.__annotations__):
            assert prop.description or prop.type == "ENUM", (kind, prop.identifier)


def test_enabling_needs_no_usd():
    """Blender builds without USD can still play garments; elsewhere importing it takes time."""
    program = (
        f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / 'usd')!r}]; import bpy, addon_utils; "
        "assert addon_utils.enable('blender_addon', default_set=True); "
        "print(sorted({'pxr', 'torch'} & {*sys.modules}), flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["[]"], done.stderr  # bpy 4.2 crashes when it exits
