# SPDX-License-Identifier: Apache-2.0
"""What is known of N frames, in frozen dataclasses: frames are chosen from them, and several become one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor


class Framed:
    """A frozen dataclass of N frames. Its fields are tensors with the frames last, others of its kind, or None.

    Attributes:
        SHARED: names of fields that all frames share.
    """

    SHARED: ClassVar[frozenset[str]] = frozenset()

    def _own(self) -> dict[str, Any]:
        """Return the fields that each frame has a value of."""
        return {
            each.name: getattr(self, each.name)
            for each in fields(self)  # type: ignore[arg-type]
            if each.name not in self.SHARED
        }

    def select(self, frames: Tensor) -> Self:
        """Return the frames with indices (M,), in ascending order."""
        chosen = {name: _selected(value, frames) for name, value in self._own().items()}
        return replace(self, **chosen)  # type: ignore[type-var]

    def first(self, count: int) -> Self:
        """Return the first frames."""
        return self.select(torch.arange(count, device=self._device))

    def split(self) -> list[Self]:
        """Return each frame alone."""
        count = self._first_tensor.shape[-1]
        return [self.select(frame) for frame in torch.arange(count, device=self._device).split(1)]

    @property
    def _first_tensor(self) -> Tensor:
        return next(value for value in self._own().values() if isinstance(value, Tensor))

    @property
    def _device(self) -> torch.device:
        return self._first_tensor.device

    @classmethod
    def concatenated(cls, parts: Sequence[Self]) -> Self:
        """Return the frames of several, one after the other; what is None is so in all."""
        if len(parts) == 1:
            return parts[0]
        own = [part._own() for part in parts]
        values = {name: _concatenated([each[name] for each in own]) for name in own[0]}
        return replace(parts[0], **values)  # type: ignore[type-var]


def consecutive(counts: Sequence[int], device: torch.device) -> tuple[Tensor, ...]:
    """Return the numbers that the frames of several have where these follow each other, (N,) each."""
    return torch.arange(sum(counts), device=device).split(list(counts))


def _selected(value: Tensor | Framed | None, frames: Tensor) -> Tensor | Framed | None:
    if isinstance(value, Tensor):
        return value[..., frames]
    return None if value is None else value.select(frames)


def _concatenated(values: list[Any]) -> Tensor | Framed | None:
    if isinstance(values[0], Tensor):
        return torch.cat(values, dim=-1)
    return None if values[0] is None else type(values[0]).concatenated(values)
