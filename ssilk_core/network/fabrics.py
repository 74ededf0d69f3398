# SPDX-License-Identifier: Apache-2.0
"""A model for a range of fabrics, as one for the fabric that it plays.

P and S see a fabric by the features of `scene.fabric_range`, before what they see of the pose: as more inputs of
their first layers. D decodes one space of latents for all. A fabric does not change while a frame is played, so that
what these inputs add is constant. It is added to the biases of these layers when a model is put on a fabric. What is
left is a model for one fabric, which every player takes, at the cost of one. For the training's own fabric, whose
features are zero, it is the model that the file holds, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import fail
from ..scene.assets import Floats
from ..scene.assets.arrays import assign, frozen
from ..scene.fabric_range import FACTORS, FabricRange

SEEING = ("initialiser", "stepper")  # networks that see the fabric, where a model has them


@dataclass(frozen=True, eq=False)
class SeenFabrics:
    """A range of fabrics, and what a network has learned of it.

    Attributes:
        range: of the fabrics that it was trained for.
        columns: weights of the features in the first layer of each network that sees them, shape (H, 5).
    """

    range: FabricRange
    columns: Mapping[str, Floats]

    def __post_init__(self) -> None:
        found = {name: frozen(values, np.float32) for name, values in self.columns.items()}
        assign(self, columns=found)
        for name, values in found.items():
            if name not in SEEING or values.ndim != 2 or values.shape[1] != len(FACTORS):
                allowed = f"(H, {len(FACTORS)}) is needed"
                fail("range of fabrics", f"weights '{name}' of shape {values.shape}", allowed, "train again")
            if not np.isfinite(values).all():
                fail(
                    "range of fabrics", f"weights '{name}' hold NaN or infinity", "all must be finite", "train again"
                )

    def tensors(self) -> dict[str, Any]:
        """Return the tensors of a file, by name."""
        return {f"fabrics.{name}": values for name, values in self.columns.items()}

    def document(self) -> dict[str, Any]:
        """Return what the header of a file says."""
        return {name: list(values) for name, values in vars(self.range).items() if values is not None}

    @classmethod
    def of(cls, tensors: Mapping[str, Any], document: Mapping[str, Any]) -> SeenFabrics:
        """Return what a file holds.

        Raises:
            TypeError: the header's range is none.
        """
        return cls(
            FabricRange(**{"points": None, **document}),
            {name: tensors[f"fabrics.{name}"] for name in SEEING if f"fabrics.{name}" in tensors},
        )

    def need_fit(self, parameters: Mapping[str, Floats]) -> None:
        """Raise `SsilkError` unless this belongs to a network."""
        for name in SEEING:
            bias, own = parameters.get(f"{name}.0.bias"), self.columns.get(name)
            if (None if bias is None else len(bias)) != (None if own is None else len(own)):
                found = f"weights '{name}' do not fit the network"
                fail("range of fabrics", found, "one row for each unit is needed", "train again")

    def biases(self, parameters: Mapping[str, Floats], features: Floats) -> dict[str, Floats]:
        """Return the biases of the first layers under features (5,), by name."""
        return {
            f"{name}.0.bias": (parameters[f"{name}.0.bias"] + values @ features).astype(np.float32)
            for name, values in self.columns.items()
        }


def unseen(parameters: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return weights that count nothing, for the networks of a model of one fabric, by name."""
    biases = {name: parameters.get(f"{name}.0.bias") for name in SEEING}
    return {
        name: np.zeros((len(bias), len(FACTORS)), np.float32) for name, bias in biases.items() if bias is not None
    }


def parted(values: Mapping[str, Floats], states: int) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return the parameters of a network that sees fabrics (`model.fabrics`) as those of one that sees none, and
    apart from them the weights of the features; `states` as there."""
    parameters, columns = dict(values), {}
    for name, place in zip(SEEING, (0, states)):
        if (weight := parameters.get(f"{name}.0.weight")) is not None:
            columns[name] = weight[:, place : place + len(FACTORS)].copy()
            parameters[f"{name}.0.weight"] = np.delete(weight, np.s_[place : place + len(FACTORS)], axis=1)
    return parameters, columns


def joined(parameters: Mapping[str, Floats], columns: Mapping[str, Floats], states: int) -> dict[str, Floats]:
    """Return what `parted` takes apart."""
    found = dict(parameters)
    for name, place in zip(SEEING, (0, states)):
        if name in columns:
            weight = found[f"{name}.0.weight"]
            found[f"{name}.0.weight"] = np.hstack([weight[:, :place], columns[name], weight[:, place:]])
    return found
