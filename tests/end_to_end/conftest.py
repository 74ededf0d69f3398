# SPDX-License-Identifier: Apache-2.0
"""A toy world for the commands: a pillar with three joints in a flared skirt, a clip, a trained model and a shot."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.opening import trial

from ssilk_core.cli import main
from ssilk_core.errors import EXIT_OK, EXIT_WORSE

JOINTS = ("Hips", "Hips/Spine", "Hips/Spine/Head")
HEIGHTS = (0.8, 1.2, 1.5)  # of the joints [m]
TRAINING = shlex.split(
    "--preset draft --device cpu --set latent=8 --set widths=16 --set shapes=4 --set iterations=6 "
    "--set static_fraction=0.5 --set batch=2 --set pretraining_batch=4 --set window=4 --set validate_every=3 "
    "--set valid_frames=8"
)


@dataclass(frozen=True)
class Toy:
    """Files of the toy world and how to make more of them."""

    folder: Path
    training: Sequence[str]
    write_clip: Callable[..., Path]

    def copy(self, folder: Path) -> Path:
        """Return `folder` with a copy of every file in it."""
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        return folder


def define_mesh(stage: Usd.Stage, path: str, points: np.ndarray, faces: np.ndarray) -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    return mesh.GetPrim()


def skirt(columns: int = 24, rows: int = 13) -> tuple[np.ndarray, np.ndarray]:
    """Cloth that hugs the pillar from 1 m to 1.3 m and flares to a radius of 0.5 m at 0.6 m, its normals outward."""
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(0.6, 1.3, rows)
    radius = np.interp(y, [0.6, 1.0], [0.5, 0.165])[:, None]
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), y[:, None], radius * np.cos(angle)), -1)
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return points.reshape(-1, 3), np.concatenate([np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]])


def write_hero(path: Path) -> Path:
    """A pillar 1.7 m high, in metres, y up, with a skirt that nobody has rigged yet."""
    side = [(0.15, height) for height in np.linspace(0, 1.7, 16)]  # long triangles are near much of the cloth
    body = trimesh.creation.revolve([(0, 0), *side, (0, 1.7)], sections=16)
    points = body.vertices[:, [0, 2, 1]] * [1, 1, -1]
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    root = UsdSkel.Root.Define(stage, "/Hero")
    rig = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    rig.CreateJointsAttr(JOINTS)
    rig.CreateBindTransformsAttr([Gf.Matrix4d().SetTranslate((0, height, 0)) for height in HEIGHTS])
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([rig.GetPath()])
    skin = UsdSkel.BindingAPI.Apply(define_mesh(stage, "/Hero/Body", points, body.faces))
    skin.CreateJointIndicesPrimvar(False, 1).Set(np.digitize(points[:, 1], HEIGHTS[1:]).tolist())
    skin.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(points))
    define_mesh(stage, "/Hero/Skirt", *skirt())
    stage.GetRootLayer().Save()
    return path


def write_clip(path: Path, frames: int = 40, fps: float = 30.0, joints: Sequence[str] = JOINTS) -> Path:
    """Hips that sway and turn, sampled at every frame."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(fps)
    animation = UsdSkel.Animation.Define(stage, "/Clip")
    animation.CreateJointsAttr(list(joints))
    animation.CreateScalesAttr([Gf.Vec3h(1)] * len(joints))  # without which USD plays nothing
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    steps = np.diff(HEIGHTS, prepend=0)
    for frame in range(frames):
        turn = 0.3 * np.sin(frame / 5)
        turned = Gf.Quatf(float(np.cos(turn / 2)), 0, 0, float(np.sin(turn / 2)))
        rotations.Set([turned, *[Gf.Quatf(1)] * (len(joints) - 1)], frame)
        at = [Gf.Vec3f(0, float(step), 0) for step in np.resize(steps, len(joints))]
        translations.Set([at[0] + Gf.Vec3f(0.2 * float(np.sin(frame / 7)), 0, 0), *at[1:]], frame)
    stage.GetRootLayer().Save()
    return path


def run(command: str, *more: str) -> int:
    return main([*shlex.split(command), *more])


@pytest.fixture(autouse=True, scope="module")
def commands_have_few_contacts(few_contacts) -> None:
    """What is tested here are commands and files."""


@pytest.fixture(autouse=True, scope="module")
def read_at_once() -> Iterator[None]:
    """Files are not read in another process first: those written here do no harm. `test_hostile` reads as ever."""
    token = trial._within.set(True)
    yield
    trial._within.reset(token)


@pytest.fixture(autouse=True, scope="module")
def pages_have_no_charts() -> Iterator[None]:
    """Charts take most of the time of a page. `test_report` draws them as ever."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ssilk_core.delivery.report.shots.svg_chart", lambda *_, **__: "")
        yield


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Toy:
    """hero.usda, clip.usda, rigged.usda, model.safetensors (with its state) and shot.usda in one folder.

    After six iterations the model may be worse than linear blend skinning.
    """
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("toy")
    write_hero(folder / "hero.usda")
    write_clip(folder / "clip.usda")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run("rig hero.usda --garment Skirt --proxies 4 -o rigged.usda") == 0
        assert run("train rigged.usda --motions clip.usda -o model.safetensors", *TRAINING) in (EXIT_OK, EXIT_WORSE)
        assert run("bake model.safetensors --stage rigged.usda --motion clip.usda -o shot.usda") == 0
    return Toy(folder, TRAINING, write_clip)


@pytest.fixture(scope="session")
def glb_world(toy: Toy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy, sway.usda of six frames, and all.glb, a verified bake of it that nobody writes to."""
    folder = toy.copy(tmp_path_factory.mktemp("glb"))
    toy.write_clip(folder / "sway.usda", frames=6)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run("bake model.safetensors --stage rigged.usda --motion sway.usda --target glb -o all.glb") == 0
    return folder


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, torch.Tensor]]:
    """The numbers of what `ssilk export` writes, by the name of the file; the graph itself, which takes seconds, is
    looked at in `tests/core/network/test_export.py`."""
    from ssilk_core.network.model import export

    written: dict[str, dict[str, torch.Tensor]] = {}

    def keep(model: torch.nn.Module, path: Path) -> None:
        written[path.name] = {name: value.clone() for name, value in export.FrameNetwork(model).state_dict().items()}
        path.touch()

    monkeypatch.setattr(export, "export_onnx", keep)
    return written


@pytest.fixture
def copy(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the module's `world`, the current folder."""
    shutil.copytree(world, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
