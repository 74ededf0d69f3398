# SPDX-License-Identifier: Apache-2.0
"""Prepare a scene for training from a character and a garment as authored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ... import events
from ...scene.assets import CLASS_NAMES, LOOSE, Character, Floats, Garment, ProxyRig, Scene
from .classes import LADDER, USUAL, held_classes, hold_levels
from .rig import RigOptions, build_rig
from .weights import WeightOptions, transfer_weights


def prepare_scene(
    character: Character,
    garment: Garment,
    rig: ProxyRig | None = None,
    *,
    weight_options: WeightOptions | None = None,
    tightness: float | None = None,
    rig_options: RigOptions | None = None,
    rough: bool = False,
    report: events.Reporter = events.silent,
) -> Scene:
    """Add the weights, classes and proxies that a garment lacks, and keep those that are authored.

    Args:
        tightness: how much becomes tight, in [0, 1]: nothing, or all. None stands for the usual tightness, and
            leaves classes that are there. Otherwise those are made again by the garment's levels, and with other
            classes the rig is, too.
        garment: fitted to the character's bind pose, with or without weights and classes.
        rig: proxies authored for the garment, or None.
        rough: whether classes, the joints that count and the number of proxies are enough: levels are sought at the
            usual tightness alone, and distances for proxies are not exact.
        report: receives a message about each thing that is added.

    Raises:
        SsilkError: an island of the garment has no pinned or tight vertex, or the authored parts do not match.
    """
    classes, levels = garment.classes, garment.levels
    if classes is None:
        levels = _find_levels(character, garment, () if rough else tuple(LADDER))
        classes = held_classes(garment.mesh, levels, USUAL if tightness is None else tightness)
        shares = ", ".join(f"{np.mean(classes == value):.0%} {name}" for value, name in enumerate(CLASS_NAMES))
        report(events.Message(f"{garment.mesh.path}: no vertex classes; classified as {shares}"))
    elif tightness is not None and levels is not None:
        classes = held_classes(garment.mesh, levels, tightness)
        changed = int(np.count_nonzero(classes != garment.classes))
        anew = ", so its proxies are placed anew" if changed and rig else ""
        report(events.Message(f"{garment.mesh.path}: {changed} classes are others at tightness {tightness:g}{anew}"))
        rig = None if changed else rig
    elif tightness is not None:
        kept = "its classes are kept, whatever the tightness: it has no primvars:ssilk:tightness to make others by"
        report(events.Message(f"{garment.mesh.path}: {kept}", "warning"))
    skin = garment.skin
    if skin is None:
        report(events.Message(f"{garment.mesh.path}: no skinning weights; they are transferred from the body"))
        skin = transfer_weights(character, garment.mesh, classes=classes, options=weight_options)
    garment = replace(garment, skin=skin, classes=classes, levels=levels)
    if rig is None:
        if rough:
            rig_options = replace(rig_options or RigOptions(), exact=False)
        rig = build_rig(character, garment, rig_options, report=report)
        report(events.Message(_describe_rig(rig, bool(np.any(classes == LOOSE)))))
    return Scene(character, garment, rig)


def _find_levels(character: Character, garment: Garment, ladder: Sequence[float]) -> Floats:
    """Find levels by authored weights, or else by unsmoothed ones from the body, which jump where limbs part."""
    unsmoothed = WeightOptions(tight_rounds=0, loose_rounds=0)
    skin = garment.skin or transfer_weights(character, garment.mesh, options=unsmoothed)
    carried = garment.skin is not None and garment.skin.only_joint is not None
    pins = None if garment.pins is None else garment.pins != 0
    return hold_levels(character, garment.mesh, skin, ladder=ladder, carried=carried, pins=pins)


def _describe_rig(rig: ProxyRig, any_loose: bool) -> str:
    if rig.proxy_count:
        return f"{rig.path}: no proxy joints; {rig.proxy_count} are placed on the loose part"
    if any_loose:
        return f"{rig.path}: no proxy joints; loose vertices follow the body"
    return f"{rig.path}: no loose vertices, so no proxy joints are needed"
