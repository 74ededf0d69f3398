# SPDX-License-Identifier: Apache-2.0
"""The windows that each slot of a batch trains on, and the states carried from window to window."""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import fail
from ..network.settings import STRONGEST_PULL
from .fabrics import FabricDrawer
from .motion_bank import MotionBank
from .obstacles import ObstacleDrawer, Obstacles
from .settings import TrainConfig


def random_directions(count: int, rotated: float, generator: torch.Generator, device: torch.device) -> Tensor:
    """Return unit gravity directions (count, 3): uniform on the sphere for a share `rotated`, else straight down.

    Rotating the character by R under gravity g is equivalent to rotating gravity by R^T, because all other energies
    are invariant under rotations. Rotations about g change nothing, so the sphere covers SO(3).
    """
    draw = torch.randn(count, 3, generator=generator, device=device)
    anywhere = draw / draw.norm(dim=1, keepdim=True).clamp_min(1e-6)
    turned = torch.rand(count, 1, generator=generator, device=device) < rotated
    down = -torch.eye(3, device=device)[1]  # created on the device: a captured graph must not copy from the host
    return torch.where(turned, anywhere, down)


GUSTS = 0.1  # chance that the wind changes within a window that continues another


def random_pulls(count: int, share: float, generator: torch.Generator, device: torch.device) -> Tensor:
    """Return what wind adds to gravity (count, 3) [g]: in any direction, of any strength, for a share; else zero."""
    draw = torch.randn(count, 3, generator=generator, device=device)
    size, chance = torch.rand(2, count, 1, generator=generator, device=device)
    pull = STRONGEST_PULL * size * draw / draw.norm(dim=1, keepdim=True).clamp_min(1e-6)
    return torch.where(chance < share, pull, torch.zeros_like(pull))


def random_headings(direction: Tensor, generator: torch.Generator) -> Tensor:
    """Return directions (N, 3) for `turned_vectors`: at random where gravity was turned; else x turns nothing."""
    draw = torch.randn(direction.shape, generator=generator, device=direction.device)
    identity = torch.eye(3, device=direction.device)
    return torch.where((direction == -identity[1]).all(1, keepdim=True), identity[0], draw)


class WindowSampler:
    """Draws windows; a share of the slots continues its clip and gravity from the last window.

    Attributes:
        first: first frame of each slot's window, shape (batch,).
        direction: gravity direction of each slot, shape (batch, 3).
        pull: what wind adds to gravity in the first and in the last frame of the window [g], between which it
            changes evenly, shape (2, batch, 3); None where nothing blows.
        heading: likewise how a slot is turned about gravity, for absolute descriptors; None for relative ones.
        latents: the two states from which a continued window starts, shape (2, batch, latent).
        carried: which slots continue, shape (batch,).
        obstacles: around each slot's character; None where none are drawn.
        around: coordinates of the body of a family that they were drawn around, shape (K,); None for one body alone.
        fabric: features of each slot's fabric (batch, 5); None where all are of the model's own.
        inner: what inner garments keep from window to window, by name (`InnerGarments.attach`); nothing by default.
    """

    def __init__(
        self,
        bank: MotionBank,
        config: TrainConfig,
        latent: int,
        generator: torch.Generator,
        drawer: ObstacleDrawer | None = None,
        fabrics: FabricDrawer | None = None,
    ) -> None:
        self.bank, self.config, self.generator, self.drawer = bank, config, generator, drawer
        self.fabrics = fabrics
        device = bank.static.device
        stops = bank.stops.repeat_interleave(bank.stops - bank.starts)
        frames = torch.arange(bank.frame_count, device=device)
        self.stop_of = stops
        self.candidates = frames[frames + config.window <= stops]
        longest = int((bank.stops - bank.starts).max())
        if not len(self.candidates):
            fail(
                "motions",
                f"the longest clip has {longest} frames at the model's rate",
                f"a window of {config.window} poses must fit",
                "give longer motions or set --set window=N",
            )
        self.first = self._fresh()
        self.direction = random_directions(config.batch, config.rotated_fraction, generator, device).clone()
        self.pull = self._pulls().repeat(2, 1, 1) if config.wind_fraction else None
        self.heading = random_headings(self.direction, generator) if bank.is_absolute else None
        self.latents = torch.zeros(2, config.batch, latent, device=device)
        self.carried = torch.zeros(config.batch, dtype=torch.bool, device=device)
        self.obstacles = drawer.draw(self.frames(), self.direction) if drawer else None
        self.around = None if drawer is None or drawer.worn is None else drawer.worn.clone()
        self.fabric = fabrics.draw(config.batch) if fabrics else None
        self.inner: dict[str, Tensor] = {}

    def _fresh(self) -> Tensor:
        pick = torch.rand(self.config.batch, generator=self.generator, device=self.candidates.device)
        return self.candidates[(pick * len(self.candidates)).long().clamp_max(len(self.candidates) - 1)]

    def _pulls(self) -> Tensor:
        return random_pulls(self.config.batch, self.config.wind_fraction, self.generator, self.candidates.device)

    def frames(self) -> Tensor:
        """Return the frames of the windows, shape (window, batch)."""
        return self.first + torch.arange(self.config.window, device=self.first.device)[:, None]

    def obstacles_at(self, frames: Tensor, direction: Tensor) -> Obstacles | None:
        """Draw obstacles for single poses (M,) under gravity (M, 3), without wind; None where none are drawn."""
        return self.drawer.draw(frames[None], direction) if self.drawer else None

    def gravity(self) -> Tensor:
        """Return gravity and wind in each frame of the windows [g], shape (window, batch, 3)."""
        length = self.config.window
        if self.pull is None:
            return self.direction.expand(length, *self.direction.shape)
        part = torch.linspace(0, 1, length, device=self.pull.device)[:, None, None]
        return self.direction + torch.lerp(self.pull[0], self.pull[1], part)

    def poses(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw single poses from all frames: frames (count,), gravity and wind [g], and gravity alone, (count, 3)."""
        bank, device = self.bank, self.candidates.device
        draw = torch.rand(count, generator=self.generator, device=device)
        frames = (draw * bank.frame_count).long().clamp_max(bank.frame_count - 1)
        gravity = direction = random_directions(count, self.config.rotated_fraction, self.generator, device)
        if self.config.wind_fraction:
            gravity = direction + random_pulls(count, self.config.wind_fraction, self.generator, device)
        return frames, gravity, direction

    def fabrics_of_poses(self, count: int) -> Tensor | None:
        """Draw features of the fabrics of single poses, shape (count, 5); None where none are drawn."""
        return self.fabrics.draw(count) if self.fabrics else None

    def with_initial(self, frames: Tensor, gravity: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return single poses (M,), (M, 3), (M, 3) followed by the first two of each window."""
        own = torch.cat([self.first, self.first + 1])
        pulled = torch.cat([gravity, self.gravity()[:2].flatten(0, 1)])
        return torch.cat([frames, own]), pulled, torch.cat([direction, self.direction.repeat(2, 1)])

    def fabrics_with_initial(self, fabric: Tensor | None) -> Tensor | None:
        """Return likewise features (M, 5) of fabrics followed by those of the windows."""
        return None if fabric is None or self.fabric is None else torch.cat([fabric, self.fabric, self.fabric])

    def noise(self) -> Tensor:
        """Return noise for the first two latents of each window, shape (2, batch, latent).

        The noise on both is strongly correlated: it displaces the garment rather than accelerates it. Independent
        noise of this size would be a velocity ten times that of everyday motion. New windows always get noise,
        continued ones with `noise_probability` in each frame.
        """
        config, device = self.config, self.latents.device
        first, second = torch.randn(self.latents.shape, generator=self.generator, device=device)
        second = config.noise_correlation * first + (1 - config.noise_correlation**2) ** 0.5 * second
        chance = 1 - (1 - config.noise_probability) ** (config.window - 2)
        kicked = torch.rand(config.batch, 1, generator=self.generator, device=device) < chance
        return config.noise * torch.stack([first, second]) * (kicked | ~self.carried[:, None])

    def advance(self, latents: Tensor) -> None:
        """Keep the last two `latents` (2, batch, latent) of the windows, then choose the next windows."""
        config, device = self.config, self.first.device
        following = self.first + config.window - 2
        fits = following + config.window <= self.stop_of[self.first]
        wish = torch.rand(config.batch, generator=self.generator, device=device) < config.state_reuse
        fresh = random_directions(config.batch, config.rotated_fraction, self.generator, device)
        chosen = self._fresh()
        # States that are not finite must not be reused.
        go_on = fits & wish & latents.isfinite().all(dim=2).all(dim=0)
        self.first.copy_(torch.where(go_on, following, chosen))
        self.direction.copy_(torch.where(go_on[:, None], self.direction, fresh))
        if self.pull is not None:
            reached, pull = torch.lerp(self.pull[0], self.pull[1], 1 - 1 / (config.window - 1)), self._pulls()
            gust = torch.rand(config.batch, generator=self.generator, device=device) < GUSTS
            first = torch.where(go_on[:, None], reached, pull)
            self.pull.copy_(torch.stack([first, torch.where((go_on & ~gust)[:, None], self.pull[1], pull)]))
        if self.heading is not None:
            self.heading.copy_(torch.where(go_on[:, None], self.heading, random_headings(fresh, self.generator)))
        if self.fabrics and self.fabric is not None:
            other = ~go_on[:, None] | self.fabrics.changed(config.batch)
            self.fabric.copy_(torch.where(other, self.fabrics.draw(config.batch), self.fabric))
        if self.drawer and self.obstacles:
            kept = self.drawer.drawn_back(self.obstacles, self.frames())
            # Those of a family's new windows are drawn around the body that the next step is done on.
            drawn = self.drawer.draw(self.frames(), self.direction) if self.around is None else kept
            self._choose(go_on, kept, drawn)
        self.latents.copy_(latents.detach())
        self.carried.copy_(go_on)

    def change_body(self) -> None:
        """Draw obstacles of new windows around the body of a family that is worn now, and bring those of others."""
        if self.drawer is None or self.obstacles is None or self.around is None or self.drawer.worn is None:
            return
        drawn = self.drawer.draw(self.frames(), self.direction)
        brought = self.drawer.brought(self.obstacles, self.frames(), self.around)
        self._choose(self.carried, brought, drawn)
        self.around.copy_(self.drawer.worn)

    def _choose(self, chosen: Tensor, kept: Obstacles, drawn: Obstacles) -> None:
        """Take obstacles that are kept in slots that are `chosen` (batch,), and others elsewhere, in place."""
        assert self.obstacles is not None
        for own, old, new in zip(self.obstacles.parts, kept.parts, drawn.parts):
            own.copy_(torch.where(chosen.reshape(1, -1, *[1] * (own.ndim - 2)), old, new))

    def window(self) -> dict[str, Tensor]:
        """Return the current windows as tensors by name."""
        names = ("first", "direction", "latents", "carried", "heading", "pull", "around", "fabric")
        found = {name: value for name in names if (value := getattr(self, name)) is not None}
        if self.obstacles:
            found |= {f"obstacles.{name}": value for name, value in vars(self.obstacles).items()}
        return found | self.inner

    def state(self) -> dict[str, Tensor]:
        """Return all that a resumed run needs to continue exactly, random state included."""
        return {**self.window(), "generator": self.generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the result of `state`."""
        for name, value in self.window().items():
            value.copy_(state[name])
        self.generator.set_state(state["generator"].cpu().to(torch.uint8))
