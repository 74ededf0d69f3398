# SPDX-License-Identifier: Apache-2.0
"""The saved state of a training run, from which it resumes exactly."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..assets import Scene
from ..config import TrainConfig
from ..errors import SsilkError, fail
from ..files import replacing
from .curve import CurvePoint
from .step import Stepper
from .validation import Score

Tensors = dict[str, Tensor]

SAMPLER = "sampler."  # begins the names of tensors that say where the windows stand; the others are what was learned


@dataclass(frozen=True)
class Best:
    """The model that was kept: the iteration it was taken at, and its score."""

    iteration: int
    score: Score


@dataclass(frozen=True)
class Lowered:
    """What a run does with from an iteration on, because more did not work.

    Attributes:
        iteration: steps done until then.
        batch, pretraining_batch: what fits into memory; single poses beside the windows are lowered with them.
        pace: factor on every step size, below one after steps that were not finite.
    """

    iteration: int
    batch: int
    pretraining_batch: int
    pace: float = 1.0

    def applied(self, config: TrainConfig) -> TrainConfig:
        """Return the schedule with this instead of what was asked for."""
        rates = {
            name: getattr(config, name) * self.pace
            for name in ("static_learning_rate", "learning_rate", "final_learning_rate")
        }
        static_batch = max(1, config.static_batch * self.batch // config.batch)
        return replace(
            config, batch=self.batch, pretraining_batch=self.pretraining_batch, static_batch=static_batch, **rates
        )


@dataclass
class RunState:
    """What changes while a run goes on, tensors aside.

    Attributes:
        asked: what the run was asked to do; a resumed run must be asked the same.
        iteration: steps done.
        best: the best model so far. A state is written before the model that it tells of: where a run was killed in
            between, the model is in the state.
        lowered: what had to be lowered, in order; the last holds.
        undone: steps undone because something was not finite.
        seconds: as in `curve.Point`.
        planned: iterations that fit into the job's minutes; zero for those of its schedule.
        curve: the validations.
    """

    asked: dict[str, Any]
    iteration: int = 0
    best: Best | None = None
    lowered: list[Lowered] = field(default_factory=list)
    undone: int = 0
    seconds: float = 0.0
    planned: int = 0
    curve: list[CurvePoint] = field(default_factory=list)


def state_path(model: str | Path) -> Path:
    """Return where the state of the run that writes `model` lies."""
    return Path(model).with_suffix(".resume.safetensors")


def save_state(path: Path, stepper: Stepper, samplers: Sequence[Tensors], state: RunState) -> None:
    """Write everything that the next iteration depends on; `samplers` is where the windows stand in each process."""
    from safetensors.torch import save

    tensors = learned(stepper)
    for rank, sampler in enumerate(samplers):
        tensors |= {f"{SAMPLER}{rank}.{name}": value for name, value in sampler.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(save(tensors, {"ssilk_state": json.dumps(asdict(state))}))


def load_state(path: Path, asked: dict[str, Any]) -> tuple[RunState, Tensors]:
    """Return a state and its tensors.

    Raises:
        SsilkError: there is no state, it is damaged, or it belongs to a run that was asked something else.
    """
    from safetensors import safe_open

    if not path.is_file():
        fail(
            str(path),
            "there is no training to resume",
            "the file is written beside the model",
            "train without --resume",
        )
    with _damage_named(path):
        with safe_open(path, "pt") as stream:
            state = _state_of(json.loads((stream.metadata() or {})["ssilk_state"]))
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
        _need_same(path, asked, state.asked)
    return state, tensors


def restore(path: Path, stepper: Stepper, tensors: Tensors, rank: int = 0) -> None:
    """Put what `load_state` returned into a freshly built `stepper`, that of the process `rank`.

    Raises:
        SsilkError: the tensors do not fit.
    """
    with _damage_named(path):
        stepper.sampler.restore(_group(tensors, f"{SAMPLER}{rank}."))
        restore_learned(stepper, tensors)


def learned(stepper: Stepper) -> Tensors:
    """Return copies on the CPU of all that training changes: parameters, their average, what the optimiser keeps."""
    tensors = {f"model.{name}": value for name, value in stepper.model.state_dict().items()}
    tensors |= {f"averaged.{name}": value for name, value in stepper.averaged.state_dict().items()}
    for index, moments in stepper.optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    return copied(tensors)


def restore_learned(stepper: Stepper, tensors: Tensors) -> None:
    """Put what `learned` returned into a freshly built `stepper`, which may have another batch."""
    stepper.model.load_state_dict(_group(tensors, "model."))
    stepper.averaged.load_state_dict(_group(tensors, "averaged."))
    moments: dict[int, Tensors] = {}
    for name, value in _group(tensors, "adam.").items():
        index, _, key = name.partition(".")
        moments.setdefault(int(index), {})[key] = value
    document = stepper.optimiser.state_dict()
    stepper.optimiser.load_state_dict({"state": moments, "param_groups": document["param_groups"]})


def copied(tensors: Tensors) -> Tensors:
    """Return copies on the CPU."""
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}


def _group(tensors: Tensors, prefix: str) -> Tensors:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _state_of(document: dict[str, Any]) -> RunState:
    best, lowered, curve = document.pop("best"), document.pop("lowered"), document.pop("curve")
    return RunState(
        best=None if best is None else Best(best["iteration"], Score(**best["score"])),
        lowered=[Lowered(**item) for item in lowered],
        curve=[CurvePoint(**{**item, "score": Score(**item["score"])}) for item in curve],
        **document,
    )


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
    if differing:
        fail(
            str(path),
            f"the run was started with another {', '.join(dict.fromkeys(differing))}",
            "a resumed run repeats the same command",
            "use the same options or train without --resume",
        )


def scene_digest(scene: Scene) -> str:
    """Return a hash of all that a scene holds, however it was prepared: meshes, weights, classes, rig, bind pose."""
    digest = hashlib.sha256(json.dumps(scene.joint_names).encode())
    bodies = scene.character.bodies
    body = [array for b in bodies for array in (b.mesh.points, b.mesh.faces, b.skin.indices, b.skin.weights)]
    garment = (scene.garment.mesh.points, scene.garment.mesh.faces, scene.classes)
    lbs, rig = scene.lbs_skin, scene.rig.skin
    skins = (lbs.indices, lbs.weights, rig.indices, rig.weights)
    for array in (*body, *garment, *skins, scene.parents, scene.bind_transforms):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def canonical(value: Any) -> Any:
    """Return a value as it comes back from JSON, so that it can be compared with one that did."""
    return json.loads(json.dumps(value, default=lambda other: np.asarray(other).tolist()))
