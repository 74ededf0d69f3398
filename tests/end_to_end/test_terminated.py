# SPDX-License-Identifier: Apache-2.0
"""A command that is terminated stops as on Ctrl-C, and leaves nothing half written."""

from __future__ import annotations

import signal
import subprocess
import sys

from ssilk_core.cli import main

# The signal comes when a file has its contents and not yet its name.
TERMINATED = """
import os, signal, sys
from ssilk_core.cli import main

flush = os.fsync

def cut(handle):
    os.kill(os.getpid(), signal.SIGTERM)
    flush(handle)

os.fsync = cut
sys.exit(main(sys.argv[1:]))
"""


def test_a_command_that_is_terminated_leaves_nothing_half_written(toy, tmp_path):
    before = sorted(path.name for path in toy.copy(tmp_path).iterdir())
    command = [sys.executable, "-c", TERMINATED, "rig", "hero.usda", "--garment", "/Hero/Skirt", "-o", "own.usda"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "interrupted; nothing half written was left behind" in done.stderr
    assert done.returncode == 130 and sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_program_that_runs_a_command_keeps_its_own_ways(capsys):
    def own(number: int, frame: object) -> None: ...

    before = signal.getsignal(signal.SIGTERM)
    try:
        for handler in (signal.SIG_DFL, own):
            signal.signal(signal.SIGTERM, handler)
            assert main(["verify", "none.usda"]) == 2 and signal.getsignal(signal.SIGTERM) == handler
    finally:
        signal.signal(signal.SIGTERM, before)
