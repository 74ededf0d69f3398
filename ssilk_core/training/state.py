# SPDX-License-Identifier: Apache-2.0
"""The saved state of a training run, from which it resumes exactly."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import SsilkError, fail
from ..files import replacing, split_location
from ..network.tensors import pack_tensors, read_tensors
from ..scene.assets import Scene
from ..scene.family import DressedFamily
from .curve import CurvePoint
from .settings import TrainConfig
from .step import Stepper
from .validation import Score

Tensors = dict[str, Tensor]

FORMAT = 1  # of training states
SAME_DIGITS = 6  # of a family of bodies [m], and of its coordinates
HEADER_NAME = "ssilk_state"  # of the JSON document in the metadata
SAMPLER_PREFIX = "sampler."  # of the sampler's tensors; all others are parameters or optimiser state


@dataclass(frozen=True)
class Best:
    """The best model so far: its iteration and score."""

    iteration: int
    score: Score


@dataclass(frozen=True)
class ReducedSettings:
    """Settings that a run has reduced, for lack of memory or after divergence.

    Attributes:
        iteration: iteration from which they apply.
        batch, pretraining_batch: sizes that fit into memory; `static_batch` is reduced in proportion.
        pace: factor on every learning rate, below one after divergence.
    """

    iteration: int
    batch: int
    pretraining_batch: int
    pace: float = 1.0

    def apply_to(self, config: TrainConfig) -> TrainConfig:
        """Return a schedule with these settings."""
        rates = {
            name: getattr(config, name) * self.pace
            for name in ("static_learning_rate", "learning_rate", "final_learning_rate")
        }
        static_batch = max(min(1, config.static_batch), config.static_batch * self.batch // config.batch)
        return replace(
            config, batch=self.batch, pretraining_batch=self.pretraining_batch, static_batch=static_batch, **rates
        )


@dataclass
class RunState:
    """Progress of a run, without tensors.

    Attributes:
        asked: inputs of the run (`TrainJob.identity`), which a resumed run must share.
        iteration: steps done.
        best: the best model so far. The state is written before its model file, so that a run that was killed in
            between can still write the model.
        lowered: reduced settings, in order; the last apply.
        skipped: number of skipped steps.
        seconds: as in `CurvePoint`.
        planned: iterations that fit into the job's minutes; zero for those of its schedule.
        static: those of them that were static training, once that is over.
        validations: how many fit; zero for those of the schedule.
        pace: seconds of a step of static and of dynamic training, as last measured; empty where nothing was planned.
        wall: time spent, validations and files included [s].
        curve: the validations.
    """

    asked: dict[str, Any]
    iteration: int = 0
    best: Best | None = None
    lowered: list[ReducedSettings] = field(default_factory=list)
    skipped: int = 0
    seconds: float = 0.0
    planned: int = 0
    static: int = 0
    validations: int = 0
    pace: list[float] = field(default_factory=list, compare=False)
    wall: float = field(default=0.0, compare=False)
    curve: list[CurvePoint] = field(default_factory=list)


def state_path(model: str | Path) -> Path:
    """Return the path of the state for the run that writes `model`."""
    return Path(model).with_suffix(".resume.safetensors")


def save_state(path: Path, stepper: Stepper, samplers: Sequence[Tensors], state: RunState) -> None:
    """Write all that the next iteration depends on; `samplers` has the sampler's state of each process."""
    tensors = learned_tensors(stepper)
    for rank, sampler in enumerate(samplers):
        tensors |= {f"{SAMPLER_PREFIX}{rank}.{name}": value for name, value in sampler.items()}
    arrays = {name: value.numpy() for name, value in tensors.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(pack_tensors(arrays, {HEADER_NAME: json.dumps(_document(state))}))


def load_state(path: Path, asked: dict[str, Any]) -> tuple[RunState, Tensors]:
    """Return a state and its tensors.

    Raises:
        SsilkError: there is no state, it is damaged, or it belongs to a run with other inputs.
    """
    if not path.is_file():
        fail(
            str(path),
            "there is no training to resume",
            "the file is written to the model's folder",
            "train without --resume",
        )
    with _name_damage(path):
        arrays, words = read_tensors(path, HEADER_NAME)
        state = _state_of(path, json.loads(words[HEADER_NAME]))
        _need_same(path, asked, state.asked)
        _need_possible(state)
        tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
        _need_finite(tensors)
    return state, tensors


def restore(path: Path, stepper: Stepper, tensors: Tensors, rank: int = 0) -> None:
    """Load the tensors of `load_state` into a newly built `stepper` of the process `rank`.

    Raises:
        SsilkError: the tensors do not fit.
    """
    scaled = (".parametrizations.weight." in name for name in stepper.model.state_dict())
    if any(scaled) and not any(".parametrizations.weight." in name for name in tensors):
        fail(
            str(path),
            "a training of an earlier version, whose networks saw bodies in their first layers alone",
            "it cannot be resumed",
            "train anew with --start-from its model, without --resume",
        )
    with _name_damage(path):
        stepper.sampler.restore(_group(tensors, f"{SAMPLER_PREFIX}{rank}."))
        restore_learned(stepper, tensors)


def learned_tensors(stepper: Stepper) -> Tensors:
    """Return copies on the CPU of all that training changes: parameters, their average and the optimiser state."""
    tensors = {f"model.{name}": value for name, value in stepper.model.state_dict().items()}
    tensors |= {f"averaged.{name}": value for name, value in stepper.ema_model.state_dict().items()}
    for optimiser, used in stepper.optimisers.items():
        for index, moments in used.state_dict()["state"].items():
            tensors |= {f"{optimiser}.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    return copy_to_cpu(tensors)


def restore_learned(stepper: Stepper, tensors: Tensors) -> None:
    """Load the result of `learned_tensors` into a newly built `stepper`, which may have another batch."""
    stepper.model.load_state_dict(_group(tensors, "model."))
    stepper.ema_model.load_state_dict(_group(tensors, "averaged."))
    for optimiser, used in stepper.optimisers.items():
        moments: dict[int, Tensors] = {}
        for name, value in _group(tensors, f"{optimiser}.").items():
            index, _, key = name.partition(".")
            moments.setdefault(int(index), {})[key] = value
        used.load_state_dict({"state": moments, "param_groups": used.state_dict()["param_groups"]})


def copy_to_cpu(tensors: Tensors) -> Tensors:
    """Return contiguous copies on the CPU."""
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}


def _group(tensors: Tensors, prefix: str) -> Tensors:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _document(state: RunState) -> dict[str, Any]:
    return {"format": FORMAT, **asdict(state)}


def _state_of(path: Path, document: dict[str, Any]) -> RunState:
    if (found := document.pop("format")) != FORMAT:
        fail(
            str(path),
            f"a training state of format {found}",
            f"this version resumes format {FORMAT}",
            "finish it with the version that began it, or train without --resume",
        )
    best, lowered, curve = document.pop("best"), document.pop("lowered"), document.pop("curve")
    return RunState(
        best=None if best is None else Best(best["iteration"], Score.of(best["score"])),
        lowered=[ReducedSettings(**item) for item in lowered],
        curve=[CurvePoint(**{**item, "score": Score.of(item["score"])}) for item in curve],
        **document,
    )


@contextmanager
def _name_damage(path: Path) -> Iterator[None]:
    """Turn the errors that a damaged file causes into one sentence."""
    try:
        yield
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError, OverflowError) as error:
        reason = str(error).rpartition("\n")[2].strip().rstrip(".")
        raise SsilkError(
            f"{path}: the training state is damaged ({reason}); delete it and train without --resume."
        ) from error


def _need_possible(state: RunState) -> None:
    """Raise `ValueError` unless a run can have reached this state, which no checksum can tell."""
    asked, scored = state.asked["train"], [each for each in (state.best, *state.curve) if each]
    last = state.planned or asked["iterations"]
    _need_counts("planned", 0, inf, [state.planned, state.validations])
    _need_counts("static", 0, last, [state.static])
    _need_counts("iteration", 0, last, [state.iteration])
    _need_counts("skipped", 0, 2 * last, [state.skipped])  # a run that diverges goes back once
    _need_counts("an earlier iteration", 0, state.iteration, [each.iteration for each in (*scored, *state.lowered)])
    for name in ("batch", "pretraining_batch"):
        _need_counts(name, 1, asked[name], [getattr(each, name) for each in state.lowered])
    times = [state.seconds, state.wall, *state.pace, *(point.seconds for point in state.curve)]
    paces = [each.pace for each in state.lowered]
    if not (all(0 <= time < inf for time in times) and all(0 < pace <= 1 for pace in paces)):
        raise ValueError("a duration or a pace is out of range")
    if not all(isfinite(each.score.total) for each in scored):
        raise ValueError("a score is not finite")


def _need_counts(name: str, least: int, most: float, values: Sequence[int]) -> None:
    """Raise `ValueError` unless all values are integers in a range."""
    for value in values:
        if not (type(value) is int and least <= value <= most):
            raise ValueError(f"{name} is {str(value)[:40]}, beyond {least} to {most}")


def _need_finite(tensors: Tensors) -> None:
    """Raise `ValueError` unless all that was learned is finite; the sampler's tensors may hold anything."""
    for name, value in tensors.items():
        if not (name.startswith(SAMPLER_PREFIX) or value.isfinite().all()):
            raise ValueError(f"tensor '{name}' holds NaN or infinity")


def _need_same(path: Path, asked: dict[str, Any], before: dict[str, Any]) -> None:
    differing: list[str] = []
    asked, before = _located(asked, asked), _located(before, asked)
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
            "use the same options, --preset too if it was left to the device, or train without --resume",
        )


def _located(identity: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the inputs of a run with each file as `now` writes its path: what is in a file counts, not its place."""
    left, places = dict(now.get("inputs", {})), {}
    for path, digest in identity.get("inputs", {}).items():
        same = [other for other, found in left.items() if found == digest]
        alike = [other for other in same or left if Path(other).name == Path(path).name]
        places[os.path.normpath(path)] = chosen = path if path in left else next(iter((*alike, *same)), path)
        left.pop(chosen, None)

    def located(location: str) -> str:
        file, prim = split_location(location)
        return os.path.normpath(places.get(os.path.normpath(file), file)) + (f":{prim}" if prim else "")

    parts = {name: identity[name] for name in ("inputs", "motions", "held out") if name in identity}
    moved: dict[str, Any] = {
        name: {located(key): value for key, value in part.items()} for name, part in parts.items()
    }
    return {**identity, **moved, "garment": located(identity.get("garment", ""))}


def scene_digest(scene: Scene) -> str:
    """Return a hash of a scene's contents: meshes, weights, classes, rig and bind pose."""
    digest = hashlib.sha256(json.dumps(scene.joint_names).encode())
    bodies = scene.character.bodies
    body = [array for b in bodies for array in (b.mesh.points, b.mesh.faces, b.skin.indices, b.skin.weights)]
    garment = (scene.garment.mesh.points, scene.garment.mesh.faces, scene.classes)
    lbs, rig = scene.lbs_skin, scene.rig.skin
    skins = (lbs.indices, lbs.weights, rig.indices, rig.weights)
    for array in (*body, *garment, *skins, scene.parents, scene.bind_transforms):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def family_digest(family: DressedFamily, graded: bool) -> str:
    """Return a hash of the bodies that a garment is trained for, and of where it lies on them, and after it whether
    it is graded to them.

    What linear algebra leaves of rounding, which depends on threads, is none of it.
    """
    bodies, digest = family.bodies, hashlib.sha256()
    moves = (bodies.joint_moves, bodies.point_moves, bodies.taller, family.cloth_moves, family.proxy_moves)
    for array in (bodies.members, bodies.joints, bodies.points, *moves):
        digest.update((np.round(array, SAME_DIGITS) + 0.0).tobytes())
    return digest.hexdigest() + (" graded" if graded else "")


def json_round_trip(value: Any) -> Any:
    """Return a value as it is after writing and reading it as JSON."""
    return json.loads(json.dumps(value, default=lambda other: np.asarray(other).tolist()))
