# SPDX-License-Identifier: Apache-2.0
"""The state of a training run on disk, so that it goes on exactly where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..assets import Scene
from ..config import TrainConfig
from ..errors import SsilkError, need
from ..files import replacing
from .step import Stepper
from .validation import Score


@dataclass(frozen=True)
class RunState:
    """Iterations done, the best score so far (of the model on disk), and what the run was asked to do."""

    iteration: int
    best: Score | None
    asked: dict[str, Any]


def state_path(model: str | Path) -> Path:
    """Return where the state of the run that writes `model` lies."""
    return Path(model).with_suffix(".resume.safetensors")


def save_state(path: Path, stepper: Stepper, state: RunState) -> None:
    """Write everything that the next iteration depends on."""
    from safetensors.torch import save

    with replacing(path) as temporary:
        tensors = {name: value.detach().cpu().contiguous().clone() for name, value in _tensors(stepper).items()}
        temporary.write_bytes(save(tensors, {"ssilk_state": json.dumps(asdict(state))}))


def load_state(path: Path, stepper: Stepper, asked: dict[str, Any]) -> RunState:
    """Restore a run into a freshly built `stepper`.

    Raises:
        SsilkError: there is no state, it is damaged, or it belongs to a run that was asked something else.
    """
    with _damage_named(path):
        state, tensors = _read(path)
        _need_same(path, asked, state.asked)
        _restore(stepper, tensors)
    return state


def batches_before(path: Path, config: TrainConfig) -> tuple[int, int]:
    """Return the batch and warm batch of the run at `path`, up to those of `config`: memory may have lowered them.

    Raises:
        SsilkError: there is no state, or it is damaged.
    """
    with _damage_named(path):
        before = _read(path)[0].asked["train"]
        return min(config.batch, before["batch"]), min(config.warm_batch, before["warm_batch"])


def _read(path: Path) -> tuple[RunState, dict[str, Tensor]]:
    from safetensors import safe_open

    need(
        path.is_file(),
        str(path),
        "there is no training to resume",
        "the file is written beside the model",
        "train without --resume",
    )
    with safe_open(path, "pt") as stream:
        document = json.loads((stream.metadata() or {})["ssilk_state"])
        best = document.pop("best")
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    return RunState(best=None if best is None else Score(**best), **document), tensors


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file gives rise to into one sentence."""
    from safetensors import SafetensorError

    try:
        yield
    except (SafetensorError, ValueError, TypeError, KeyError, RuntimeError) as error:
        reason = str(error).rpartition("\n")[2].strip().rstrip(".")
        raise SsilkError(
            f"{path}: the training state is damaged ({reason}); delete it and train without --resume."
        ) from error


def _need_same(path: Path, asked: dict[str, Any], before: dict[str, Any]) -> None:
    differing: list[str] = []
    for key, value in asked.items():
        old = before.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            differing += sorted(name for name in value.keys() | old.keys() if value.get(name) != old.get(name))
        elif value != old:
            differing.append(key)
    need(
        not differing,
        str(path),
        f"the run was started with another {', '.join(differing)}",
        "a resumed run repeats the same command",
        "use the same options or train without --resume",
    )


def _tensors(stepper: Stepper) -> dict[str, Tensor]:
    tensors = {f"model.{name}": value for name, value in stepper.model.state_dict().items()}
    tensors |= {f"averaged.{name}": value for name, value in stepper.averaged.state_dict().items()}
    tensors |= {f"sampler.{name}": value for name, value in stepper.sampler.state().items()}
    for index, moments in stepper.optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    return tensors


def _restore(stepper: Stepper, tensors: dict[str, Tensor]) -> None:
    def group(prefix: str) -> dict[str, Tensor]:
        return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

    stepper.model.load_state_dict(group("model."))
    stepper.averaged.load_state_dict(group("averaged."))
    stepper.sampler.restore(group("sampler."))
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in group("adam.").items():
        index, _, key = name.partition(".")
        moments.setdefault(int(index), {})[key] = value
    document = stepper.optimiser.state_dict()
    stepper.optimiser.load_state_dict({"state": moments, "param_groups": document["param_groups"]})


def scene_digest(scene: Scene) -> str:
    """Return a hash of all that a scene holds, however it was prepared: meshes, weights, classes, rig, bind pose."""
    digest = hashlib.sha256(json.dumps(scene.joint_names).encode())
    bodies = scene.character.bodies
    body = [array for b in bodies for array in (b.mesh.points, b.mesh.faces, b.skin.indices, b.skin.weights)]
    garment = (scene.garment.mesh.points, scene.garment.mesh.faces, scene.classes)
    plain, rig = scene.plain_skin, scene.rig.skin
    skins = (plain.indices, plain.weights, rig.indices, rig.weights)
    for array in (*body, *garment, *skins, scene.parents, scene.bind_transforms):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def canonical(value: Any) -> Any:
    """Return a value as it comes back from JSON, so that it can be compared with one that did."""
    return json.loads(json.dumps(value, default=lambda other: np.asarray(other).tolist()))
