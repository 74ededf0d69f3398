# SPDX-License-Identifier: Apache-2.0
"""Rollouts whose states are solved for in the model's latents: what they store has the network's size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...events import Countdown, Message, Reporter, format_count, silent
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
    moves = 1000 * np.array(found.figures["step_left"] or [0.0])
    summary = LatentSummary(
        iterations=rollout.request.latent_iterations,
        elements=rollout.request.latent_elements,
        frames=found.frames,
        energy_before_j=found.mean("start_energy"),
        energy_j=found.mean("energy"),
        left=found.mean("left_share"),
        step_left_mm=float(np.median(moves)),
        largest_step_left_mm=float(moves.max()),
        unconverged=found.unconverged,
        failed=found.failed,
    )
    _tell(summary, rollout.request.motion, report)
    return replace(rollout, latents=SolvedLatents(poses, summary, loop))


def _tell(summary: LatentSummary, motion: str, report: Reporter) -> None:
    """Say what the picture lacks of frames that are solved in full, and what brings it nearer."""
    if summary.unconverged:
        words = f"{motion}: frames are solved in {format_count(summary.iterations, 'iterations')}, not in full"
        far = f"cloth may still move by {summary.step_left_mm:.2g} mm in half of them"
        worst = f"and by {summary.largest_step_left_mm:.2g} mm in the worst"
        todo = f"where that shows, '--latent-iterations {2 * summary.iterations}' lowers it, in more time"
        report(Message(f"{words}: {far}, {worst}; {todo}"))
    if summary.failed:
        text = f"in {summary.failed} of {format_count(summary.frames, 'frames')} no step lowers the energy further"
        report(
            Message(f"{motion}: {text}, as where cloth is inside the body; look at the skin that shows", "warning")
        )


def _frames_to_solve(rollout: BakeRollout) -> int:
    """Return how many frames a solver in latents has to solve, at the model's rate."""
    from ...network.latent_solver import frames_to_solve

    assert rollout.model is not None
    samples = rollout.samples
    driver = samples.driver(0, samples.rolled, 1)
    return frames_to_solve(driver, samples.skeleton, rollout.model.config.fps, rollout.request.pre_roll)
