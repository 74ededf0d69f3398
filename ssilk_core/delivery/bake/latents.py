# SPDX-License-Identifier: Apache-2.0
"""Rollouts whose states are solved for in the model's latents: what they store has the network's size."""

from __future__ import annotations

from dataclasses import replace

from ...events import Countdown, Message, Reporter, silent
from .computed_frames import SolvedLatents
from .result import LatentSummary
from .rollout import BakeRollout


def solved(rollout: BakeRollout, report: Reporter = silent) -> BakeRollout:
    """Return a rollout with its poses solved for in latents, or the rollout itself where its request does not ask.

    Raises:
        SsilkError: the character has no body.
    """
    if not rollout.request.latent_iterations or rollout.latents is not None:
        return rollout
    roller = rollout.latent_roller(Countdown(_frames_to_solve(rollout), report))
    loop = rollout.in_loop(rollout.loop, roller) if rollout.loop else None
    poses = (loop.pose,) if loop else tuple(rollout.network_poses(roller))
    found = roller.tally
    summary = LatentSummary(
        iterations=rollout.request.latent_iterations,
        elements=rollout.request.latent_elements,
        frames=found.frames,
        energy_before_j=found.mean("start_energy"),
        energy_j=found.mean("energy"),
        left=found.mean("left_share"),
        unconverged=found.unconverged,
        failed=found.failed,
    )
    if found.failed:
        text = f"{found.failed} of {found.frames} frames are not solved: no step lowers their energy"
        report(Message(f"{rollout.request.motion}: {text}; they stay where the solver came", "warning"))
    return replace(rollout, latents=SolvedLatents(poses, summary, loop))


def _frames_to_solve(rollout: BakeRollout) -> int:
    """Return how many frames a solver in latents has to solve, at the model's rate."""
    from ...network.latent_solver import frames_to_solve

    assert rollout.model is not None
    samples = rollout.samples
    driver = samples.driver(0, samples.rolled, 1)
    return frames_to_solve(driver, samples.skeleton, rollout.model.config.fps, rollout.request.pre_roll)
