# SPDX-License-Identifier: Apache-2.0
"""The ways in which a trained model plays takes: its network, and the solver in its latents."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from helpers.subjects import Subject
from ssilk_core.events import Countdown, Message, Reporter
from ssilk_core.network.latent_solver import LatentOptions
from ssilk_core.quality.evaluation.methods import Method, Network, SolvedNetwork, TakeSet

SKINNING, NETWORK = "linear blend skinning", "network"


def latent_name(iterations: int) -> str:
    """Return the name of the solver in latents with so many iterations."""
    return f"latents, {iterations} iteration{'s' * (iterations > 1)}"


def methods_of(
    subject: Subject, take_set: TakeSet, iterations: Sequence[int], report: Reporter
) -> Iterator[tuple[str, Method]]:
    """Yield the network, then the solver in latents with each number of iterations, each once it has played."""
    yield NETWORK, Network(subject.model, take_set)
    frames = max(take.frame_count for take in take_set.takes)
    for count in iterations:
        report(Message(f"{subject.name}: {latent_name(count)}"))
        options, told = LatentOptions(iterations=count), Countdown(frames, report)
        solved = SolvedNetwork(subject.model, subject.file.fabric, options, take_set, told)
        if solved.lost:
            report(Message(f"{solved.lost} states were not finite and were replaced", "warning"))
        yield latent_name(count), solved
