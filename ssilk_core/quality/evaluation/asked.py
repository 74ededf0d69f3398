# SPDX-License-Identifier: Apache-2.0
"""What an evaluation is asked for: its options, and the clips that it plays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...errors import fail
from ...scene.assets import Motion
from .methods import Reader


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What is measured besides the energies.

    Attributes:
        sequence: frames after which a clip restarts, as in the paper (512); None for whole clips.
        stops: stops in each clip after which poses are held; none for zero.
        hold: how long they are held [s].
        minimum: whether the simulator minimises the energy of held poses.
        simulate: whether it plays the stops as well, to see how it settles.
        solver: whether it simulates from the methods' own states. These three take long on a CPU.
        loop: frames that the first seconds of each clip loop for, at least; none for zero.
        linearised: states of each split about which a network's steps are linearised, at most; none for zero.
    """

    sequence: int | None = None
    stops: int = 2
    hold: float = 3.0
    minimum: bool = False
    simulate: bool = False
    solver: bool = False
    loop: int = 2000
    linearised: int = 16

    def __post_init__(self) -> None:
        if not (self.sequence is None or self.sequence >= 4):
            fail("evaluation", f"sequences of {self.sequence} frames", "four at least are needed")
        if not 0 <= self.stops <= 100:
            fail("evaluation", f"{self.stops} stops in each clip", "0 to 100 are allowed")
        if not 0 < self.hold <= 600:
            fail("evaluation", f"a hold of {self.hold:g} s", "it lies between 0 and 600 s")
        if not 0 <= self.loop <= 1_000_000:
            fail("evaluation", f"loops of {self.loop} frames", "0 to 1,000,000 are allowed")
        if not 0 <= self.linearised <= 10_000:
            fail("evaluation", f"{self.linearised} states to linearise about", "0 to 10,000 are allowed")


@dataclass(frozen=True, eq=False)
class EvaluationClips:
    """What is played.

    Attributes:
        clips: motions by name.
        splits: names of clips by split; a clip may be in several.
        simulated: clips that there are shots of the reference simulator of; `read` returns its points at the
            methods' rate.
        seen: training motions; none where they are not known.
    """

    clips: Mapping[str, Motion]
    splits: Mapping[str, Sequence[str]]
    simulated: frozenset[str] = frozenset()
    read: Reader | None = None
    seen: Sequence[Motion] = ()
