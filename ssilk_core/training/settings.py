# SPDX-License-Identifier: Apache-2.0
"""Settings of a training, and the presets."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import fail, fail_unknown
from ..network.settings import NO_BOUND, ModelConfig, need_between

CLOSEST_POINTS, OPTIMISERS = ("triangles", "vertices"), ("adam", "muon")
MOST_OF_ALL = 0.99999  # largest share of static training, and decay of an average
MOST_SMOOTHED_VERTICES = 10_000  # by `training.shape_smoothing`, whose matrix then takes 0.4 GB


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a model is trained (paper, Section 3.7; docs/training.md explains defaults that differ).

    Static training fits the initialiser P and the decoder D to single poses, in their quasi-static states. Dynamic
    training then fits all networks to windows of consecutive poses.

    Attributes:
        iterations: optimiser steps, including those of static training.
        static_fraction: share of the iterations that are static training.
        pretraining_batch: poses in each step of static training.
        batch, window: windows in each step of dynamic training, and poses in each window. The states of the first
            two poses are given.
        state_reuse: share of windows that continue from the final state of the previous window in the same slot.
        rotated_fraction: share of windows with a random rotation, uniform on SO(3); the others stay upright.
        wind_fraction: share of windows in which an even wind pulls on the cloth beside gravity, in any direction,
            with up to `network.settings.STRONGEST_PULL`; it changes now and then.
        collider_fraction: share of windows and poses with obstacles around the character
            (`training.obstacles`), which the network then sees (`network.proximity`).
        recombinations: number of extra motions for each motion, whose limbs move as in another motion; fewer where
            all poses would be more than `training.job.MOST_POSES`.
        perturbations: likewise with joints turned at random. About half go to and fro between these poses and the
            bind pose.
        tumbling: share of these that turn over as a whole, as in flips.
        outlier_energy: stretch and collision at which a frame counts half in the loss, relative to the garment's
            weight times its size; zero for the plain mean over frames, as in the paper (`training.objective.total`).
        newton_weight: weight of the distance to a Newton step beside the energy (`training.newton_distance`); zero
            for the energy alone, as in the paper.
        intersection_weight: tension of the contours along which the garment intersects itself, relative to the
            garment's weight, in dynamic training (`intersections.contours`); zero for cloth that does not know of
            cloth, as in the paper.
        clearance: by which contact begins further from the body in training than in the fabric's own law [m]. A
            network misses the minimum by millimetres; this keeps them off the skin. Zero in the paper.
        static_batch: single poses in each step of dynamic training, to which P is still fitted.
        initial_loss: whether P is fitted to the first two poses of each window, as in the paper.
        noise_probability: probability per frame of noise on a reused state. A new window always starts with noise.
        noise: standard deviation of the noise on the first two latents of a window.
        noise_correlation: correlation between the noise on the first and on the second latent; 0 in the paper.
        latent_regularization: weight [J] of the regularisation of the latents (Eq. 13); zero for none.
        contact_patches: whether tight cloth collides with the part of the body beneath it alone
            (`collision.contacts`); in the paper all cloth collides with all of the body.
        bptt: back-propagate through the whole window, as the paper does, instead of through each step by itself.
        optimiser: of the networks' matrices: "muon" (`training.muon`), or "adam", as for all other parameters and in
            the paper's recipe.
        normalised_gradients: whether the gradient of a step is scaled to length one before the optimiser sees it; the
            paper does not say so.
        static_learning_rate: initial learning rate in static training; it decays to a tenth.
        learning_rate, final_learning_rate: learning rate in dynamic training after the warm-up, and at the
            end of the cosine schedule.
        learning_rate_warmup: iterations over which the learning rate rises at the start of dynamic training.
        integrator_learning_rate_scale: factor on the learning rate of the integrator's own parameters.
        shape_learning_rate_scale: factor on the learning rate of blendshapes, each of which moves many vertices.
        skinning_learning_rate_scale: factor on the learning rate of skinning weights, which act in all poses.
        shape_smoothing: length below which waves of blendshapes change slowly (`training.shape_smoothing`), relative
            to the diagonal of the garment's bounding box; zero for steps that differ from vertex to vertex, as in the
            paper.
        weight_decay: by which the networks' matrices shrink in each step, relative to the learning rate; zero for
            none, as in the paper.
        ema_decay: decay of the exponential moving average of the parameters, which is validated and saved; 0 for
            none. It is smaller at first: `training.step.averaging_decay`.
        closest_point: how the closest body point is found: on the "triangles" of the body, for tight cloth those
            around the nearest vertex, or as the nearest of the "vertices", which is faster and coarser.
        validate_every: iterations between validations.
        valid_frames: frames of each clip that are validated.
        seed: seed of all random numbers.
    """

    iterations: int = 250_000
    static_fraction: float = 0.1
    pretraining_batch: int = 1024
    batch: int = 64
    window: int = 6
    state_reuse: float = 0.97
    rotated_fraction: float = 0.2
    wind_fraction: float = 0.0
    collider_fraction: float = 0.0
    recombinations: int = 3
    perturbations: int = 1
    tumbling: float = 0.25
    outlier_energy: float = 0.1
    newton_weight: float = 0.0
    intersection_weight: float = 0.0
    clearance: float = 5e-3
    static_batch: int = 512
    initial_loss: bool = False
    noise_probability: float = 0.03
    noise: float = 0.03
    noise_correlation: float = 0.99
    latent_regularization: float = 0.0
    contact_patches: bool = True
    bptt: bool = False
    optimiser: str = "muon"
    normalised_gradients: bool = True
    static_learning_rate: float = 1e-3
    learning_rate: float = 3e-4
    final_learning_rate: float = 2e-5
    learning_rate_warmup: int = 500
    integrator_learning_rate_scale: float = 3.0
    shape_learning_rate_scale: float = 0.3
    skinning_learning_rate_scale: float = 0.1
    shape_smoothing: float = 0.03
    weight_decay: float = 0.0
    ema_decay: float = 0.998
    closest_point: str = "triangles"
    validate_every: int = 1000
    valid_frames: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        if self.closest_point not in CLOSEST_POINTS:
            fail_unknown("training", f"closest_point '{self.closest_point}'", self.closest_point, CLOSEST_POINTS)
        if self.optimiser not in OPTIMISERS:
            fail_unknown("training", f"optimiser '{self.optimiser}'", self.optimiser, OPTIMISERS)
        if not self.window >= 3:
            fail("training", f"a window of {self.window} poses", "inertia needs at least 3")
        need_between(self, 1, NO_BOUND, "iterations", "batch", "pretraining_batch", "validate_every")
        need_between(self, 0 if self.initial_loss else 1, NO_BOUND, "static_batch")
        need_between(self, 3, NO_BOUND, "valid_frames")
        need_between(
            self,
            0,
            1,
            "state_reuse",
            "rotated_fraction",
            "wind_fraction",
            "collider_fraction",
            "noise_correlation",
            "noise_probability",
        )
        need_between(self, 0, 1, "shape_smoothing", "tumbling")
        need_between(self, 0, MOST_OF_ALL, "static_fraction", "ema_decay")
        need_between(
            self,
            0,
            NO_BOUND,
            "noise",
            "static_learning_rate",
            "learning_rate",
            "final_learning_rate",
            "learning_rate_warmup",
            "integrator_learning_rate_scale",
            "shape_learning_rate_scale",
            "skinning_learning_rate_scale",
            "outlier_energy",
            "newton_weight",
            "intersection_weight",
            "clearance",
            "weight_decay",
        )
        fastest = max(self.static_learning_rate, self.learning_rate, self.final_learning_rate)
        if not self.weight_decay * fastest < 1:
            fail(
                "training",
                f"weight_decay {self.weight_decay:g} at a learning rate of {fastest:g}",
                "their product must be less than 1",
            )
        need_between(self, 0, NO_BOUND, "latent_regularization")
        need_between(self, 0, 1000, "recombinations", "perturbations")
        need_between(self, 0, 2**63 - 1, "seed")

    @property
    def static_iterations(self) -> int:
        return int(self.iterations * self.static_fraction)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A named pair of model and training settings.

    Attributes:
        fabric: the fabric that is meant, where the command names none; empty for that of the garment.
        material: likewise "name=value" properties of it, before those that the command sets.
    """

    name: str
    model: ModelConfig
    train: TrainConfig
    fabric: str = ""
    material: tuple[str, ...] = ()


PRESETS = {
    preset.name: preset
    for preset in (
        Preset(
            name="draft",
            model=ModelConfig(latent=32, widths=(128, 128), shapes=24, translations=True),
            train=TrainConfig(
                iterations=500,
                static_fraction=0.55,
                pretraining_batch=48,
                batch=4,
                window=16,
                state_reuse=0.7,
                static_batch=8,
                recombinations=0,
                perturbations=0,
                intersection_weight=0.02,
                rotated_fraction=0.3,
                static_learning_rate=2e-3,
                learning_rate=6e-4,
                final_learning_rate=1e-4,
                shape_learning_rate_scale=1.0,
                learning_rate_warmup=20,
                ema_decay=0.98,
                closest_point="vertices",
                validate_every=100,
                valid_frames=90,
            ),
        ),
        Preset(
            name="preview",
            model=ModelConfig(translations=True),
            train=TrainConfig(
                iterations=16_000,
                static_fraction=0.2,
                intersection_weight=0.02,
                wind_fraction=0.25,
                collider_fraction=0.25,
                shape_learning_rate_scale=1.0,
                validate_every=1600,
            ),
        ),
        Preset(
            name="light",
            model=ModelConfig(latent=32, widths=(64, 64), shapes=16),
            train=TrainConfig(
                iterations=16_000,
                static_fraction=0.2,
                intersection_weight=0.02,
                wind_fraction=0.25,
                collider_fraction=0.25,
                shape_learning_rate_scale=1.0,
                validate_every=1600,
            ),
        ),
        Preset(
            name="final",
            model=ModelConfig(shapes=128, translations=True),
            train=TrainConfig(
                iterations=60_000,
                static_fraction=0.5,
                recombinations=24,
                perturbations=24,
                intersection_weight=0.02,
                wind_fraction=0.25,
                collider_fraction=0.25,
                static_learning_rate=5e-4,
                shape_learning_rate_scale=1.0,
                weight_decay=0.5,
                ema_decay=0.9995,
                validate_every=2400,
            ),
        ),
        # The paper's own model and training; docs/training.md tells what it leaves open.
        Preset(
            name="paper",
            model=ModelConfig(
                tanh=False,
                scheme="verlet",
                descriptors="absolute",
                latent_bound=0.0,
                max_latent_step=0.0,
                feedback_points=0,
                feedback_proxies=True,
            ),
            train=TrainConfig(
                iterations=250_000,
                static_fraction=0.0,
                batch=32,
                window=32,
                state_reuse=0.0,
                rotated_fraction=1.0,
                recombinations=0,
                perturbations=0,
                tumbling=0.0,
                outlier_energy=0.0,
                clearance=0.0,
                static_batch=0,
                initial_loss=True,
                noise_probability=0.0,
                noise=0.1,
                noise_correlation=0.0,
                contact_patches=False,
                bptt=True,
                optimiser="adam",
                final_learning_rate=3e-4,
                integrator_learning_rate_scale=1.0,
                shape_learning_rate_scale=1.0,
                skinning_learning_rate_scale=1.0,
                shape_smoothing=0.0,
                ema_decay=0.0,
                closest_point="vertices",
                validate_every=2500,
            ),
            fabric="paper",
            material=("drag=0",),
        ),
    )
}


def preset_named(name: str) -> Preset:
    """Return a preset; raise `SsilkError` for an unknown name."""
    if name not in PRESETS:
        fail_unknown(f"preset '{name}'", "no such preset", name, PRESETS)
    return PRESETS[name]
