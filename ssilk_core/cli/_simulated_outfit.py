# SPDX-License-Identifier: Apache-2.0
"""The garments of one simulation: one, or those of a list, which start settled off what they are worn over."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import fail
from ..events import Message, Reporter
from ..physics.simulate import WornGarment
from ..training.wardrobe.listing import WardrobeEntry, read_list
from .options.bodies import left_out_in_list
from .options.fabric import garment_fabric
from .options.scene import load_scene

if TYPE_CHECKING:
    from ..physics.intersections.layers import ClothLayers, LayerCounts
    from ..scene.assets import Floats

OF_A_GARMENT = ("garment", "root", "body", "fabric", "material")  # options that a list has no use for


@dataclass(frozen=True, eq=False)
class SimulatedGarment:
    """A garment to simulate.

    Attributes:
        name: in its list; "" for a garment that is no part of one.
        options: those that say which it is.
        over: names of the garments that it is worn over.
    """

    name: str
    options: argparse.Namespace
    worn: WornGarment
    over: tuple[str, ...] = ()


def outfit_options(options: argparse.Namespace) -> dict[str, argparse.Namespace]:
    """Return the options that say what each garment of a list is, by name, inner ones first.

    Raises:
        SsilkError: the list cannot be read, options say what its tables do, or it is no outfit of one character.
    """
    for name in OF_A_GARMENT:
        if getattr(options, name):
            fail(f"--{name}", f"{options.stage} is a list", "its tables say what each garment is", "leave it out")
    path, found = options.stage, dict[str, argparse.Namespace]()
    entries = read_list(path)
    for entry in entries:
        table = entry.located(path.parent)
        if models := entry.models(table):
            allowed = "an outfit is simulated of the garments of its list"
            fail(f"{path}: table '{entry.name}', key 'over'", f"a model, {models[0]}", allowed, "add its garment")
        found[entry.name] = _options(options, entry, table)
        left_out = left_out_in_list(entry, entries, path.parent)  # they are met as garments, all of them
        found[entry.name].body = [body for bodies in left_out.values() for body in bodies]
    stages = {str(each.stage) for each in found.values()}
    if len({Path(stage).resolve() for stage in stages}) > 1:
        allowed = "garments of an outfit are worn by one character"
        fail(str(path), f"the stages {' and '.join(sorted(stages))}", allowed, "name one stage in [defaults]")
    return found


def _options(options: argparse.Namespace, entry: WardrobeEntry, table: Mapping[str, Any]) -> argparse.Namespace:
    material = table.get("material", {})
    return argparse.Namespace(**{
        **vars(options),
        "stage": Path(table["stage"]),
        "garment": table.get("garment"),
        "fabric": table.get("fabric"),
        "material": [f"{name}={value}" for name, value in material.items()],
        "over": entry.over,
    })  # fmt: skip


def garments_of(every: Mapping[str, argparse.Namespace], report: Reporter) -> list[SimulatedGarment]:
    """Read garments by the options that say which, in order, each settled off those that it is worn over.

    Raises:
        SsilkError: one cannot be read, or libigl is missing, which says where garments lie in each other.
    """
    found = list[SimulatedGarment]()
    for name, options in every.items():
        scene = load_scene(options, report)
        fabric = garment_fabric(options, scene.garment, report)
        over = getattr(options, "over", ())
        names = set(over)
        for each in reversed(found):  # and what these are worn over
            names |= set(each.over) if each.name in names else set()
        inner = [each for each in found if each.name in names]
        worn = _over(name, WornGarment(scene, fabric), inner, report) if inner else WornGarment(scene, fabric)
        found.append(SimulatedGarment(name, options, worn, tuple(over)))
    return found


def _over(name: str, worn: WornGarment, inner: Sequence[SimulatedGarment], report: Reporter) -> WornGarment:
    """Return a garment that is tight where it was pinned over cloth that moves, and starts over what is beneath."""
    from dataclasses import replace

    import numpy as np

    from ..authoring.preflight.fit import describe_move
    from ..authoring.preflight.settle import settle
    from ..physics.collision.inner_cloth import loosened_over
    from ..physics.intersections.pairs import intersections_between, need_predicates

    need_predicates()
    scene = loosened_over(worn.scene, [each.worn.scene for each in inner])
    loosened = int((scene.classes != worn.scene.classes).sum())
    if loosened:
        report(Message(f"{name}: {loosened} pinned vertices lie over cloth that moves, and are tight"))
    mesh, body = scene.garment.mesh, scene.character.merged_body().mesh
    beneath = [replace(each.worn.scene.garment.mesh, points=_begun(each.worn)) for each in inner]
    settled = settle(mesh, body, inner=beneath)
    if not settled.moved:
        return replace(worn, scene=scene)
    text = f"{name}: starts {describe_move(settled, 'settled, which moves')}"
    report(Message(f"{text}; its rest shape stays"))
    start = mesh.points + settled.offsets
    left = len(np.unique(np.concatenate([
        intersections_between(start, mesh.faces, other.points, other.faces)[:, 0] for other in beneath
    ])))  # fmt: skip
    if left:
        told = (
            f"{name}: {left} of its {len(mesh.faces)} triangles start in those of {', '.join(e.name for e in inner)}"
        )
        report(Message(f"{told}, off which settling finds no way", "warning"))
    return replace(worn, scene=scene, start=start)


def _begun(worn: WornGarment) -> Floats:
    return worn.scene.garment.mesh.points + worn.offsets


class OutfitCounter:
    """Counts how garments lie over those that they are worn over, at the solver's own points.

    Args:
        shots: their names.
    """

    def __init__(self, garments: Sequence[SimulatedGarment], shots: Sequence[str]) -> None:
        self._pairs: list[tuple[int, int, ClothLayers, list[tuple[str, LayerCounts]]]] = []
        self._shots = shots
        places = {each.name: number for number, each in enumerate(garments)}
        for one, other in combinations(garments, 2):
            layers = _layers(one, other)
            outer, inner = (places[name] for name in layers.names)
            self._pairs.append((outer, inner, layers, []))

    def add(self, shot: int, frame: int, points: Sequence[Floats]) -> None:
        """Count in a frame of a shot, from the points of each garment (V, 3) [m]."""
        for outer, inner, layers, counts in self._pairs:
            counts.append((self._shots[shot], layers.counts([points[outer]], [points[inner]], [frame])))

    def figures(self) -> dict[str, object]:
        """Return what was counted, for people."""
        return {
            f"{layers.names[0]}: {what}": value
            for _, _, layers, counts in self._pairs
            if counts
            for what, value in layers.figures(counts).summary().items()
        }


def _layers(one: SimulatedGarment, other: SimulatedGarment) -> ClothLayers:
    """Return two garments, outer first: as their list says, or else the one that covers more of the other."""
    from ..physics.intersections.layers import ClothLayers

    meshes = {each.name: each.worn.scene.garment.mesh for each in (one, other)}
    character = one.worn.scene.character
    body = character.merged_body().mesh if character.bodies else None
    for outer, inner in ((one, other), (other, one)):
        if inner.name in outer.over:
            return ClothLayers((outer.name, inner.name), meshes[outer.name], meshes[inner.name], body)
    return ClothLayers.by_cover((one.name, meshes[one.name]), (other.name, meshes[other.name]), body)
