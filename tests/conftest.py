# SPDX-License-Identifier: Apache-2.0
"""What holds for every test."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest: one that began last would leave the other processes without work."""
    items.sort(key=lambda item: "end_to_end" not in item.path.parts)


def pytest_configure() -> None:
    """Look for nothing that can be freed while tests are collected: what is loaded stays."""
    gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def _one_thread() -> None:
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Compute fixtures of modules with one thread, too: with more, workers wait for cores of each other."""
    _one_thread()


@pytest.fixture(autouse=True)
def one_thread_again() -> None:
    """Compute a test with one thread, whatever a benchmark set before it."""
    _one_thread()


@pytest.fixture(scope="session", autouse=True)
def quiet_machine() -> Iterator[None]:
    """No other program is seen, whose warnings would come between those that a test expects."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.getloadavg", lambda: (0.0, 0.0, 0.0), raising=False)
        yield


@pytest.fixture(scope="module")
def few_contacts() -> Iterator[None]:
    """Cloth touches the body at vertices and at few points between, where contact itself is not what is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ssilk_core.physics.samples.MAX_SPACING", 0.1)
        yield
