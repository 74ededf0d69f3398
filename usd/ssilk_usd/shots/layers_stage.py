# SPDX-License-Identifier: Apache-2.0
"""The stage of a shot: all its garments, with their levels of quality as variants, and each body once."""

from __future__ import annotations

import os
from collections.abc import Container, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Kind, Sdf, Tf, Usd, UsdGeom

from ssilk_core.errors import SsilkError, fail
from ssilk_core.files import replacing

from ..opening.specs import free_when_closed
from ..opening.stage import open_stage
from ..reading.mesh import is_body
from ..units import StageUnits
from ..writing.export import new_stage, save
from .layers import LEVEL, Layout, variant
from .layers_hidden import Masks, hidden_in, hide_together
from .shot import metadata_of

OWN_LEVEL = "default"  # the level that a garment with others is itself


@dataclass(frozen=True)
class WrittenStage:
    """The stage of a shot.

    Attributes:
        unreadable: garments that are left out because they cannot be read, and why.
        bodies: garments whose body is not shown, with the garment whose body is.
        uncovered: those of them that cover faces which the body that is shown does not hide for them.
        bodiless: levels without a body of a garment that shows it with its other levels, with that garment.
    """

    unreadable: Mapping[str, str]
    bodies: Mapping[str, str]
    uncovered: frozenset[str]
    bodiless: Mapping[str, str]


def write_stage(
    garments: Mapping[Layout, Hashable],
    needed: Container[str] = frozenset(),
    levels: Mapping[str, str] | None = None,
    facts: Mapping[str, object] | None = None,
) -> WrittenStage:
    """Write the stage of a shot, which references each garment and spans all frames; keep an identical file.

    A garment with levels of quality is one prim, of which each is a variant of `LEVEL`.

    Args:
        garments: the garments of one shot, and who wears each: the body of a character is shown with the first of
            its garments that has one in all its levels, else in some. If none can be read, no stage is written.
        needed: names of garments that have to be in it; others are left out where they cannot be read.
        levels: names of garments that are levels of another one, by their own.
        facts: what the stage says of what is in it, kept as the layer's `customLayerData["ssilk"]`.

    Raises:
        SsilkError: a needed garment cannot be read, the garments have different units or axes, or the file cannot be
            written.
    """
    stages, unreadable = _opened(garments, needed)
    others: dict[str, str] = {}
    if not stages:
        return WrittenStage(unreadable, others, frozenset(), {})
    grouped: dict[str, list[Layout]] = {}
    for garment in stages:
        grouped.setdefault((levels or {}).get(garment.garment, garment.garment), []).append(garment)
    bodies = {garment: _body_names(stage) for garment, stage in stages.items()}
    shown = _shown_with(grouped, garments, bodies)
    layout, units = next(iter(stages)), _common_units(stages)
    first = stages[layout].GetRootLayer()
    spans = [_span(stage.GetRootLayer(), first.timeCodesPerSecond) for stage in stages.values()]
    with replacing(layout.stage, keep_same=True) as temporary:
        stage = new_stage(temporary, units)
        shot = UsdGeom.Xform.Define(stage, "/Shot").GetPrim()
        stage.SetDefaultPrim(shot)
        Usd.ModelAPI(shot).SetKind(Kind.Tokens.assembly)
        for name in ("timeCodesPerSecond", "framesPerSecond"):
            stage.SetMetadata(name, first.pseudoRoot.GetInfo(name))
        stage.SetStartTimeCode(min(start for start, _ in spans))
        stage.SetEndTimeCode(max(end for _, end in spans))
        for name, group in grouped.items():
            prim = stage.DefinePrim(shot.GetPath().AppendChild(name))
            _reference_levels(prim, name, group)
            for garment in group:
                if bodies[garment] and shown[garments[garment]] != name:
                    others[garment.garment] = shown[garments[garment]]
                    for body in bodies[garment]:
                        stage.OverridePrim(prim.GetPath().AppendChild(body)).SetActive(False)
        hidden = {garment: hidden_in(stages[garment], bodies[garment]) for garment in stages if bodies[garment]}
        uncovered = _hide_covered(stage, shot, grouped, garments, hidden, shown)
        free_when_closed(stage.GetUsedLayers())
        if facts:
            stage.GetRootLayer().customLayerData = {"ssilk": metadata_of(facts)}
        save(stage.GetRootLayer(), layout.stage)
        del stage, shot, prim
    showing = {name: grouped[name] for name in shown.values()}
    bodiless = {each.garment: name for name, group in showing.items() for each in group if not bodies[each]}
    return WrittenStage(unreadable, others, frozenset(uncovered), bodiless)


def stage_facts(path: Path) -> dict[str, Any]:
    """Return the facts that a stage was written with; none where there is no stage, or it is damaged."""
    if not path.is_file():
        return {}
    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(path), metadataOnly=True)
    except Tf.ErrorException:  # whoever writes the stage again mends it
        return {}
    return dict(layer.customLayerData.get("ssilk", {}))


def _shown_with(
    grouped: Mapping[str, Sequence[Layout]],
    wearers: Mapping[Layout, Hashable],
    bodies: Mapping[Layout, Sequence[str]],
) -> dict[Hashable, str]:
    """Return with which garment the body of each wearer is shown.

    A variant cannot show what is beneath another prim, so a garment that has the body in all its levels comes first:
    its body is there whichever levels are selected.
    """
    shown: dict[Hashable, str] = {}
    for all_levels in (True, False):
        for name, group in grouped.items():
            for one in filter(bodies.get, group):
                if not all_levels or all(bodies[each] and wearers[each] == wearers[one] for each in group):
                    shown.setdefault(wearers[one], name)
    return shown


def _hide_covered(
    stage: Usd.Stage,
    shot: Usd.Prim,
    grouped: Mapping[str, Sequence[Layout]],
    wearers: Mapping[Layout, Hashable],
    hidden: Mapping[Layout, Masks],
    shown: Mapping[Hashable, str],
) -> set[str]:
    """Hide on each body that is shown what all garments of its wearer hide; return the garments whose faces stay.

    A body with levels of quality stays as its levels have it: which of them shows it is a choice of the shot's.
    """
    left = set[str]()
    for wearer, name in shown.items():
        group = grouped[name]
        others = [each for each in hidden if wearers[each] == wearer and hidden[each] and each not in group]
        covered = [hidden[each] for each in (*group, *others) if hidden.get(each)]
        if others and not (len(group) == 1 and hide_together(stage, shot.GetChild(name), covered)):
            left |= {each.garment for each in others}
    return left


def _reference_levels(prim: Usd.Prim, name: str, group: Sequence[Layout]) -> None:
    """Reference a garment, or each of its levels in a variant; the garment that gave the name is selected."""
    if [garment.garment for garment in group] == [name]:
        prim.GetReferences().AddReference(_from_stage(group[0]))
        return
    for garment in sorted(group, key=lambda each: each.garment == name):  # what is added last is selected
        with variant(prim, LEVEL, level_name(garment.garment, name)):
            prim.GetReferences().AddReference(_from_stage(garment))


def level_name(garment: str, base: str) -> str:
    """Return the variant that a garment is as a level of another one: `cape_game` is the level `game` of `cape`."""
    own = garment.removeprefix(f"{base}_")
    return OWN_LEVEL if garment == base else garment if own in ("", OWN_LEVEL) else own


def _from_stage(layout: Layout) -> str:
    return os.path.relpath(layout.animation, layout.stage.parent)


def _opened(garments: Iterable[Layout], needed: Container[str]) -> tuple[dict[Layout, Usd.Stage], dict[str, str]]:
    """Return the stages of garments that can be read, and why others cannot."""
    stages, unreadable = {}, {}
    for garment in garments:
        try:
            stages[garment] = open_stage(garment.animation)
        except SsilkError as error:
            if garment.garment in needed:
                raise
            unreadable[garment.garment] = str(error)
    return stages, unreadable


def _common_units(stages: Mapping[Layout, Usd.Stage]) -> StageUnits:
    """Return the units of the garments of a shot, which references do not convert."""
    found = {garment: StageUnits.of(stage) for garment, stage in stages.items()}
    one = next(iter(found))
    for other, units in found.items():
        if units != found[one]:
            fail(
                str(one.stage),
                f"'{one.garment}' is in units of {found[one].meters_per_unit:g} m with {found[one].up_axis} up, "
                f"'{other.garment}' in units of {units.meters_per_unit:g} m with {units.up_axis} up",
                "the garments of a shot share units and axis",
                "bake them for one target, or into separate folders",
            )
    return found[one]


def _span(layer: Sdf.Layer, rate: float) -> tuple[float, float]:
    """Return the first and last time code of a layer, as a stage of another rate plays them."""
    scale = rate / layer.timeCodesPerSecond
    return layer.startTimeCode * scale, layer.endTimeCode * scale


def _body_names(stage: Usd.Stage) -> list[str]:
    """Return the names of the body meshes that come with a garment."""
    prims = stage.GetDefaultPrim().GetChildren()
    return [prim.GetName() for prim in prims if prim.IsA(UsdGeom.Mesh) and is_body(prim)]
