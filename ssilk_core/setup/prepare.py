# SPDX-License-Identifier: Apache-2.0
"""From a character and a garment as they were authored to a scene that can be trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import events
from ..assets import CLASS_NAMES, LOOSE, Character, Garment, Ints, ProxyRig, Scene
from .classes import ClassOptions, classify
from .rig import RigOptions, build_rig
from .weights import WeightOptions, transfer_weights


def prepare_scene(
    character: Character,
    garment: Garment,
    rig: ProxyRig | None = None,
    *,
    weight_options: WeightOptions | None = None,
    class_options: ClassOptions | None = None,
    rig_options: RigOptions | None = None,
    report: events.Reporter = events.silent,
) -> Scene:
    """Fill in the weights, classes and proxies that a garment lacks; what is authored stays as it is.

    Args:
        garment: fitted to the character's bind pose, with or without weights and classes.
        rig: proxies that were authored for it, or None.
        report: told about everything that had to be assumed.

    Raises:
        SsilkError: an island of the garment is held nowhere, or what was authored does not fit together.
    """
    classes = garment.classes
    if classes is None:
        classes = _find_classes(character, garment, class_options, report)
    skin = garment.skin
    if skin is None:
        report(events.Message(f"{garment.mesh.path}: no skinning weights, taken from the body"))
        skin = transfer_weights(character, garment.mesh, classes=classes, options=weight_options)
    garment = replace(garment, skin=skin, classes=classes)
    if rig is None:
        rig = build_rig(character, garment, rig_options, report=report)
        report(events.Message(_describe_rig(rig, bool(np.any(classes == LOOSE)))))
    return Scene(character, garment, rig)


def _find_classes(
    character: Character, garment: Garment, options: ClassOptions | None, report: events.Reporter
) -> Ints:
    """Classify by authored weights, or by unsmoothed ones from the body: they jump where limbs part."""
    unsmoothed = WeightOptions(tight_rounds=0, loose_rounds=0)
    skin = garment.skin or transfer_weights(character, garment.mesh, options=unsmoothed)
    classes = classify(character, garment.mesh, skin, options)
    shares = ", ".join(f"{np.mean(classes == value):.0%} {name}" for value, name in enumerate(CLASS_NAMES))
    report(events.Message(f"{garment.mesh.path}: no vertex classes, found {shares}"))
    return classes


def _describe_rig(rig: ProxyRig, any_loose: bool) -> str:
    if rig.proxy_count:
        return f"{rig.path}: no proxy joints, {rig.proxy_count} placed on the loose part"
    if any_loose:
        return f"{rig.path}: no proxy joints, loose vertices follow the body"
    return f"{rig.path}: nothing loose, no proxy joints needed"
