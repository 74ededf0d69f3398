# SPDX-License-Identifier: Apache-2.0
"""Blender's own importer plays layers and targets as they were computed, vertex by vertex."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
TOLERANCE = 1e-5  # [m]
SHOTS = {
    "usd": "usd/shots/walk/model/anim.usdc",
    "composed": "usd/shots/walk/shot.usda",
    "blender": "blender/shots/walk/model/anim.usdc",
    "file": "file.usdc",
    "arkit": "package.usdz",
}
BAKES = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import conftest
from pathlib import Path
from ssilk_core.cli import main
from ssilk_usd.shots.play import Shot

conftest.write_hero(Path("hero.usda"))
conftest.write_clip(Path("clip.usda"))
conftest.write_clip(Path("walk.usda"), frames=8)
train = [*"train rigged.usda --motions clip.usda -o model.safetensors".split(), *conftest.TRAINING]
bake = "bake model.safetensors --stage rigged.usda --motion walk.usda".split()
for words in (
    "rig hero.usda --garment Skirt --proxies 4 -o rigged.usda".split(), train,
    [*bake, "-o", "usd"], *([*bake, "--target", target, "-o", output] for target, output in (
        ("blender", "blender"), ("blender", "file.usdc"), ("arkit", "package.usdz"))),
):
    assert main(words) in (0, 5), words  # 5: so few iterations do no good
for path in sys.argv[2:]:
    shot = Shot(path)
    np.save(path + ".npy", np.stack([shot.garment_points(time) for time in shot.frame_times]))
"""


@pytest.fixture(scope="module")
def baked(ssilk_python, tmp_path_factory) -> Path:
    """Shots of each kind, with what they should show beside them; none where no Blender would play them."""
    pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")
    folder = tmp_path_factory.mktemp("baked")
    command = [ssilk_python, "-c", BAKES, str(ROOT / "tests/end_to_end"), *SHOTS.values()]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


@pytest.mark.parametrize("name", SHOTS)
def test_blender_plays_what_was_computed(bpy, baked, name):
    expected = np.load(baked / f"{SHOTS[name]}.npy")
    bpy.ops.wm.usd_import(filepath=str(baked / SHOTS[name]))
    garment = next(thing for thing in bpy.data.objects if thing.type == "MESH" and thing.name.startswith("Skirt"))
    for frame, points in enumerate(expected):
        bpy.context.scene.frame_set(frame)
        np.testing.assert_allclose(posed(bpy, garment), points, atol=TOLERANCE)


def posed(bpy, garment) -> np.ndarray:
    """Return a mesh's vertices as Blender deforms them, y up [m], shape (V, 3)."""
    evaluated = garment.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    points = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    world = np.array(evaluated.matrix_world)
    x, y, z = (points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]).T
    return np.stack([x, z, -y], axis=-1)
