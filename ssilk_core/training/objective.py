# SPDX-License-Identifier: Apache-2.0
"""The training objective: physics energies of decoded windows and of single poses (paper, Sections 3.5, 3.6)."""

from __future__ import annotations

import torch
from torch import Tensor

from ..network.model.network import GarmentModel
from ..physics.collision import CollisionBody, Contacts
from ..physics.collision.contacts import no_planes
from ..physics.constants import GRAVITY
from ..physics.energy import GarmentEnergy
from ..physics.energy.factors import FabricFactors, joined_inputs
from ..physics.intersections.contours import IntersectionContours
from ..physics.intersections.figures import INTERSECTION
from ..physics.skinning import Skinning
from ..scene.assets import SkinWeights
from .inner_garments import Beneath, InnerGarments
from .latent_regularization import LATENT_SCALE, latent_distortion
from .motion_bank import MotionBank
from .newton_distance import NewtonDistance
from .obstacles import Near, ObstacleDrawer, Obstacles
from .windows import WindowSampler

Terms = dict[str, Tensor]
REGULARIZATION = "latent regularization"  # a term of latents, which has no frames


class Objective:
    """Computes energies of a model's decoded states; each term is [J] per frame, unreduced.

    Those of a drawn fabric are divided by its factor of density: each fabric counts in units of its own weight.

    Attributes:
        scale: the garment's weight times the diagonal of its bounding box at rest [J].

    Args:
        body: the part of the body that the garment can touch, None for nothing. Pinned vertices do not collide,
            because training cannot move them.
        newton_weight: see `NewtonDistance`; zero for the energy alone.
        clearance, patches: see `settings.TrainConfig`; `patches` is `contact_patches`.
        contours: those of the garment; None for cloth that does not know of cloth.
        inner: garments beneath, which the garment lies on as on the body; none by default.
        buried: limbs that do not count in each frame of the bank, bool (L, F), where they are known
            (`LimbPoser.buried`).
        drawer: of obstacles, which tells what the network sees of them; None for none.
    """

    def __init__(
        self,
        model: GarmentModel,
        energy: GarmentEnergy,
        body: CollisionBody | None,
        bank: MotionBank,
        surface: bool = True,
        newton_weight: float = 0.0,
        clearance: float = 0.0,
        buried: Tensor | None = None,
        patches: bool = True,
        contours: IntersectionContours | None = None,
        inner: InnerGarments | None = None,
        drawer: ObstacleDrawer | None = None,
    ) -> None:
        self.model, self.energy, self.bank = model, energy, bank
        self.surface, self.clearance, self.buried = surface, clearance, buried
        self.contours, self.inner, self.drawer = contours, inner, drawer
        self.body, device = body, bank.static.device
        if body:
            self.contacts = Contacts(
                model.scene,
                energy.cloth.samples,
                vertices=body.vertices,
                pinned=False,
                patches=patches,
                device=device,
            )
        self.skin = None
        if len(tethered := energy.tethered.cpu().numpy()):
            skin = model.scene.lbs_skin
            rows = SkinWeights(skin.path, skin.indices[tethered], skin.weights[tethered])
            self.skin = Skinning(rows).to(device)
            rest = model.scene.garment.mesh.points[tethered]
            self.tethered_rest = torch.tensor(rest, dtype=torch.float32, device=device)
        self.dt, self.hub = 1 / model.config.fps, model.scene.character.skeleton.hub
        self.newton = NewtonDistance(model.scene, energy, self.dt, newton_weight) if newton_weight else None
        self.scale = GRAVITY * float(energy.mass.sum()) * model.scene.garment.mesh.diagonal

    def wear(self, place: Tensor) -> None:
        """Hold tight cloth where it lies on the body of the model's family at coordinates (K,)."""
        if self.skin:
            self.tethered_rest.copy_(self.model.worn.at(place)[0][self.energy.tethered])

    def quasi_static_terms(
        self,
        x: Tensor,
        down: Tensor,
        character: Tensor,
        buried: Tensor | None = None,
        beneath: Beneath | None = None,
        obstacles: Obstacles | None = None,
        factors: FabricFactors | None = None,
    ) -> Terms:
        """Return all terms but inertia and drag of positions x (V, 3, N) under gravity and wind (N, 3) [g].

        Args:
            buried: limbs that do not count, where they are known (`LimbPoser.buried`).
            beneath: inner garments in these frames, where there are any.
            obstacles: likewise what else is there.
            factors: of the fabric in these frames; the model's own by default.
        """
        energy, root = self.energy, character[self.hub, :, 3]  # heights over the root keep the value of gravity small
        stretch, bending = energy.elastic(x, factors)
        sampled = energy.cloth.positions(x)
        planes = self._planes(sampled.detach(), character, buried, beneath, obstacles)
        gravity, collision = energy.gravity_and_collision(x, root, GRAVITY * down.T, sampled, *planes, factors)
        if self.newton:
            self.newton.planes = planes
        terms = {"stretch": stretch, "bending": bending, "gravity": gravity, "collision": collision}
        if self.skin:
            terms["tether"] = energy.tether(x, self.skin(self.tethered_rest, None, self.skin.weights, character))
        if energy.stitching:
            terms["stitch"] = energy.stitch(x)
        return {name: value / factors.density for name, value in terms.items()} if factors else terms

    def _planes(
        self,
        x: Tensor,
        character: Tensor,
        buried: Tensor | None = None,
        beneath: Beneath | None = None,
        obstacles: Obstacles | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the plane that each sample x (S, 3, N) can touch, moved outwards by the clearance.

        Returns:
            Normals (S, 3, N) and offsets (S, N).
        """
        if self.body is None:
            normal, offset = no_planes(x)
        else:
            normal, offset = self.contacts.planes(x, self.body.pose(character, surface=self.surface, buried=buried))
        if self.inner and beneath:
            normal, offset = self.inner.deeper((normal, offset), x, beneath)
        if obstacles:
            return obstacles.nearer_planes(x, normal, offset, self.clearance)
        return normal, offset + self.clearance

    def _buried(self, frames: Tensor) -> Tensor | None:
        return None if self.buried is None else self.buried[:, frames]

    def static(
        self,
        frames: Tensor,
        down: Tensor,
        beneath: Beneath | None = None,
        obstacles: Obstacles | None = None,
        fabric: Tensor | None = None,
    ) -> Terms:
        """Return the terms of the initialiser's quasi-static states on single poses (Section 3.1).

        Args:
            beneath: inner garments in these poses, where there are any.
            obstacles: likewise what else is there.
            fabric: features of the fabric in these poses (N, 5); the model's own by default.
        """
        near = self._near(frames, down, obstacles, fabric)
        z = self.model.initial(self._static_descriptor(frames, down, near, fabric))
        character = self.bank.character(frames)
        x = self._vertices(z, character, 0)
        factors = None if fabric is None else FabricFactors.of(fabric)
        return self.quasi_static_terms(x, down, character, self._buried(frames), beneath, obstacles, factors)

    def _near(self, frames: Tensor, down: Tensor, obstacles: Obstacles | None, fabric: Tensor | None) -> Near | None:
        """Return what is near in frames (N,) under gravity and wind (N, 3) [g]; None without obstacles."""
        return None if obstacles is None or self.drawer is None else self.drawer.near(obstacles, frames, down, fabric)

    def _static_descriptor(self, frames: Tensor, down: Tensor, near: Near | None, fabric: Tensor | None) -> Tensor:
        """Return static descriptors (N, S) of frames (N,), with fabrics and the proximity of obstacles, if any."""
        parts = [self.bank.static_descriptor(frames, down)]
        if near is not None and self.drawer is not None:
            parts.insert(0, self.drawer.seen(near, frames))
        if fabric is not None:
            parts.insert(0, fabric)
        return torch.cat(parts, dim=1) if len(parts) > 1 else parts[0]

    def _vertices(self, z: Tensor, character: Tensor, moving: int) -> Tensor:
        """Decode latents (N, latent), of which so many have inertia, to positions (V, 3, N)."""
        x = self.model.vertices(z, character)
        return self.newton.attach(x, moving) if self.newton else x

    def window(
        self,
        sampler: WindowSampler,
        noise: Tensor,
        frames: Tensor,
        single_down: Tensor,
        single_obstacles: Obstacles | None = None,
        single_fabric: Tensor | None = None,
    ) -> tuple[Terms, Terms, Tensor]:
        """Roll one window of every slot.

        Args:
            sampler: frames and states of the windows.
            noise: added to the first two latents, shape (2, batch, latent).
            frames, single_down: single poses for the initialiser (M,), and their gravity and wind (M, 3) [g].
            single_obstacles: around these, where there are any.
            single_fabric: features of their fabrics (M, 5), where these are drawn.

        Returns:
            Terms of the frames from the third on, terms of the quasi-static states of the single poses, and the last
            two latents (2, batch, latent) for the next window.
        """
        model, bank = self.model, self.bank
        length, batch = sampler.config.window, len(sampler.first)
        count = (length - 2) * batch
        times, down = sampler.frames().reshape(-1), sampler.gravity().flatten(0, 1)
        fabric = None if sampler.fabric is None else sampler.fabric.repeat(length, 1)
        z, rolled = self._rolled(sampler, noise, times, down, fabric)
        near = self._near(frames, single_down, single_obstacles, single_fabric)
        quiet = model.initial(self._static_descriptor(frames, single_down, near, single_fabric))
        with torch.no_grad():
            past = model.vertices(torch.cat(z[:2]), bank.character(times[: 2 * batch]))
        # One decoder call for the windows from the third frame on and the single poses.
        asked = torch.cat([times[2 * batch :], frames])
        character = bank.character(asked)
        x = self._vertices(torch.cat([rolled, quiet]), character, count)
        beneath = self.inner.window(sampler, frames, single_down, single_obstacles) if self.inner else None
        pulled = torch.cat([down[2 * batch :], single_down])
        met = None
        if sampler.obstacles and single_obstacles:
            met = sampler.obstacles.repeated(length - 2).joined(single_obstacles)
        drawn_fabrics = joined_inputs(None if fabric is None else fabric[2 * batch :], single_fabric)
        factors = None if drawn_fabrics is None else FabricFactors.of(drawn_fabrics)
        terms = self.quasi_static_terms(x, pulled, character, self._buried(asked), beneath, met, factors)
        if self.contours:
            terms[INTERSECTION] = self.contours.energy(x)
        dynamic = {name: value[:count] for name, value in terms.items()}
        single = {name: value[count:] for name, value in terms.items()}
        moving = factors.first(count) if factors else None
        dynamic["inertia"], dynamic["drag"] = self._kinetic(x, past, times, batch, moving)
        if weight := sampler.config.latent_regularization:
            drawn = torch.cat([rolled[-batch:], quiet])
            dynamic[REGULARIZATION] = weight * latent_distortion(model, self.energy.mass, drawn, LATENT_SCALE)
        return dynamic, single, torch.stack(z[-2:]).detach()

    def _rolled(
        self, sampler: WindowSampler, noise: Tensor, times: Tensor, down: Tensor, fabric: Tensor | None
    ) -> tuple[list[Tensor], Tensor]:
        """Roll one window of every slot, with noise as for `window`.

        Args:
            times: frames of the windows, one frame of every slot after another (N,).
            down: gravity and wind in these [g], (N, 3).
            fabric: features of their fabrics (N, 5), where these are drawn.

        Returns:
            The latents of each frame, (batch, latent) each, and with gradients those from the third on, joined.
        """
        model, length, batch = self.model, sampler.config.window, len(sampler.first)
        near = self._near(times, down, sampler.obstacles and sampler.obstacles.repeated(length), fabric)
        static = self._static_descriptor(times, down, near, fabric)
        heading = None if sampler.heading is None else sampler.heading.repeat(length, 1)
        pose = self.bank.described(static, times, down, heading).reshape(length, batch, -1)
        # Beside a stepper, the initialiser is trained on the energy of its own states, not on that of later frames.
        with torch.set_grad_enabled(not model.integrator.scheme.states):
            target = model.initial(static).reshape(length, batch, -1)
            start = torch.where(sampler.carried[None, :, None], sampler.latents, target[:2])
        body = self.bank.body(times.reshape(length, batch))
        if near is not None:
            body = near.stopping(body, model.feedback.stopped, length)
        with torch.set_grad_enabled(sampler.config.bptt):
            z = model.roll([*(start + noise)], target[2:], pose[2:], body)
        if sampler.config.bptt:
            return z, torch.cat(z[2:])
        # Repeat all steps at once, from states without gradients.
        states = torch.cat(z)
        before, now = states[: -2 * batch], states[batch:-batch]
        with torch.no_grad():
            seen = model.seen_from(before, now, body.triples())
        return z, model.step(before, now, target[2:].flatten(0, 1), pose[2:].flatten(0, 1), seen)

    def _kinetic(
        self, x: Tensor, past: Tensor, times: Tensor, batch: int, factors: FabricFactors | None
    ) -> tuple[Tensor, Tensor]:
        """Return inertia and drag of the windows from the third frame on, whose positions come first in x (V, 3, N).

        Args:
            past: positions in the first two frames, (V, 3, 2 batch).
            times: frames of the windows, (window * batch,).
        """
        path = torch.cat([past, x[..., : len(times) - 3 * batch].detach()], dim=-1)
        root = self.bank.root_at(times).T
        shift = root[:, 2 * batch :] - root[:, batch:-batch]
        inertia, drag = self.energy.inertia_and_drag(
            x, path[..., batch:], path[..., :-batch], shift, self.dt, factors
        )
        return (inertia / factors.density, drag / factors.density) if factors else (inertia, drag)


def total(terms: Terms, half: float = 0.0) -> Tensor:
    """Return the sum of all terms, averaged over frames [J].

    Poses in which body parts lie inside one another have no good state. Their energies are hundreds of times those of
    others, and a network that is trained on the mean gives up the others for them. So each frame is divided by
    1 + (stretch + collision) / half, without a gradient: every pose keeps the minimum of its energy.

    Args:
        half: stretch and collision at which a frame counts half [J]; zero for the plain mean.
    """
    if half:
        share = half / (half + (terms["stretch"] + terms["collision"]).detach())
        terms = {name: value if name == REGULARIZATION else value * share for name, value in terms.items()}
    return sum(value.mean() for value in terms.values())  # type: ignore[return-value]
