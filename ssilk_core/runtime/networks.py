# SPDX-License-Identifier: Apache-2.0
"""Perceptrons in float32, folded so that an activation takes three calls.

SiLU is x / (1 + exp(-x)). With n = -x it is -n / (1 + exp(n)): hidden layers sum to n, their activation loses its
sign, and the next layer's weights take it back, so that nothing is left to negate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Parameters = Mapping[str, NDArray]


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer, float32, signs folded in: weights transposed, then biases, shape (inputs + 1, outputs).

    One vector or many meet the same memory: what has to come from it is what takes time.
    """

    rows: NDArray

    @property
    def weights(self) -> NDArray:
        """Weights (outputs, inputs)."""
        return self.rows[:-1].T

    @property
    def bias(self) -> NDArray:
        """Biases, shape (outputs, 1)."""
        return self.rows[-1][:, None]


def layers(parameters: Parameters, name: str) -> list[Layer]:
    """Return the layers of perceptron `name`, at least two; all but the last sum to minus what the network's do."""
    last = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in parameters) - 1
    folded = []
    for index in range(last + 1):
        weights = parameters[f"{name}.{2 * index}.weight"]
        bias = parameters.get(f"{name}.{2 * index}.bias", np.zeros(len(weights)))
        seen, given = (1 if index == 0 else -1), (1 if index == last else -1)
        folded.append(Layer(single(np.vstack([seen * given * weights.T, given * bias]))))
    return folded


def single(values: NDArray) -> NDArray:
    """Return values in one piece of memory, float32."""
    return np.ascontiguousarray(values, dtype=np.float32)


def evaluated(network: list[Layer], seen: NDArray) -> NDArray:
    """Return what a perceptron gives, shape (outputs, N), for inputs (inputs, N)."""
    first = network[0]
    return continued(network[1:], first.weights @ seen + first.bias)


def continued(network: list[Layer], sums: NDArray) -> NDArray:
    """Return what the layers after the first give, shape (outputs, N), from the sums of that one, (hidden, N)."""
    for layer in network:
        with np.errstate(over="ignore"):  # an activation of minus infinity is zero
            active = sums / (np.exp(sums) + np.float32(1))
        sums = layer.weights @ active
        sums += layer.bias
    return sums
