# SPDX-License-Identifier: Apache-2.0
"""Parts of a measurement come back from their file bit for bit, or are refused."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import Tensor

from ssilk_core.errors import SsilkError
from ssilk_core.quality.evaluation.kept_parts import KeptParts, PartsFile
from ssilk_core.scene.assets import Floats


@dataclass(frozen=True, eq=False)
class Inner:
    values: dict[str, Tensor]
    share: float
    count: int


@dataclass(frozen=True, eq=False)
class Outer:
    points: Floats
    shown: Tensor
    inner: Inner | None = None
    more: list[Inner] = field(default_factory=list)


def inner(seed: int) -> Inner:
    noise = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Inner({"kinetic energy": noise, "jerk": noise.float()[:, 1:]}, float("inf") if seed else 0.1, seed)


def test_parts_come_back_bit_for_bit(tmp_path):
    path, inputs = tmp_path / "kept", {"models": [("a", "hash")]}
    file = PartsFile(path, inputs)
    parts = KeptParts(file, (0,)).of("method (a: b)")
    part = Outer(np.arange(6.0).reshape(2, 3).T, torch.tensor([[True, False]]), inner(3), [inner(0), inner(1)])
    parts.put("clip", part)
    parts.put("other", Outer(np.zeros((0, 3)), torch.zeros(0, 4)))
    parts.put(["none", 1], [])
    file.write()
    again = KeptParts(PartsFile(path, inputs), (0,)).of("method (a: b)")
    found = again.get("clip", Outer)
    np.testing.assert_array_equal(found.points, part.points)
    assert found.shown.dtype == torch.bool and torch.equal(found.shown, part.shown)
    for own, kept in zip([part.inner, *part.more], [found.inner, *found.more], strict=True):
        assert (own.share, own.count) == (kept.share, kept.count) and own.values.keys() == kept.values.keys()
        for name, value in own.values.items():
            assert value.dtype == kept.values[name].dtype and torch.equal(value, kept.values[name])
    empty = again.get("other", Outer)
    assert empty.inner is None and empty.more == [] and empty.points.shape == (0, 3) and empty.shown.shape == (0, 4)
    assert again.get(["none", 1], list[Inner]) == [] and "clip" in again and "clip" not in again.of("more")
    assert again.get("unknown", Outer) is None


def test_a_part_with_other_fields_is_refused(tmp_path):
    file = PartsFile(tmp_path / "kept", {})
    KeptParts(file).put("clip", inner(1))
    file.write()
    with pytest.raises(SsilkError, match=r"kept: clip lacks 'points'.*delete the file"):
        KeptParts(PartsFile(tmp_path / "kept", {})).get("clip", Outer)


def test_without_a_path_nothing_is_kept():
    parts = KeptParts(PartsFile(None, {}))
    parts.put("clip", inner(1))
    assert "clip" not in parts and not parts.due and parts.get("clip", Inner) is None
