# SPDX-License-Identifier: Apache-2.0
"""Play a trained garment with numpy alone: the fastest way on a processor, without PyTorch.

    from ssilk_core.network.runtime import Player
    playback = Player.load("cape.safetensors").play(motion)
    playback.vertices(12)   # (V, 3) [m], any frame in any order

Values that depend on the character's poses alone are computed for many frames at once, latents frame by frame, and
decoded values in blocks of frames.
"""

from .playback import Playback
from .player import Player

__all__ = ["Playback", "Player"]
