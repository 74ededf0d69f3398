# SPDX-License-Identifier: Apache-2.0
"""The registry of integration schemes: what settings, model files and networks need to know of each."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import fail


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """How the latent state advances from frame to frame.

    Attributes:
        integrator: "module:class" of its `model.integrators.Integrator`, imported when a network is built.
        states: latent vectors that the stepper S sees beside the pose; zero for a scheme without S.
        parameters: names of the integrator's parameters, each of shape (latent,).
        bias: whether the last layer of S has a bias.
    """

    integrator: str
    states: int
    parameters: tuple[str, ...] = ()
    bias: bool = True


SCHEMES: dict[str, Scheme] = {
    "spring_verlet": Scheme(
        integrator="ssilk_core.network.model.integrators:SpringVerlet",
        states=3,
        parameters=("beta", "share"),
        bias=False,
    ),
    "verlet": Scheme(
        integrator="ssilk_core.network.model.integrators:Verlet", states=2, parameters=("alpha", "beta")
    ),
    "quasi_static": Scheme(integrator="ssilk_core.network.model.integrators:QuasiStatic", states=0),
}
"""All schemes by name. Other code may add its own before it reads settings or models that name them."""


def need_scheme(name: str) -> None:
    """Raise `SsilkError` unless a scheme of this name is registered."""
    if name not in SCHEMES:
        fail(
            "model",
            f"integration scheme '{name}'",
            f"it is one of {', '.join(SCHEMES)}",
            "train with one of these, or register this one in ssilk_core.network.schemes.SCHEMES",
        )
