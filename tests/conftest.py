# SPDX-License-Identifier: Apache-2.0
"""What holds for every test."""

from __future__ import annotations

import sys

import pytest


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Compute with one thread, whatever a benchmark set before: with more, workers wait for cores of each other."""
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
