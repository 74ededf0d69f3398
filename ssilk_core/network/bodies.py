# SPDX-License-Identifier: Apache-2.0
"""A model for a family of bodies, as one for the body that it plays.

P, S and D see a body by its coordinates (`scene.family`), beside what they see of the pose: as more inputs of their
first layers. A body does not change while a shot plays, so that what these inputs add is constant. It is added to the
biases of these layers when a model is put on a body, and the garment is laid where it lies there. What is left is a
model for one body, which every player takes, at the cost of one. At the base, whose coordinates are zero, it is the
model that the file holds, bit for bit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import fail
from ..scene.assets import Floats, Ints, Skeleton
from ..scene.assets.arrays import assign, frozen
from ..scene.family import BodyFamily, DressedFamily
from .first_layers import biases_under, blank_columns, misfit

SEEING = ("initialiser", "stepper", "output")  # networks that see the body, where a model has them
TENSORS = ("members", "rows", "joints", "points", "joint_moves", "point_moves", "taller")


@dataclass(frozen=True, eq=False)
class SeenBodies:
    """A family of bodies, and what a network has learned of it.

    Attributes:
        family: the bodies, and where the garment lies on them.
        columns: weights of the coordinates in the first layer of each network that sees them, shape (H, K).
    """

    family: DressedFamily
    columns: Mapping[str, Floats]

    def __post_init__(self) -> None:
        found = {name: frozen(values, np.float32) for name, values in self.columns.items()}
        assign(self, columns=found)
        for name, values in found.items():
            if name not in SEEING or values.ndim != 2 or values.shape[1] != self.family.bodies.size:
                fail("body family", f"weights '{name}' of shape {values.shape}", "(H, K) is needed", "train again")

    def tensors(self) -> dict[str, Any]:
        """Return the tensors of a file, by name."""
        bodies = self.family.bodies
        return {
            # Coordinates and places keep their precision, moves need none.
            **{f"family.{name}": getattr(bodies, name) for name in TENSORS[:4]},
            **{f"family.{name}": np.float32(getattr(bodies, name)) for name in TENSORS[4:]},
            "family.counts": np.array(bodies.counts, np.int64),
            "family.cloth_moves": np.float32(self.family.cloth_moves),
            "family.proxy_moves": np.float32(self.family.proxy_moves),
            **{f"family.{name}": values for name, values in self.columns.items()},
        }

    @classmethod
    def of(cls, tensors: Mapping[str, Any], names: tuple[str, ...], meshes: tuple[str, ...]) -> SeenBodies:
        """Return what the tensors of a file hold; the names are those of the members, and of their body meshes."""
        found = {name: tensors[f"family.{name}"] for name in TENSORS}
        dressed = DressedFamily(
            BodyFamily(names, meshes=meshes, counts=tuple(np.ravel(tensors["family.counts"]).tolist()), **found),
            tensors["family.cloth_moves"],
            tensors["family.proxy_moves"],
        )
        return cls(dressed, {name: tensors[f"family.{name}"] for name in SEEING if f"family.{name}" in tensors})

    def need_fit(self, skeleton: Skeleton, vertices: int, proxies: int, parameters: Mapping[str, Floats]) -> None:
        """Raise `SsilkError` unless this belongs to a garment's skeleton, vertices, proxies and network."""
        family = self.family
        found = (len(family.bodies.joints), family.cloth_moves.shape[1], family.proxy_moves.shape[1])
        if found != (skeleton.joint_count, vertices, proxies):
            wanted = f"{skeleton.joint_count} joints, {vertices} vertices and {proxies} proxies are needed"
            fail("body family", f"{found[0]} joints, {found[1]} vertices and {found[2]} proxies", wanted)
        if name := misfit(SEEING, self.columns, parameters):
            fail("body family", f"weights '{name}' do not fit the network", "one row for each unit is needed")

    def biases(self, parameters: Mapping[str, Floats], coordinates: Floats) -> dict[str, Floats]:
        """Return the biases of the first layers on a body at coordinates (K,), by name."""
        return biases_under(self.columns, parameters, coordinates)

    def with_proxies(self, kept: Ints) -> SeenBodies:
        """Return this for a garment that keeps some of its proxies alone."""
        return replace(self, family=replace(self.family, proxy_moves=self.family.proxy_moves[:, kept]))

    def stored(self) -> SeenBodies:
        """Return this as files hold it."""
        return replace(self, family=self.family.stored())


def unseen(parameters: Mapping[str, Floats], size: int) -> dict[str, Floats]:
    """Return weights of K coordinates that count nothing, for the networks of a model of one body, by name."""
    return blank_columns(SEEING, parameters, size)


COLUMNS = re.compile(r"(\w+)\.0\.parametrizations\.bias\.(original|0\.columns)")


def parted(values: Mapping[str, Floats]) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return the parameters of a network that sees bodies (`model.bodies`) as those of one that sees none, and apart
    from them the weights of the coordinates."""
    parameters, columns = {}, {}
    for name, value in values.items():
        found = COLUMNS.fullmatch(name)
        if found is None:
            parameters[name] = value
        elif found[2] == "original":
            parameters[f"{found[1]}.0.bias"] = value
        else:
            columns[found[1]] = value
    return parameters, columns


def joined(parameters: Mapping[str, Floats], columns: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return what `parted` takes apart."""
    found = dict(parameters)
    for name, values in columns.items():
        within = f"{name}.0.parametrizations.bias"
        found[f"{within}.original"], found[f"{within}.0.columns"] = found.pop(f"{name}.0.bias"), values
    return found
