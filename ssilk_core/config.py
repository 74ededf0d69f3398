# SPDX-License-Identifier: Apache-2.0
"""What can be chosen about a model and its training, with the presets."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from .errors import fail

SURFACES = ("triangles", "vertices")
SCHEMES = ("spring_verlet", "verlet", "direct", "direct_residual", "quasi_static")
MOST = 1e9  # of anything that has no other bound

# Of "spring_verlet", as `model.integrators.SpringVerlet` explains them, for all that play it.
VELOCITY_SCALE, DISTANCE_SCALE, REACH = 10.0, 3.0, 0.1
MOST_GIVEN = 100.0  # of what S gives; far beyond what a push lets through, and finite
OWN_SHARE, RATE_SHARE = 0.5, 0.05
LOST = 1e3  # of a latent: trained ones stay below ten, and no decoder knows what this means
RECOVERY = 15  # frames at rest after a lost state, half a second of the usual rate


def _need_between(config: object, low: float, high: float, *names: str) -> None:
    """Raise `SsilkError` unless each of these settings lies between two numbers, themselves included."""
    for name in names:
        value = getattr(config, name)
        if not low <= value <= high:
            fail(f"setting '{name}'", f"{value:g}", f"it lies between {low:g} and {high:g}")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Shape of the network.

    Attributes:
        latent: dimensions of the latent state z.
        widths: hidden layers of the initialiser P, the stepper S and the decoder D.
        shapes: blendshapes K; zero leaves proxies alone to deform the garment.
        activations: what D gives for them, where it is more than K ("ssilk reduce"); zero for K itself.
        scheme: how z is integrated: "verlet" (Eq. 3), "direct" (Eq. 11), "direct_residual" (Eq. 12), or
            "spring_verlet", which is Eq. 3 with a spring to the quasi-static state, or "quasi_static", that state.
        bound: soft bound on each latent dimension; zero leaves the latents free, as the paper does.
        push: soft bound on what S and the spring add to each dimension in one step; zero for none.
        stiffness: largest spring constant of "spring_verlet", in (0, 1].
        fps: rate at which the model steps [1/s].
    """

    latent: int = 128
    widths: tuple[int, ...] = (256, 512, 512)
    shapes: int = 64
    activations: int = 0
    scheme: str = "spring_verlet"
    bound: float = 4.0
    push: float = 0.3
    stiffness: float = 0.2
    fps: float = 30.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        if self.scheme not in SCHEMES:
            fail("model", f"integration scheme '{self.scheme}'", f"it is one of {', '.join(SCHEMES)}")
        if not min(self.widths) > 0:
            fail("model", f"widths = {self.widths}", "each is at least 1")
        _need_between(self, 1, MOST, "latent", "fps")
        _need_between(self, 0, MOST, "shapes", "activations", "bound", "push")
        _need_between(self, 1e-6, 1, "stiffness")

    @property
    def given(self) -> int:
        """How many activations D gives."""
        return self.activations or self.shapes


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a model is trained (paper, Section 3.7; defaults that differ are explained in docs/training.md).

    Attributes:
        iterations: optimiser steps, warm start included.
        warm: share of the iterations that train P and D alone on single poses (quasi-static warm start).
        warm_batch: poses for each step of the warm start.
        batch, window: windows for each step, and poses in each window, the two before the first new one included.
        carry: share of windows that continue from the state where the last window of their slot ended.
        rotated: share of windows that get a random rotation, uniform on SO(3); the others stay upright.
        recombined: more motions made of each one, in which limbs move as in another.
        resting: single poses that go on training the initialiser beside the windows.
        kick: chance in each frame that a carried state is moved by noise; windows that begin anew always are.
        noise: standard deviation added to the first two latents of a window.
        noise_correlation: of the noise on the first latent with that on the second; 0 is the paper's.
        regularity: weight [J] of the regularisation of the latents (Eq. 13); zero for none.
        regularity_scale: distance that garments are to have whose latents are one apart, RMS [m].
        through_time: back-propagate through the whole window, as the paper does, or through each step by itself.
        warm_rate: Adam's step size in the warm start, decaying to a tenth.
        rate, final_rate: Adam's step size in training proper, after its warm-up and at the end (cosine in between).
        skin_rate: factor on the step size of skinning weights and of the integrator's own parameters.
        shape_rate: factor on the step size of blendshapes, all of which move a vertex at once.
        validate_every: iterations between validations; valid_frames: frames of each clip used for them.
        average: decay of the running average of the parameters, which is what is validated and kept; 0 for none.
        surface: nearest body point on "triangles", or at "vertices", which is faster and blunter.
        seed: of everything random.
    """

    iterations: int = 250_000
    warm: float = 0.1
    warm_batch: int = 1024
    batch: int = 256
    window: int = 6
    carry: float = 0.97
    rotated: float = 0.5
    recombined: int = 3
    resting: int = 256
    kick: float = 0.03
    noise: float = 0.1
    noise_correlation: float = 0.99
    regularity: float = 0.0
    regularity_scale: float = 0.03
    through_time: bool = False
    warm_rate: float = 1e-3
    rate: float = 3e-4
    final_rate: float = 2e-5
    rate_warmup: int = 500
    skin_rate: float = 0.1
    shape_rate: float = 0.3
    average: float = 0.998
    surface: str = "triangles"
    validate_every: int = 1000
    valid_frames: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        if self.surface not in SURFACES:
            fail("training", f"surface '{self.surface}'", f"it is one of {', '.join(SURFACES)}")
        if not self.window >= 3:
            fail("training", f"a window of {self.window} poses", "inertia needs at least 3")
        _need_between(self, 1, MOST, "iterations", "batch", "warm_batch", "resting", "validate_every")
        _need_between(self, 3, MOST, "valid_frames")
        _need_between(self, 0, 1, "carry", "rotated", "noise_correlation", "kick")
        _need_between(self, 0, 0.99999, "warm", "average")
        _need_between(
            self, 0, MOST, "noise", "warm_rate", "rate", "final_rate", "rate_warmup", "skin_rate", "shape_rate"
        )
        _need_between(self, 0, MOST, "regularity")
        _need_between(self, 1e-9, MOST, "regularity_scale")
        _need_between(self, 0, 1000, "recombined")
        _need_between(self, 0, 2**63 - 1, "seed")

    @property
    def warm_iterations(self) -> int:
        return int(self.iterations * self.warm)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A model and a schedule under one name."""

    name: str
    model: ModelConfig
    train: TrainConfig


PRESETS = {
    preset.name: preset
    for preset in (
        Preset(
            name="draft",
            model=ModelConfig(latent=32, widths=(128, 128), shapes=24),
            train=TrainConfig(
                iterations=500,
                warm=0.55,
                warm_batch=48,
                warm_rate=2e-3,
                batch=4,
                window=16,
                carry=0.7,
                resting=8,
                recombined=0,
                rotated=0.3,
                rate=6e-4,
                final_rate=1e-4,
                shape_rate=1.0,
                rate_warmup=20,
                average=0.98,
                surface="vertices",
                validate_every=100,
                valid_frames=90,
            ),
        ),
        Preset(
            name="preview",
            model=ModelConfig(),
            train=TrainConfig(iterations=8_000, warm=0.3, shape_rate=1.0, validate_every=800),
        ),
        Preset(name="final", model=ModelConfig(), train=TrainConfig(average=0.9995)),
    )
}


def preset_named(name: str) -> Preset:
    """Return a preset; raise `SsilkError` for an unknown name."""
    if name not in PRESETS:
        fail(f"preset '{name}'", "no such preset", f"it is one of {', '.join(PRESETS)}")
    return PRESETS[name]


def _converted(kind: type, text: str) -> Any:
    if kind is bool:
        return {"true": True, "false": False}[text.lower()]
    return kind(text)


Config = TypeVar("Config")


def overridden(config: Config, assignments: list[str]) -> Config:
    """Return `config` with "name=value" assignments applied, each converted to the field's own type.

    Raises:
        SsilkError: a name that is no field, or a value that does not convert.
    """
    types = {item.name: type(getattr(config, item.name)) for item in fields(config)}  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        if name not in types:
            fail(f"option '{assignment}'", "no such setting", f"settings are {', '.join(types)}")
        try:
            changes[name] = (
                tuple(int(n) for n in text.split(",")) if types[name] is tuple else _converted(types[name], text)
            )
        except (ValueError, KeyError):
            fail(
                f"option '{assignment}'",
                f"'{text}' is not a value for '{name}'",
                f"a value of type {types[name].__name__} is needed",
            )
    return replace(config, **changes)  # type: ignore[type-var]
