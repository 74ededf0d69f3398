# SPDX-License-Identifier: Apache-2.0
"""What does not change while a shot plays, as more inputs of the first layers of a model's networks.

A body of a family (`network.bodies`) and a fabric of a range (`network.fabrics`) are such inputs. What they add is
constant, and is added to the biases of these layers when a model is put on one of them. Weights are apart from the
network's other parameters, as `columns`: of each network that sees these inputs, shape (H, K), by the network's name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..scene.assets import Floats

Columns = Mapping[str, Floats]


def biases_under(columns: Columns, parameters: Mapping[str, Floats], inputs: Floats) -> dict[str, Floats]:
    """Return the biases of the first layers under inputs (K,), by name."""
    return {
        f"{name}.0.bias": (parameters[f"{name}.0.bias"] + values @ inputs).astype(np.float32)
        for name, values in columns.items()
    }


def blank_columns(seeing: Iterable[str], parameters: Mapping[str, Floats], size: int) -> dict[str, Floats]:
    """Return weights of K inputs that count nothing, for those of the networks `seeing` that a model has, by name."""
    biases = {name: parameters.get(f"{name}.0.bias") for name in seeing}
    return {name: np.zeros((len(bias), size), np.float32) for name, bias in biases.items() if bias is not None}


def misfit(seeing: Iterable[str], columns: Columns, parameters: Mapping[str, Floats]) -> str | None:
    """Return the first of the networks `seeing` for which weights are missing, too many, or of another size; None
    where all fit."""
    for name in seeing:
        bias, own = parameters.get(f"{name}.0.bias"), columns.get(name)
        if (bias is None) != (own is None) or (bias is not None and own is not None and len(bias) != len(own)):
            return name
    return None
