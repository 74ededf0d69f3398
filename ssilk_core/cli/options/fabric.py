# SPDX-License-Identifier: Apache-2.0
"""Which fabric a garment is of."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ...events import Message, Reporter
from ...network.settings import apply_overrides, setting_names
from ...scene.fabric_range import FACTORS
from ...scene.fabrics import FABRICS, Fabric, fabric_named, fabric_of_surface, stiffness_words, surface_message

if TYPE_CHECKING:
    from ...scene.assets import Garment, SurfaceMaterial


class _Property(argparse.Action):
    """Keeps each NAME=VALUE of an option; refuses a second value of one name."""

    def __call__(self, parser: object, namespace: object, values: object, option_string: str | None = None) -> None:
        """Keep one more."""
        kept, name = getattr(namespace, self.dest), str(values).partition("=")[0]
        if other := next((each for each in kept if each.partition("=")[0] == name), None):
            raise argparse.ArgumentError(self, f"'{other}' and '{values}' are two values of '{name}'; give one")
        setattr(namespace, self.dest, [*kept, values])


def add_fabric(verb: argparse.ArgumentParser) -> None:
    """Add the options of the fabric."""
    verb.add_argument(
        "--fabric",
        choices=FABRICS,
        help="material (default: that of the garment's physics material, or 'default'); 'paper' has the paper's "
        "contact",
    )
    verb.add_argument(
        "--material",
        action=_Property,
        default=[],
        metavar="NAME=VALUE",
        help=f"change a property of the fabric (repeatable): {', '.join(setting_names(Fabric))}",
    )


def add_known_fabric(verb: argparse.ArgumentParser) -> None:
    """Add the options of the fabric that a trained garment is of."""
    verb.add_argument(
        "--fabric",
        choices=FABRICS,
        help="preset that the garment is of, where its model was trained with --fabrics (default: the fabric of its "
        "training)",
    )
    verb.add_argument(
        "--material",
        action=_Property,
        default=[],
        metavar="NAME=VALUE",
        help="change a property of that fabric (repeatable): density=0.3 in its unit, or bending=2x for twice that "
        f"of the training's fabric; factors are {', '.join(FACTORS)}. A bake with --feedback or --quality hero takes "
        "friction=0.4 of any model",
    )


def asked_known_fabric(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the options of `add_known_fabric` say by their names, without those that say nothing."""
    asked = {"fabric": options.fabric, "material": options.material}
    return {name: value for name, value in asked.items() if value}


def asked_fabric(options: argparse.Namespace) -> Fabric:
    """Return the fabric that the options alone ask for; raise `SsilkError` for an unknown property or a bad value."""
    return apply_overrides(fabric_named(options.fabric or "default"), options.material, "--material")


def garment_fabric(options: argparse.Namespace, garment: Garment, report: Reporter) -> Fabric:
    """Return the fabric of a garment: what the options name, else its stage's, else the default.

    Properties that the options set go before those of its stage.

    Raises:
        SsilkError: an unknown property, a bad value, or a fabric without stitches for islands that these alone hold.
    """
    from ...authoring.setup.hosts import need_stitch

    if options.fabric or garment.surface is None:
        found = asked_fabric(options)
    else:
        found = apply_overrides(stated_fabric(garment.surface, report), options.material, "--material")
    if garment.classes is not None:
        need_stitch(garment.mesh, garment.classes, found)
    if garment.mesh.stiffness is not None:
        report(Message(f"{garment.mesh.path}: {stiffness_words(garment.mesh)}"))
    return found


def stated_fabric(surface: SurfaceMaterial, report: Reporter) -> Fabric:
    """Return the fabric of a stage's physics material, and tell it."""
    stated = fabric_of_surface(surface)
    report(Message(f"{surface.path}: {surface_message(surface, stated)}"))
    return stated
