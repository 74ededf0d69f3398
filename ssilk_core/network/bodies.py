# SPDX-License-Identifier: Apache-2.0
"""A model for a family of bodies, as one for the body that it plays.

P, S and D see a body by its coordinates (`scene.family`), beside what they see of the pose. They add to the biases of
first layers, which may see fabrics too. In the other hidden layers they also multiply the rows of the weights
(feature-wise linear modulation; Perez et al., "FiLM", 2018). A body does not change while a shot plays, so that both
are constant. They are put into weights and biases when a model is put on a body, and the garment is laid where it
lies there. What is left is a model for one body, which every player takes, at the cost of one. At the base, whose
coordinates are zero, it is the model that the file holds, bit for bit.
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

SEEING = ("initialiser", "stepper", "output")  # networks that see the body, where a model has them
LAYER = re.compile(rf"({'|'.join(SEEING)})\.\d+")
Columns = Mapping[str, Floats]
TENSORS = ("members", "rows", "joints", "points", "joint_moves", "point_moves", "taller")


@dataclass(frozen=True, eq=False)
class SeenBodies:
    """A family of bodies, and what a network has learned of it.

    Attributes:
        family: the bodies, and where the garment lies on them.
        columns: weights of the coordinates in layers of the networks that see them, by the layer's name, shape
            (2, H, K): of what is added to its H biases, and of what the rows of its weights are multiplied by
            beyond one.
    """

    family: DressedFamily
    columns: Columns

    def __post_init__(self) -> None:
        found = {name: frozen(values, np.float32) for name, values in self.columns.items()}
        assign(self, columns=found)
        for name, values in found.items():
            if not LAYER.fullmatch(name) or values.ndim != 3 or values.shape[::2] != (2, self.family.bodies.size):
                fail("body family", f"weights '{name}' of shape {values.shape}", "(2, H, K) is needed", "train again")

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
        columns = {}
        for name, values in tensors.items():
            if (layer := name.removeprefix("family.")) != name:
                if LAYER.fullmatch(layer):
                    columns[layer] = values
                elif layer in SEEING:  # as of files whose networks saw bodies in their first layers alone
                    columns[f"{layer}.0"] = np.stack([values, np.zeros_like(values)])
        return cls(dressed, columns)

    def need_fit(self, skeleton: Skeleton, vertices: int, proxies: int, parameters: Mapping[str, Floats]) -> None:
        """Raise `SsilkError` unless this belongs to a garment's skeleton, vertices, proxies and network."""
        family = self.family
        found = (len(family.bodies.joints), family.cloth_moves.shape[1], family.proxy_moves.shape[1])
        if found != (skeleton.joint_count, vertices, proxies):
            wanted = f"{skeleton.joint_count} joints, {vertices} vertices and {proxies} proxies are needed"
            fail("body family", f"{found[0]} joints, {found[1]} vertices and {found[2]} proxies", wanted)
        layers = hidden_layers(parameters)
        first = {layer for layer in layers if layer.endswith(".0")}
        for name in sorted(first - self.columns.keys()):
            fail("body family", f"no weights '{name}'", "each network sees bodies", "train again")
        for name, values in self.columns.items():
            if name not in layers or len(parameters[f"{name}.weight"]) != values.shape[1]:
                fail("body family", f"weights '{name}' do not fit the network", "one row for each unit is needed")

    def parameters(self, parameters: Mapping[str, Floats], coordinates: Floats) -> dict[str, Floats]:
        """Return the weights and biases that differ on a body at coordinates (K,), by name."""
        found = {}
        for layer, (added, scales) in self.columns.items():
            rows = 1 + scales @ coordinates
            found[f"{layer}.weight"] = (rows[:, None] * parameters[f"{layer}.weight"]).astype(np.float32)
            if (bias := parameters.get(f"{layer}.bias")) is not None:
                found[f"{layer}.bias"] = (bias + added @ coordinates).astype(np.float32)
        return found

    def with_proxies(self, kept: Ints) -> SeenBodies:
        """Return this for a garment that keeps some of its proxies alone."""
        return replace(self, family=replace(self.family, proxy_moves=self.family.proxy_moves[:, kept]))

    def stored(self) -> SeenBodies:
        """Return this as files hold it."""
        return replace(self, family=self.family.stored())


def hidden_layers(parameters: Mapping[str, Floats]) -> list[str]:
    """Return the names of the layers of a model's networks that see bodies: all but the last of each."""
    found = []
    for name in SEEING:
        places = (re.fullmatch(rf"{name}\.(\d+)\.weight", each) for each in parameters)
        layers = sorted(int(place[1]) for place in places if place)
        found += [f"{name}.{layer}" for layer in layers[:-1]]
    return found


def completed(columns: Columns, parameters: Mapping[str, Floats], size: int) -> dict[str, Floats]:
    """Return weights of K coordinates for all hidden layers of a model, by the layer's name: those given, and others
    that count nothing."""
    sizes = {layer: len(parameters[f"{layer}.weight"]) for layer in hidden_layers(parameters)}
    return {**{layer: np.zeros((2, outputs, size), np.float32) for layer, outputs in sizes.items()}, **columns}


PARAMETER = re.compile(r"(\w+\.\d+)\.parametrizations\.(bias|weight)\.(original|0\.columns)")


def parted(values: Mapping[str, Floats]) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return the parameters of a network that sees bodies (`model.bodies`) as those of one that sees none, and apart
    from them the weights of the coordinates."""
    parameters: dict[str, Floats] = {}
    apart: dict[str, dict[str, Floats]] = {}
    for name, value in values.items():
        found = PARAMETER.fullmatch(name)
        if found is None:
            parameters[name] = value
        elif found[3] == "original":
            parameters[f"{found[1]}.{found[2]}"] = value
        else:
            apart.setdefault(found[1], {})[found[2]] = value
    columns = {}
    for layer, own in apart.items():
        none = np.zeros_like(next(iter(own.values())))
        columns[layer] = np.stack([own.get("bias", none), own.get("weight", none)])
    return parameters, columns


def joined(parameters: Mapping[str, Floats], columns: Columns) -> dict[str, Floats]:
    """Return what `parted` takes apart."""
    found = dict(parameters)
    for layer, both in columns.items():
        for kind, values in zip(("bias", "weight"), both):
            first = kind == "weight" and layer.endswith(".0")
            if f"{layer}.{kind}" in found and not first:
                within = f"{layer}.parametrizations.{kind}"
                found[f"{within}.original"], found[f"{within}.0.columns"] = found.pop(f"{layer}.{kind}"), values
    return found
