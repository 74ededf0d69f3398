# SPDX-License-Identifier: Apache-2.0
"""Nearest points by compiled loops against their references in float64, and how loops are run."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics import loops
from ssilk_core.physics.collision import Patches, PosedBody, nearest_planes
from ssilk_core.physics.collision.closest_point import triangle_patches
from ssilk_core.physics.collision.distance import MAX_DEPTH, MAX_QUERY_DISTANCE
from ssilk_core.physics.collision.nearest_vertex import nearest_vertex
from ssilk_core.physics.collision.one_ring import triangle_rings
from ssilk_core.scene.mesh.blocks import compact_blocks

pytest.importorskip("numba")
FRAMES, QUERIES = 5, 70


@pytest.fixture(autouse=True)
def served(monkeypatch) -> None:
    """Even where a test before switched them off."""
    monkeypatch.setattr(loops, "available", lambda device: device.type == "cpu")


@pytest.fixture(scope="module")
def body() -> PosedBody:
    """A ball of 20 cm, another one in each frame."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    rng = np.random.default_rng(0)
    points = ball.vertices[:, :, None] * rng.uniform(0.8, 1.2, (3, FRAMES))
    points += 0.002 * rng.normal(size=points.shape)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    return PosedBody(
        torch.tensor(points, dtype=torch.float32),
        torch.tensor(normals, dtype=torch.float32),
        torch.tensor(triangle_rings(ball.faces, 162)),
        torch.tensor(compact_blocks(ball.vertices, 8)),
        torch.tensor(np.array(ball.faces)),
        torch.tensor(triangle_patches(ball.vertices, ball.faces)),
    )


@pytest.fixture(scope="module")
def queries() -> torch.Tensor:
    """From the middle of the ball to 20 cm away from it."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(QUERIES, 3, FRAMES))
    x *= np.linspace(0, 0.4, QUERIES)[:, None, None] / np.linalg.norm(x, axis=1, keepdims=True)
    return torch.tensor(x, dtype=torch.float32)


def patches() -> Patches:
    """Each query can find its own 40 to 60 of the vertices, and no triangle of the list."""
    rng = np.random.default_rng(2)
    lists = [rng.permutation(162)[:60] for _ in range(QUERIES)]
    counts = rng.integers(40, 61, QUERIES)
    vertices = np.stack([np.concatenate([[count], own]) for count, own in zip(counts, lists)])
    vertices = np.where(np.arange(61) > counts[:, None], vertices[:, 1:2], vertices)  # padded with the first
    return Patches(torch.tensor(vertices.astype(np.int32)), torch.zeros(QUERIES, 0, dtype=torch.int64))


def double(body: PosedBody) -> PosedBody:
    return replace(body, points=body.points.double(), normals=body.normals.double())


@pytest.mark.parametrize("order", ["compact", "consecutive"])
def test_the_nearest_vertex_is_that_of_brute_force(body, queries, order):
    from ssilk_core.physics.loops.nearest_vertex import nearest_vertex_loop

    blocks = compact_blocks(queries[..., 0].numpy(), 16) if order == "compact" else np.arange(QUERIES)[None, :70]
    found = nearest_vertex_loop(queries, body.points, torch.tensor(blocks.astype(np.int32)), body.groups)
    assert torch.equal(found.long(), nearest_vertex(queries.double(), body.points.double()))


def test_what_is_far_enough_gets_a_vertex_as_far_away(body, queries):
    from ssilk_core.physics.loops.nearest_vertex import nearest_vertex_loop

    blocks, enough = torch.tensor(compact_blocks(queries[..., 0].numpy(), 8)), 0.06
    found = nearest_vertex_loop(queries, body.points, blocks, body.groups, enough).long()
    exact = nearest_vertex(queries.double(), body.points.double())
    least = (queries - body.points.gather(0, exact[:, None].expand(-1, 3, -1))).norm(dim=1)
    assert (found == exact)[least < enough].all() and not (found == exact).all()
    assert (least < enough).any()


def test_of_candidates_the_nearest_is_found(body, queries):
    from ssilk_core.physics.loops.nearest_vertex import nearest_candidate_loop

    allowed = patches().vertices
    found = nearest_candidate_loop(queries, body.points, allowed)
    assert torch.equal(found.long(), nearest_vertex(queries.double(), body.points.double(), allowed))


@pytest.mark.parametrize("tight", [False, True])
@pytest.mark.parametrize("surface", ["vertices", "rings", "faces"])
def test_planes_are_those_of_the_reference(body, queries, surface, tight):
    """Normals and distances, but for the few queries that lie on an edge between two triangles, by rounding."""
    if surface == "faces" and tight:
        pytest.skip("tight cloth meets rings, or triangles that no loop searches")
    body = replace(body, rings=body.rings if surface == "rings" else None)
    body = body if surface == "faces" else replace(body, faces=None)
    own = patches() if tight else None
    normal, offset = nearest_planes(queries, body, None, own)
    wanted, level = nearest_planes(queries.double(), double(body), None, own)
    distance = (normal.double() * queries).sum(1) - offset
    expected = (wanted * queries).sum(1) - level
    far = expected > (MAX_DEPTH if surface == "faces" else MAX_QUERY_DISTANCE)
    assert tight or surface == "faces" or 0.1 < far.double().mean() < 0.9
    assert (distance[far] > expected[far] - 3e-7).all()
    torch.testing.assert_close(distance[~far], expected[~far], rtol=0, atol=3e-7)
    assert ((normal - wanted).abs().amax(1) < 2e-5)[~far].double().mean() > 0.98


def test_results_do_not_depend_on_the_number_of_threads(body, queries):
    results = []
    for threads in (1, 3, 8):
        torch.set_num_threads(threads)
        results.append(nearest_planes(queries, replace(body, rings=None)))
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other))


@pytest.mark.slow
def test_a_step_depends_on_the_number_of_threads_by_rounding_alone(scene, toy_model, toy_motion, toy_objective):
    """Energies, contact, skinning and proxies, forward and backward; PyTorch splits its products by threads."""
    model = toy_model(scene, translations=True)
    objective = toy_objective(scene, model, toy_motion(scene, 40))
    frames, down = torch.arange(3, 36), torch.tensor([[0.0, -1.0, 0.0]]).expand(33, 3)
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        model.zero_grad()
        sum(values.sum() for values in objective.static(frames, down).values()).backward()
        results.append([value.grad.clone() for value in model.parameters() if value.grad is not None])
    assert len(results[0]) > 5
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, rtol=0, atol=3e-6 * float(one.abs().max()))


def test_loops_take_the_threads_that_pytorch_leaves_to_them():
    from ssilk_core.physics.loops.running import all_threads, run_parts

    torch.set_num_threads(3)
    parts: list[int] = []
    with all_threads():
        assert torch.get_num_threads() == 1
        run_parts(lambda start, stop: parts.append(stop - start), 6)
    assert parts == [2, 2, 2] and torch.get_num_threads() == 3


def test_a_query_that_is_not_a_number_spoils_no_other(body, queries):
    broken = queries.clone()
    broken[3, 1, 2] = torch.nan
    for surface in (replace(body, rings=None), replace(body, rings=None, faces=None)):
        found, expected = nearest_planes(broken, surface), nearest_planes(queries, surface)
        for values, others in zip(found, expected):
            others = others.clone()
            others[3, ..., 2] = values[3, ..., 2]
            assert torch.equal(values.nan_to_num(0), others.nan_to_num(0))
        assert found[1][3, 2].isnan()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_has_threads_of_its_own():
    code = """
import os, torch
from ssilk_core.physics.loops.running import run_parts
torch.set_num_threads(3)
done = []
run_parts(lambda start, stop: done.append(stop - start), 9)
child = os.fork()
if not child:
    run_parts(lambda start, stop: done.append(stop - start), 9)
    os._exit(0 if done == 6 * [3] else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=100, check=False).returncode == 0


def test_a_fault_in_any_part_is_raised():
    from ssilk_core.physics.loops.running import run_parts

    def work(start: int, stop: int) -> None:
        if stop == 4:
            raise ValueError("the last part")

    torch.set_num_threads(2)
    with pytest.raises(ValueError, match="the last part"):
        run_parts(work, 4)


@pytest.mark.parametrize("problem", [ImportError("numba needs another numpy")])
def test_a_numba_that_cannot_be_imported_is_told_and_left(problem, monkeypatch):
    whole = builtins.__import__

    def without(name, *words, **named):
        if name == "numba":
            raise problem
        return whole(name, *words, **named)

    for name in [name for name in sys.modules if name == "numba" or name.endswith("loops.compiling")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(loops, "compiling", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.warns(UserWarning, match="numba cannot be used, .* takes five times as long: numba needs"):
        assert not loops.installed.__wrapped__()


def test_loops_are_compiled_where_nothing_can_be_kept(monkeypatch):
    from ssilk_core.physics.loops import compiling

    asked, whole = [], compiling.numba.njit

    def njit(**options):
        asked.append(options.pop("cache", False))
        if asked[-1]:
            raise RuntimeError("cannot cache function: no locator available")
        return whole(**options)

    monkeypatch.setattr(compiling.numba, "njit", njit)
    assert compiling.compiled(lambda value: value + 1)(2) == 3 and asked == [True, False]
