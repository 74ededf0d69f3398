# SPDX-License-Identifier: Apache-2.0
"""Layers that are opened, looked at, written and closed leave nothing in memory."""

from __future__ import annotations

import ctypes
import sys

import pytest
from ssilk_usd.opening.specs import free_when_closed
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.export import new_stage, save

PRIMS, TIMES = 40, 100


class MallocInfo(ctypes.Structure):
    """What glibc's mallinfo2 returns."""

    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    ]  # fmt: skip


def used() -> int:
    """Return the bytes that are allocated at the moment."""
    free_when_closed([])
    library = ctypes.CDLL(None)
    library.mallinfo2.restype = MallocInfo
    return int(library.mallinfo2().uordblks)


def write(path):
    """Write a layer of some prims, each of which is looked at."""
    stage = new_stage(path, StageUnits())
    for number in range(PRIMS):
        stage.DefinePrim(f"/P{number}")
    save(stage.GetRootLayer(), path)


def read(path):
    """Read a stage, and the specs of each prim as USD's validators do."""
    stage = open_stage(path)
    assert sum(len(prim.GetPrimStack()) for prim in stage.Traverse()) == PRIMS


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc counts what is allocated")
@pytest.mark.parametrize("use", [write, read])
def test_layers_that_were_closed_take_no_memory(use, tmp_path):
    path = tmp_path / "layer.usda"
    write(path)
    for _ in range(TIMES):
        use(path)
    kept = []
    for _ in range(3):
        before = used()
        for _ in range(TIMES):
            use(path)
        kept.append((used() - before) / TIMES)
    # USD alone keeps 32 bytes of each of 40 prims, each time; tables of tokens and paths grow now and then.
    assert min(kept) < PRIMS * 32 / 4
