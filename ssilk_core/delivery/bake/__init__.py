# SPDX-License-Identifier: Apache-2.0
"""Bake trained garments over motions as UsdSkel, and verify what was written.

    request = BakeRequest(model="cape.safetensors", stage="hero.usdc", motion="walk.usdc")
    result = bake(request, "shot.usdc")

`bake` writes one file, `bake_layers` a folder of layers, `verify` compares a written shot with the network again.
Work speaks through `ssilk_core.events`; bad input raises `SsilkError`, a file that is not what was computed
`VerificationError`. This package and the command line are the only ones that join the core and USD.
"""

from .bodies import WornModel, worn, worn_by
from .fabrics import in_fabric
from .layers import LayerFolder, bake_layers
from .load import LoadedGarment, load_garment, load_rollout, with_model
from .outfit import bake_outfit, holds_several, verify_garments
from .request import BakeRequest
from .result import BakeResult, FrameSpan, LatentSummary, RefinementSummary, Verification
from .riders import riders_of
from .rollout import BakeRollout
from .sizing import shot_bytes, stored_bytes
from .task import BakeTask, plan_layers
from .trajectories import cache_origin, motion_at, rig_deformer, skin_trajectories, trained_deformer
from .verification import verify
from .write import bake

__all__ = [
    "BakeRequest", "BakeResult", "BakeRollout", "BakeTask", "FrameSpan", "LatentSummary", "LayerFolder",
    "LoadedGarment", "RefinementSummary", "Verification", "WornModel", "bake", "bake_layers", "bake_outfit",
    "cache_origin", "holds_several", "in_fabric", "load_garment", "load_rollout", "motion_at", "plan_layers",
    "riders_of", "rig_deformer", "shot_bytes", "skin_trajectories", "stored_bytes", "trained_deformer", "verify",
    "verify_garments", "with_model", "worn", "worn_by",
]  # fmt: skip
