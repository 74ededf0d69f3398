# SPDX-License-Identifier: Apache-2.0
"""Settings of a model, and how settings are checked and overridden by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, TypeVar

from ..errors import fail, fail_unknown
from .schemes import need_scheme

DESCRIPTORS = ("relative", "absolute")
MAX_SIZE = 65_536  # of a part of the network; larger ones fit into no machine
NO_BOUND = 1e9  # upper limit of settings without a limit of their own
PROXIMITY_POINTS = 64  # of networks that see colliders, where settings name no number
STRONGEST_PULL = 4.0  # [g] of winds in training, beside gravity; the usual fabric feels it at 20 m/s

# Constants of `model.integrators.SpringVerlet`, shared with the numpy runtime and explained there.
VELOCITY_SCALE, DISTANCE_SCALE, OUTPUT_SCALE = 10.0, 3.0, 0.1
MAX_OUTPUT = 100.0  # limit of each output of S: finite, and far above `max_latent_step`
SPRING_ALLOWANCE, RATE_ALLOWANCE, SEEN_ALLOWANCE = 0.5, 0.05, 0.25
FREE_ACTIVATION = 32.0  # limit of activations without a tanh: a file needs some range, and trainings stay far within
DIVERGENCE_BOUND = 1e3  # a latent beyond this has diverged; those of trained models stay below ten
RECOVERY_FRAMES = 15  # frames at rest after a diverged state, half a second at 30 frames per second


def need_between(config: object, low: float, high: float, *names: str) -> None:
    """Raise `SsilkError` unless each of these settings lies in [low, high]."""
    for name in names:
        value = getattr(config, name)
        if not low <= value <= high:
            fail(f"setting '{name}'", f"{value:g}", f"it must lie between {low:g} and {high:g}")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Shape of the network.

    Attributes:
        latent: number of dimensions of the latent state z.
        widths: widths of the hidden layers of the initialiser P, the stepper S and the decoder D.
        shapes: number K of blendshapes; with zero only proxies deform the garment.
        activations: number of activations that D outputs, if it differs from K ("ssilk reduce"); zero for K.
        translations: whether proxies move as well as turn; in the paper they only turn.
        tanh: whether activations pass a tanh; in the paper they do not, and `FREE_ACTIVATION` alone limits them.
        scheme: name of the integration scheme in `schemes.SCHEMES`: "spring_verlet" is Eq. 3 with a spring to the
            quasi-static state, "verlet" is Eq. 3 as in the paper, "quasi_static" is the quasi-static state itself.
        descriptors: what S sees of the pose (`network.descriptors`): "relative", or "absolute" as in the paper, which
            "spring_verlet" cannot take.
        latent_bound: bound on each latent dimension; zero for none, as in the paper.
        max_latent_step: soft bound on the sum of S and the spring in each dimension in one step; zero for none.
        feedback_points: points of the decoded cloth that S sees (`network.feedback`); zero for none.
        feedback_proxies: whether S sees the proxies of the last two states, as in the paper's Figure 2, which
            "spring_verlet" cannot take.
        proximity_points: points of the garment, where it would rest without colliders, at which the network sees how
            near these are (`network.proximity`); zero for a network that sees none.
        stiffness: largest spring constant of "spring_verlet", in (0, 1].
        velocity_allowance: what S may give for each unit of the state's velocity, in [0, 1], beside what the spring
            and the rates of the pose allow (`model.integrators.SpringVerlet`).
        fps: steps of the model per second [1/s].
    """

    latent: int = 128
    widths: tuple[int, ...] = (256, 512, 512)
    shapes: int = 64
    activations: int = 0
    translations: bool = False
    tanh: bool = True
    scheme: str = "spring_verlet"
    descriptors: str = "relative"
    latent_bound: float = 4.0
    max_latent_step: float = 1.0
    feedback_points: int = 64
    feedback_proxies: bool = False
    proximity_points: int = 0
    stiffness: float = 0.2
    velocity_allowance: float = 0.05
    fps: float = 30.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        need_scheme(self.scheme)
        if self.descriptors not in DESCRIPTORS:
            fail_unknown("model", f"descriptors '{self.descriptors}'", self.descriptors, DESCRIPTORS)
        if self.scheme == "spring_verlet" and (self.descriptors == "absolute" or self.feedback_proxies):
            # Neither is zero for a garment at rest, which would then not stay there.
            found = "absolute descriptors" if self.descriptors == "absolute" else "feedback of proxies"
            fail("model", f"{found} with the scheme 'spring_verlet'", "its garments rest", "take --set scheme=verlet")
        if not 1 <= min(self.widths) <= max(self.widths) <= MAX_SIZE:
            fail("model", f"widths = {self.widths}", f"each must be at least 1 and at most {MAX_SIZE}")
        need_between(self, 1, MAX_SIZE, "latent")
        need_between(self, 1, NO_BOUND, "fps")
        need_between(self, 0, MAX_SIZE, "shapes", "activations", "feedback_points", "proximity_points")
        need_between(self, 0, NO_BOUND, "latent_bound", "max_latent_step")
        need_between(self, 1e-6, 1, "stiffness")
        need_between(self, 0, 1, "velocity_allowance")

    @property
    def activation_count(self) -> int:
        """Return the number of activations that D outputs."""
        return self.activations or self.shapes

    @property
    def activation_range(self) -> float:
        """Return the limit of activations: one after a tanh or in a reduced model."""
        return 1.0 if self.tanh or self.activations else FREE_ACTIVATION

    @property
    def proxy_outputs(self) -> int:
        """Return the number of outputs of D for each proxy: a 6D rotation and, where proxies move, a displacement."""
        return 9 if self.translations else 6


def _converted(kind: type, text: str) -> Any:
    if kind is bool:
        return {"true": True, "false": False}[text.lower()]
    return kind(text)


Config = TypeVar("Config")


def setting_names(config: object) -> list[str]:
    """Return what can be set of a configuration or of its class: what has a default.

    A fabric's name has none: it says which fabric it is.
    """
    return [item.name for item in fields(config) if item.default is not MISSING]  # type: ignore[arg-type]


def apply_overrides(config: Config, assignments: Sequence[str], option: str = "--set") -> Config:
    """Return `config` with "name=value" assignments applied, each converted to the type of its field.

    Args:
        option: that has them, for messages.

    Raises:
        SsilkError: one assigns nothing, a name is no setting's, or a value cannot be converted.
    """
    types = {name: type(getattr(config, name)) for name in setting_names(config)}
    changes: dict[str, Any] = {}
    for assignment in assignments:
        (name, equals, text), where = assignment.partition("="), f"{option} {assignment}"
        if name not in types:
            label = f"'{name}' is a label, not a setting"
            found = label if hasattr(config, name) else "no such setting"
            fail_unknown(where, found, name, types)
        if not equals:
            fail(where, "a name without a value", "NAME=VALUE is needed")
        try:
            changes[name] = (
                tuple(int(n) for n in text.split(",")) if types[name] is tuple else _converted(types[name], text)
            )
        except (ValueError, KeyError):
            found = f"'{text}' is not a value for '{name}'"
            fail(where, found, f"a value of type {types[name].__name__} is needed")
    return replace(config, **changes)  # type: ignore[type-var]
