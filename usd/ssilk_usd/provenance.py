# SPDX-License-Identifier: Apache-2.0
"""Where a shot came from, as it says itself."""

from __future__ import annotations

from typing import Any

from .read_stage import StageLike, open_stage


def read_provenance(source: StageLike) -> dict[str, Any]:
    """Return what `write_shot` was given as provenance; empty for files of other origin.

    Raises:
        SsilkError: not a readable stage.
    """
    stage = open_stage(source)  # the layer lives only as long as its stage
    return dict(stage.GetRootLayer().customLayerData.get("ssilk", {}))
