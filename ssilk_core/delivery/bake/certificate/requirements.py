# SPDX-License-Identifier: Apache-2.0
"""The libraries that certifying a bake needs."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from ....errors import fail
from ....physics.intersections.pairs import need_predicates

NEEDED = ("ipctk", "scipy")


def need_certifier() -> None:
    """Check that frames can be certified, before work that ends in it.

    Raises:
        SsilkError: a library is missing, or cannot be loaded.
    """
    need_predicates()
    allowed = "--certify moves cloth by continuous tests of ipctk"
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        fail("--certify", f"{', '.join(missing)} not installed", allowed, "pip install 'ssilk[certify]'")
    for name in NEEDED:
        try:
            import_module(name)
        except ImportError as error:  # such as a wheel of another machine
            fail("--certify", f"{name} cannot be loaded: {error}", allowed, "pip install --force-reinstall ipctk")
