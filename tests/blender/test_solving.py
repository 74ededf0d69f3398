# SPDX-License-Identifier: GPL-3.0-or-later
"""Live playback of solved frames: what Blender shows is what a bake at that level shows, and the process ends."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback import playing

from .scenes import shown
from .test_panels import drawn

EXACT = 2e-5  # [m]
FRAMES = range(1, 41)
PATIENCE = 60  # seconds


@pytest.fixture
def wanted(ready, trained, folder) -> np.ndarray:
    """What Blender shows of a bake at the level, over the same frames."""
    path = folder / "solved.npy"
    if not path.exists():
        assert ready.ops.ssilk.bake(quality="latent") == {"FINISHED"}
        np.save(path, shown(ready, trained, FRAMES))
        assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    return np.load(path)


def ended(pid: int) -> bool:
    """Wait for a process to end; return whether it has."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def play(bpy, garment):
    garment.ssilk.live_quality = "latent"
    assert bpy.ops.ssilk.play_live() == {"FINISHED"}
    return playing.live(garment)


def test_every_frame_shows_what_a_bake_at_this_level_shows(ready, trained, wanted):
    live = play(ready, trained)
    assert live.solving.complete and live.solved == len(FRAMES) and not live.wrong
    found = shown(ready, trained, FRAMES)
    assert np.abs(found - wanted).max() < EXACT
    trained.ssilk.live_quality = "NETWORK"
    assert live.solving is None
    network = shown(ready, trained, FRAMES)
    assert np.abs(network - wanted).max() > 100 * EXACT
    trained.ssilk.live_quality = "latent"
    assert np.abs(shown(ready, trained, reversed(FRAMES))[::-1] - wanted).max() < EXACT
