# SPDX-License-Identifier: Apache-2.0
"""One optimiser step of either phase, eager or replayed as a CUDA graph."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ..network.model.bodies import on_one_body
from ..network.model.network import GarmentModel
from ..physics import loops
from .bodies import DrawnBodies
from .memory import decoded_frames
from .muon import Muon
from .objective import Objective, total
from .settings import TrainConfig
from .shape_smoothing import ShapeSmoothing
from .skipped_steps import SkippedSteps
from .windows import WindowSampler

MIN_GRADIENT_NORM = 1e-30  # floor for the norm that gradients are divided by
SMALL_PRODUCT = 1 << 24  # multiplications: 1 ms of one core
EAGER_STEPS = 3  # before a CUDA graph is captured: allocators, handles and kernels settle


def learning_rate(config: TrainConfig, iteration: int) -> float:
    """Return the learning rate of an iteration: in each phase a linear warm-up, then cosine decay."""
    static = config.static_iterations
    if iteration < static:
        # At a constant rate the energy rises again in static training.
        done, span, peak, final = iteration, static, config.static_learning_rate, 0.1 * config.static_learning_rate
    else:
        done, span, peak, final = (
            iteration - static,
            config.iterations - static,
            config.learning_rate,
            config.final_learning_rate,
        )
    ramp = min(1.0, (done + 1) / max(1, config.learning_rate_warmup))
    return ramp * (final + (peak - final) * 0.5 * (1 + math.cos(math.pi * done / max(1, span))))


def averaging_decay(config: TrainConfig, iteration: int) -> float:
    """Return the decay of the average at an iteration: min(ema_decay, (1 + t) / (10 + t)) at step t of a phase."""
    # A constant decay d keeps d^n of the initial parameters after n steps: 9.5 % for 0.9995 and 4,706 steps. With
    # this warm-up they vanish, and in a short phase the average spans about its last ninth.
    static = config.static_iterations
    done = iteration if iteration < static else iteration - static
    return min(config.ema_decay, (1 + done) / (10 + done))


GradientAverage = Callable[[list[Tensor]], None]


class Stepper:
    """Draws a batch, computes the objective and updates the parameters.

    Args:
        average_gradients: called with the gradients before they are used, to average them over processes.
        smoothing: of the blendshapes' steps.
        bodies: of a family, one of which each step is done on; that of the scene by default.

    Attributes:
        terms: energies of the last step [J], updated in place so that reading them needs no new launch.
        ema_model: exponential moving average of the model's parameters.
        skipped: a record of skipped steps.
    """

    def __init__(
        self,
        model: GarmentModel,
        objective: Objective,
        sampler: WindowSampler,
        config: TrainConfig,
        average_gradients: GradientAverage | None = None,
        smoothing: ShapeSmoothing | None = None,
        bodies: DrawnBodies | None = None,
    ) -> None:
        self.bodies = bodies
        self.model, self.objective, self.sampler, self.config = model, objective, sampler, config
        self.average_gradients, self.smoothing = average_gradients, smoothing
        self.device = sampler.first.device
        self.optimisers = _optimisers(model, config, self.device)
        if bodies:
            bodies.take_off()  # the average is validated on the base
        self.ema_model = copy.deepcopy(model).requires_grad_(False)
        self.terms: dict[str, Tensor] = {}
        self.skipped = SkippedSteps(self.device)
        # Tensors: each replay of a captured graph reads them.
        self._iteration = torch.zeros((), dtype=torch.int64, device=self.device)
        self._decay = torch.zeros((), device=self.device)
        self._half = config.outlier_energy * objective.scale
        self._graph: torch.cuda.CUDAGraph | None = None
        self._phase, self._eager = "", 0

    def static_step(self) -> None:
        """Do a step of static training: P and D on single random poses."""
        frames, pull, direction = self.sampler.poses(self.config.pretraining_batch)
        inner = self.objective.inner
        obstacles = self.sampler.obstacles_at(frames, direction)
        beneath = inner.poses(frames, pull, self.sampler.generator, obstacles) if inner else None
        fabric = self.sampler.fabrics_of_poses(len(frames))
        terms = self.objective.static(frames, pull, beneath, obstacles, fabric)
        means = {name: value.mean() for name, value in terms.items()}
        drawn = {"frames": frames, "directions": pull, **({} if fabric is None else {"fabrics": fabric})}
        self._descend(total(terms, self._half), means, drawn)

    def dynamic_step(self) -> None:
        """Do a step of dynamic training: all networks on one window of every slot, and P on single poses."""
        self.sampler.change_body()
        noise, poses = self.sampler.noise(), self.sampler.poses(self.config.static_batch)
        fabric = self.sampler.fabrics_of_poses(self.config.static_batch)
        if self.config.initial_loss:
            poses, fabric = self.sampler.with_initial(*poses), self.sampler.fabrics_with_initial(fabric)
        frames, pull, direction = poses
        obstacles = self.sampler.obstacles_at(frames, direction)
        inner = {name: value.clone() for name, value in self.sampler.inner.items()}  # the window changes them
        dynamic, static, latents = self.objective.window(self.sampler, noise, frames, pull, obstacles, fabric)
        moving, still = (next(iter(terms.values())).shape[0] for terms in (dynamic, static))
        # All frames have the same weight, those of the single poses included.
        loss = (total(dynamic, self._half) * moving + total(static, self._half) * still) / (moving + still)
        means = {name: value.mean() for name, value in dynamic.items()}
        beside = {f"static {name}": value.mean() for name, value in static.items()}
        drawn = {"noise": noise, "static frames": frames, "static directions": pull}
        drawn |= {} if fabric is None else {"static fabrics": fabric}
        self._descend(loss, means, {**self.sampler.window(), **inner, **drawn}, beside)
        self.sampler.advance(latents)

    def _descend(
        self,
        loss: Tensor,
        terms: dict[str, Tensor],
        window: dict[str, Tensor],
        beside: dict[str, Tensor] | None = None,
    ) -> None:
        """Do an optimiser step on a loss, which consists of `terms` and those in `beside`."""
        self.model.zero_grad(set_to_none=True)
        loss.backward()
        gradients = [value.grad for value in self.model.parameters() if value.grad is not None]
        judged = loss.detach().clone()
        if self.average_gradients is not None:
            self.average_gradients([*gradients, judged])  # the loss too: all processes must skip the same steps
        norm = nn.utils.get_total_norm(gradients, foreach=True)
        bad = ~(norm.isfinite() & judged.isfinite())
        # Normalise the gradient: one a hundred times larger than usual, from a single torn garment, would otherwise
        # dominate Adam's update of all parameters.
        if self.config.normalised_gradients:
            torch._foreach_div_(gradients, norm.clamp_min(MIN_GRADIENT_NORM))
        if self.smoothing:
            self.smoothing.before_step()
        for optimiser in self.optimisers.values():
            optimiser.found_inf = bad.float()  # type: ignore[attr-defined]  # they skip the step where this is one
            optimiser.step()
        if self.smoothing:
            self.smoothing.after_step()
        self._average()
        terms = {name: value.detach() for name, value in terms.items()}
        self.skipped.record(bad, self._iteration, terms | (beside or {}), window)
        for name, value in terms.items():
            self.terms.setdefault(name, torch.zeros((), device=self.device)).copy_(value)

    @torch.no_grad()
    def _average(self) -> None:
        """Move the average towards the parameters."""
        averaged: list[Tensor] = [*self.ema_model.parameters()]
        parameters: list[Tensor] = [*self.model.parameters()]
        torch._foreach_mul_(averaged, self._decay)
        torch._foreach_add_(averaged, [*torch._foreach_mul(parameters, 1 - self._decay)])

    def run(self, iteration: int) -> None:
        """Do the step of an iteration, in the phase of that iteration."""
        rate = learning_rate(self.config, iteration)
        self._iteration.fill_(iteration)
        self._decay.fill_(averaging_decay(self.config, iteration))
        for group in (group for optimiser in self.optimisers.values() for group in optimiser.param_groups):
            if self.device.type == "cuda":
                group["lr"].fill_(rate * group["scale"])
            else:
                group["lr"] = rate * group["scale"]
        if self.bodies:
            self.bodies.draw(iteration)
        name = "static" if iteration < self.config.static_iterations else "dynamic"
        step = self.static_step if name == "static" else self.dynamic_step

        def body() -> None:
            if self.bodies:
                self.bodies.put_on()
            with on_one_body(self.model):
                step()

        if self.device.type == "cuda":
            self._replay(name, body)
        elif self._is_small and loops.available(self.device):
            from ..physics.loops.running import all_threads

            with all_threads():
                body()
        else:
            body()

    @property
    def _is_small(self) -> bool:
        """Whether the networks' products of a step are so small that threads would wait more than they compute."""
        widest = max(min(matrix.shape) for matrix in self.model.parameters() if matrix.ndim == 2)
        return decoded_frames(self.config, self.config.batch) * widest**2 < SMALL_PRODUCT

    def _replay(self, phase: str, body: Callable[[], None]) -> None:
        """Do a step as a CUDA graph, captured in each phase after a few eager steps."""
        if phase != self._phase:
            torch.cuda.synchronize(self.device)
            self._graph, self._phase, self._eager = None, phase, EAGER_STEPS  # the old graph's memory is freed
        if self._eager:
            self._eager -= 1
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                body()
            torch.cuda.current_stream().wait_stream(side)
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self.sampler.generator)
            with torch.cuda.graph(self._graph):
                body()
        self._graph.replay()


def _optimisers(model: GarmentModel, config: TrainConfig, device: torch.device) -> dict[str, torch.optim.Optimizer]:
    """Return the optimisers by name: Muon for the networks' matrices, if asked for, and AdamW for all else.

    Groups of parameters have a "scale", a factor on the learning rate. Only the matrices have a weight decay.
    """
    scales = {
        "matrices": 1.0,
        "biases": 1.0,
        "integrator": config.integrator_learning_rate_scale,
        "skinning": config.skinning_learning_rate_scale,
        "shapes": config.shape_learning_rate_scale,
    }
    parts: dict[str, list[nn.Parameter]] = {name: [] for name in scales}
    for name, value in model.named_parameters():
        if not value.requires_grad:
            continue
        if name.startswith("integrator."):
            parts["integrator"].append(value)
        elif "skin_offset" in name:
            parts["skinning"].append(value)
        elif name == "decoder.shapes":
            parts["shapes"].append(value)
        else:
            # What layers see of bodies is learned as biases are.
            parts["matrices" if value.ndim == 2 and not name.endswith(".columns") else "biases"].append(value)
    on_gpu = device.type == "cuda"

    def group(name: str) -> dict[str, Any]:
        # A captured graph reads the learning rate from a tensor; elsewhere a number is faster.
        rate = torch.tensor(0.0, device=device) if on_gpu else 0.0
        decay = config.weight_decay if name == "matrices" else 0.0
        return {"params": parts[name], "lr": rate, "scale": scales[name], "weight_decay": decay}

    groups = {name: group(name) for name, parameters in parts.items() if parameters}
    found: dict[str, torch.optim.Optimizer] = {}
    if config.optimiser == "muon":
        found["muon"] = Muon([groups.pop("matrices")])
    return {"adam": torch.optim.AdamW(list(groups.values()), capturable=on_gpu, fused=True), **found}
