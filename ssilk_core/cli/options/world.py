# SPDX-License-Identifier: Apache-2.0
"""What surrounds a character: colliders, wind and gravity."""

from __future__ import annotations

import argparse

from ...delivery.bake.world import GUSTS


def add_world(verb: argparse.ArgumentParser, of: str) -> None:
    """Add what surrounds the character; `of` says in which work cloth meets it."""
    about = (
        f"Cloth meets it {of}. A shot's prims with UsdPhysics.CollisionAPI, and its PhysicsScene's gravity and "
        "ssilk:wind, count without these options. Vectors are in the axes of the shot's stage."
    )
    world = verb.add_argument_group("what surrounds the character", about)
    world.add_argument("--collider", action="append", default=[], metavar="PRIM",
                       help="a mesh or solid that cloth meets, or a prim above some, by path or name "
                            "(repeatable)")  # fmt: skip
    world.add_argument("--wind", metavar="X,Y,Z", help="velocity of the air in the world [m/s] (default: the air "
                       "moves along with the character's root)")  # fmt: skip
    world.add_argument("--gusts", metavar=GUSTS, help="RMS speed of the wind's turbulence [m/s], size of its largest "
                       "eddies [m] (default 2) and seed (default 0)")  # fmt: skip
    world.add_argument("--gravity", metavar="X,Y,Z", help="acceleration [m/s2] (default: 9.81 down)")
