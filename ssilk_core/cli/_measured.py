# SPDX-License-Identifier: Apache-2.0
"""What measured figures depend on: by what files and their layers hold, wherever they lie."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def measured_inputs(
    *,
    models: Sequence[Path],
    stage: Path,
    clips: Mapping[str, Path],
    device: str,
    others: Mapping[str, Sequence[Path]],
) -> dict[str, Any]:
    """Return what the figures of any measurement depend on, as plain values for `kept_rows.KeptRows.inputs`.

    Verbs add their own settings. Where values differ, figures must not stand in one table.

    Args:
        clips: motions that are measured on, by name.
        device: where models run, as for `devices.select_device`.
        others: motions with another use, such as those of the training, by what they are.

    Raises:
        SsilkError: an input cannot be read, or there is no such device.
    """
    import torch

    from .. import __version__
    from ..delivery.bake.inputs import stage_contents
    from ..devices import device_name, select_device
    from ..files import sha256
    from ..physics.intersections.pairs import libigl_version

    return {
        "models": [(path.stem, sha256(path)) for path in models],
        "stage": stage_contents(str(stage)).digest,
        "motions": dict(zip(clips, contents(clips.values()))),
        **{name: contents(paths) for name, paths in others.items()},
        "hardware": device_name(select_device(device)),
        "versions": {"ssilk": __version__, "torch": torch.__version__, "libigl": libigl_version()},
    }


def contents(paths: Iterable[Path]) -> list[str]:
    """Return SHA-256 of each stage with its layers and value clips; raise `SsilkError` where one is unreadable."""
    from ..delivery.bake.inputs import stage_contents

    return [stage_contents(str(path)).digest for path in paths]
