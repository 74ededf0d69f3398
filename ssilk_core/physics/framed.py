# SPDX-License-Identifier: Apache-2.0
"""What is known of N frames, in frozen dataclasses: frames are chosen from them, and several become one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor


class Framed:
    """A frozen dataclass of N frames. Its fields are tensors with the frames last, others of its kind, tuples of
    these, None, or numbers that all frames share.

    Attributes:
        SHARED: names of fields that all frames share.
    """

    SHARED: ClassVar[frozenset[str]] = frozenset()

    def own(self) -> dict[str, Any]:
        """Return the fields that each frame has a value of."""
        return {
            each.name: getattr(self, each.name)
            for each in fields(self)  # type: ignore[arg-type]
            if each.name not in self.SHARED
        }

    def select(self, frames: Tensor) -> Self:
        """Return the frames with indices (M,), in ascending order."""
        chosen = {name: _selected(value, frames) for name, value in self.own().items()}
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
        return next(value for value in self.own().values() if isinstance(value, Tensor))

    @property
    def _device(self) -> torch.device:
        return self._first_tensor.device

    @classmethod
    def concatenated(cls, parts: Sequence[Self]) -> Self:
        """Return the frames of several, one after the other; what is None is so in all."""
        if len(parts) == 1:
            return parts[0]
        own = [part.own() for part in parts]
        values = {name: _concatenated([each[name] for each in own]) for name in own[0]}
        return replace(parts[0], **values)  # type: ignore[type-var]


def consecutive(counts: Sequence[int], device: torch.device) -> tuple[Tensor, ...]:
    """Return the numbers that the frames of several have where these follow each other, (N,) each."""
    return torch.arange(sum(counts), device=device).split(list(counts))


def _selected(value: Any, frames: Tensor) -> Any:
    if isinstance(value, Tensor):
        return value[..., frames]
    if isinstance(value, tuple):
        return tuple(_selected(each, frames) for each in value)
    return value if _is_shared(value) else value.select(frames)


def _concatenated(values: list[Any]) -> Any:
    if isinstance(values[0], Tensor):
        return torch.cat(values, dim=-1)
    if isinstance(values[0], tuple):
        return tuple(_concatenated(list(each)) for each in zip(*values, strict=True))
    return values[0] if _is_shared(values[0]) else type(values[0]).concatenated(values)


def _is_shared(value: Any) -> bool:
    return value is None or isinstance(value, (int, float))
