# SPDX-License-Identifier: Apache-2.0
"""The whole model: initialiser P, stepper S, decoder D and the deformation they drive (paper, Figure 2)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from ...errors import fail
from ...scene.assets import Deformer, Floats, GarmentPose, Motion, Scene, SkinWeights
from ...scene.family import DressedFamily
from ...scene.kinematics import ProxyAxes
from ..parameters import descriptor_sizes
from ..proximity import PLANE, proximity_size, proximity_vertices, sees_at
from ..settings import ModelConfig
from .bodies import SeenBody, WornCloth, see_bodies
from .decoder import Decoder
from .fabrics import see_fabrics
from .feedback import BodyFrames, DecodedState, Feedback, PointDecoder
from .integrators import integrator


def mlp(
    inputs: int, widths: tuple[int, ...], outputs: int, generator: torch.Generator, last: float, bias: bool = True
) -> nn.Sequential:
    """Return a multilayer perceptron with SiLU; `last` scales the initial weights of the last layer."""
    sizes = [inputs, *widths, outputs]
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        final = index == len(sizes) - 2
        linear = nn.Linear(fan_in, fan_out, bias=bias or not final)
        with torch.no_grad():
            scale = (last if final else 1.0) * (2 / fan_in) ** 0.5
            linear.weight.copy_(scale * torch.randn(fan_out, fan_in, generator=generator))
            if linear.bias is not None:
                linear.bias.zero_()
        layers += [linear] if final else [linear, nn.SiLU()]
    return nn.Sequential(*layers)


class GarmentModel(nn.Module):
    """A garment on a character, as a latent simulator.

    Args:
        scene: character, garment and rig.
        config: sizes of the network.
        joints: character joints in the descriptors (`descriptors.descriptor_joints`).
        seed: of the initial parameters.
        family: bodies that it is trained for, of which it sees the one that it is on; the scene's alone by default.
        fabrics: number of features of the fabric that P and S see in training (`network.fabrics`); none by default.

    Attributes:
        fabric: these features where descriptors lack them, shape (fabrics,); zero for the model's own fabric.
    """

    fabric: Tensor

    def __init__(
        self,
        scene: Scene,
        config: ModelConfig,
        joints: np.ndarray,
        seed: int = 0,
        family: DressedFamily | None = None,
        fabrics: int = 0,
    ) -> None:
        super().__init__()
        self.scene, self.config, self.joints = scene, config, np.asarray(joints, dtype=np.int64)
        self.axes = ProxyAxes.of(scene)
        generator = torch.Generator().manual_seed(seed)
        self.decoder = Decoder(scene, config, generator)
        static, dynamic = descriptor_sizes(scene, self.joints, config)
        self.proximity, self.described = proximity_size(scene, config), fabrics + static + dynamic
        self.static, z = fabrics + static, config.latent
        self.initialiser = mlp(static, config.widths, z, generator, 1.0)
        # Zero: training starts as the scheme integrates without S.
        self.integrator = integrator(config, dynamic)
        scheme, self.feedback = self.integrator.scheme, Feedback(scene, config, self.decoder)
        self.sight = PointDecoder(proximity_vertices(scene, config), self.decoder)
        inputs = scheme.states * z + static + dynamic + self.feedback.size
        self.stepper = (
            mlp(inputs, config.widths, z, generator, 0.0, scheme.bias) if scheme.states else nn.Sequential()
        )
        # Small: training starts as linear blend skinning.
        self.output = mlp(z, config.widths, self.decoder.output_count, generator, 0.01)
        self.register_buffer("fabric", torch.zeros(fabrics), persistent=False)
        if fabrics:
            see_fabrics(self, fabrics, scheme.states * z)
        self.family = family
        if family:
            self.worn = WornCloth(family, self.decoder.rest, self.decoder.pivots)
            see_bodies(self, family)

    @torch.no_grad()
    def wear(self, place: Tensor) -> None:
        """Put the garment on the body of its family at coordinates (K,), in place; the base's are zero."""
        for module in self.modules():
            if isinstance(module, SeenBody):
                module.place.copy_(place)
        rest, pivots = self.worn.at(place)
        self.decoder.rest.copy_(rest)
        self.decoder.pivots.copy_(pivots)

    def initial(self, static: Tensor) -> Tensor:
        """Return quasi-static latents (N, latent) from static descriptors (Eq. 1)."""
        return self.integrator.bound(self.initialiser(self.completed(static, self.static)))

    def completed(self, values: Tensor, size: int) -> Tensor:
        """Return descriptors (..., size); those without features of proximity have nothing near.

        Features of the fabric come first, then those of proximity. Where there are none, the fabric is `fabric`.

        Raises:
            SsilkError: they have the proximity of another number of points.
        """
        fabrics, near = len(self.fabric), values.shape[-1] - size + self.proximity
        if fabrics and near in (0, self.proximity):  # as many as are left out may be features of the fabric
            given, rest = values[..., :fabrics], values[..., fabrics:]
        else:
            given, rest, near = None, values, near + fabrics
        if near not in (0, self.proximity):
            fail(self.scene.garment.mesh.path, f"proximity at {near // 3} points", *sees_at(self.proximity))
        rest = rest if near == self.proximity else nn.functional.pad(rest, (self.proximity, 0))
        if not fabrics:
            return rest
        given = self.fabric.expand(*rest.shape[:-1], fabrics) if given is None else given
        return torch.cat([given, rest], dim=-1)

    def step(self, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor, seen: Tensor) -> Tensor:
        """Return z_t from the two latents before it, the quasi-static one of frame t, and its dynamic descriptor.

        Args:
            seen: what S sees of the cloth, as `seen` returns it.
        """
        return self.integrator(self.stepper, before, now, rest, self.completed(pose, self.described), seen)

    def body_frames(self, motion: Motion, world: Floats) -> BodyFrames:
        """Return a motion as the feedback needs it, from its joint-to-world transforms (F, J, 4, 4)."""
        body = BodyFrames.of(world, self.scene.character.skeleton, self.decoder.shapes)
        if motion.proximity is None or not self.feedback.stopped:
            return body
        planes = motion.proximity[:, : self.feedback.stopped, PLANE, None]
        return BodyFrames(body.matrices, body.bend, torch.as_tensor(planes).to(body.bend))

    @torch.no_grad()
    def resting(self, static: Tensor, matrices: Tensor) -> Tensor:
        """Return the points (M, 3, N) [m] at which the network sees colliders, at rest without any.

        Args:
            static: descriptors without proximity, shape (N, S), which may have features of the fabric.
            matrices: of the character, shape (J, 3, 4, N).
        """
        return self.sight(self.decoder, self.output(self.initial(static)), matrices)

    def decoded(self, z: Tensor, body: BodyFrames) -> DecodedState:
        """Return latents (N, latent) as the feedback looks back on them, under a character in one frame."""
        return self.feedback.decoded(self.decoder, self.output(z), body)

    def seen(self, past: tuple[DecodedState, DecodedState] | None, body: BodyFrames) -> Tensor:
        """Return what S sees of the cloth in the frame of `body` (N, size), from the two states before it."""
        if past is None:
            return body.bend.new_zeros(body.bend.shape[-1], 0)
        return self.feedback.seen(self.decoder, past, body)

    def seen_from(self, before: Tensor, now: Tensor, body: BodyFrames) -> Tensor:
        """Return what S sees in the last of three frames of `body`, from the latents of the first two."""
        if not self.feedback.size:
            return self.seen(None, body[2:])
        return self.seen((self.decoded(before, body[:1]), self.decoded(now, body[1:2])), body[2:])

    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames) -> list[Tensor]:
        """Return `states`, each (batch, latent), followed by those of the next frames.

        Args:
            states: at least the two before the first of these frames.
            rest: quasi-static latents of the frames, shape (F, batch, latent).
            pose: their dynamic descriptors, shape (F, batch, D).
            body: the character in the two frames before and in these, F + 2.
        """
        states, past = list(states), None
        features, pose = self.feedback.size, self.completed(pose, self.described)
        precomputed = self.integrator.precompute(self.stepper, rest.flatten(0, 1), pose.flatten(0, 1), features)
        if features and len(rest):
            past = self.decoded(states[-2], body[:1]), self.decoded(states[-1], body[1:2])
        for frame, given in enumerate(zip(*(values.unflatten(0, rest.shape[:2]) for values in precomputed)), 2):
            seen = self.seen(past, body[frame : frame + 1])
            states.append(self.integrator.step(self.stepper, states[-2], states[-1], given, seen))
            if past:
                past = past[1], self.decoded(states[-1], body[frame : frame + 1])
        return states

    def pose(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return activations (K, N) and proxy transforms (P, 3, 4, N) of latents (N, latent) (Eq. 7)."""
        return self.decoder.activations(self.output(z))

    def vertices(self, z: Tensor, character: Tensor) -> Tensor:
        """Decode latents (N, latent) over character skinning matrices (J, 3, 4, N) to positions (V, 3, N) [m]."""
        return self.decoder.vertices(self.output(z), character)

    @torch.no_grad()
    def deformer(self) -> Deformer:
        """Return the trained garment for files: shapes for weights in [0, 1], with W^g and W^p made sparse.

        An activation a in [-r, r] is the weight w = (a / r + 1) / 2 of the shape 2 r B_k, with the range r of the
        configuration. The last shape, -r sum_k B_k, has a constant weight of one: it moves the middle of the range
        back to the rest shape, or to that of a reduced model.
        """
        scene, decoder = self.scene, self.decoder
        dense = np.zeros((scene.garment.mesh.vertex_count, len(scene.joint_names)))
        dense[:, decoder.used.cpu().numpy()] = decoder.skin_weights().double().cpu().numpy()
        skin = SkinWeights.from_dense(scene.rig.path, dense)
        free = decoder.shapes.double().permute(2, 0, 1).cpu().numpy()
        shapes = np.zeros((decoder.shape_count, scene.garment.mesh.vertex_count, 3))
        shapes[:, decoder.free.cpu().numpy()] = 2 * self.config.activation_range * free
        if decoder.has_constant:
            constant = -shapes.sum(0, keepdims=True) / 2
            constant[0, decoder.free.cpu().numpy()] += decoder.offset.cpu().numpy()
            shapes = np.concatenate([shapes, constant])
        return Deformer(scene, skin, shapes)

    @torch.no_grad()
    def file_pose(self, activation: Tensor, transforms: Tensor) -> tuple[Floats, Floats, Floats | None]:
        """Return the values that a file stores, as `GarmentPose` has them.

        Returns:
            Local proxy quaternions (N, P, 4), weights (N, K + 1) in [0, 1], and local translations (N, P, 3) [m],
            None where proxies do not move.
        """
        turned, moved = self.axes.to_local(transforms.double().permute(3, 0, 1, 2).cpu().numpy())
        weights = (activation.double().T.cpu().numpy() / self.config.activation_range + 1) / 2
        if self.decoder.has_constant:
            weights = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
        return turned, weights.clip(0, 1), moved if self.config.translations else None

    @torch.no_grad()
    def network_pose(self, pose: GarmentPose) -> tuple[Tensor, Tensor]:
        """Invert `file_pose`: activations (K, N) and transforms (P, 3, 4, N), on the model's device."""
        parameter = self.decoder.shapes
        transforms = self.axes.to_bind(pose.rotations, pose.translations)
        activation = 2 * pose.weights[:, : self.decoder.shape_count].astype(np.float64).T - 1
        activation *= self.config.activation_range
        return (
            torch.as_tensor(activation, dtype=torch.float32, device=parameter.device),
            torch.as_tensor(transforms.transpose(1, 2, 3, 0), dtype=torch.float32, device=parameter.device),
        )
