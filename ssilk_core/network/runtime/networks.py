# SPDX-License-Identifier: Apache-2.0
"""Perceptrons in float32, folded so that an activation takes three calls.

SiLU is x / (1 + exp(-x)). With n = -x it is -n / (1 + exp(n)). The weights of hidden layers are negated, so that they
sum to n; the sign of the activation is folded into the next layer's weights. No negation is left at run time.
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

    Products with one vector and with many share this memory, because reading it takes most of the time.
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
    """Return the layers of perceptron `name`, at least two; sums of all but the last are negated."""
    last = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in parameters) - 1
    folded = []
    for index in range(last + 1):
        weights = parameters[f"{name}.{2 * index}.weight"]
        bias = parameters.get(f"{name}.{2 * index}.bias", np.zeros(len(weights)))
        input_sign, output_sign = (1 if index == 0 else -1), (1 if index == last else -1)
        folded.append(Layer(as_float32(np.vstack([input_sign * output_sign * weights.T, output_sign * bias]))))
    return folded


def as_float32(values: NDArray) -> NDArray:
    """Return values as a contiguous float32 array."""
    return np.ascontiguousarray(values, dtype=np.float32)


def evaluate(network: list[Layer], inputs: NDArray) -> NDArray:
    """Return a perceptron's outputs (outputs, N) for inputs (inputs, N)."""
    sums: NDArray = network[0].weights @ inputs
    sums += network[0].bias
    return evaluate_tail(network[1:], sums)


def evaluate_tail(network: list[Layer], sums: NDArray) -> NDArray:
    """Return the outputs (outputs, N) of the layers after the first, from the first layer's sums (hidden, N).

    The sums are overwritten: writing to fresh memory takes a third of the time of a product.
    """
    for layer in network:
        with np.errstate(over="ignore"):  # an activation of minus infinity is zero
            scale = np.exp(sums)
        scale += np.float32(1)
        sums /= scale
        sums = layer.weights @ sums
        sums += layer.bias
    return sums


class LayerBuffers:
    """A hidden layer for single frames, with preallocated buffers.

    Args:
        rows: weights (inputs, hidden); a last row of biases where these are not added otherwise.
    """

    def __init__(self, rows: NDArray) -> None:
        self.rows, hidden = rows, rows.shape[1]
        # Separate arrays: numpy treats neighbours in memory as overlapping, which makes its exponential 20 times
        # slower.
        self.active, self.scale = np.ones(hidden + 1, np.float32), np.empty(hidden, np.float32)
        self.sums = self.active[:-1]  # the last entry stays 1 and multiplies the next layer's biases
        self.one = np.ones_like(self.scale)  # adding an array of 512 is faster in numpy than adding a scalar

    def activate(self) -> NDArray:
        """Turn the sums into activations in place; return these, followed by a one."""
        sums, scale = self.sums, self.scale
        np.exp(sums, scale)
        np.add(scale, self.one, scale)
        np.divide(sums, scale, sums)
        return self.active
