# SPDX-License-Identifier: Apache-2.0
"""Skinning and proxy kernels against their references in float64: values, gradients, and the same bits twice.

Triton's kernels, and the loops that numba compiles for a processor.
"""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ssilk_core.network.model.decoder import compose, rotation_from_six_d
from ssilk_core.physics import kernels, loops
from ssilk_core.physics.skinning import PARTS, Skinning, by_joint
from ssilk_core.scene.assets import SkinWeights

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
JOINTS, FIRST_PROXY = 7, 4
VERTICES, INFLUENCES = 10, 4


@pytest.fixture(autouse=True, params=["kernels", "loops"])
def fused(request, monkeypatch) -> str:
    """Which of both serves a device. Where there is no GPU, Triton's interpreter runs the kernels."""
    pytest.importorskip({"kernels": "triton", "loops": "numba"}[request.param])
    monkeypatch.setattr(kernels, "available", lambda device: request.param == "kernels")
    monkeypatch.setattr(loops, "available", lambda device: request.param == "loops")
    if request.param == "loops":
        monkeypatch.setattr(sys.modules[__name__], "DEVICE", torch.device("cpu"))
    return request.param


def random_numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_skin() -> SkinWeights:
    """Between one and all influences, with zeros before, between and behind them and some joints named twice."""
    generator = np.random.default_rng(5)
    weights = generator.random((VERTICES, INFLUENCES)) * (generator.random((VERTICES, INFLUENCES)) < 0.5)
    weights[np.arange(VERTICES), np.arange(VERTICES) % INFLUENCES] += 0.1
    indices = generator.integers(0, JOINTS - 1, weights.shape)  # the last joint moves nothing
    return SkinWeights("/random", indices, weights)


def random_matrices(frames: int) -> Tensor:
    turns = Rotation.random(JOINTS * frames, random_state=2).as_matrix().reshape(JOINTS, frames, 3, 3)
    shifts = 0.5 * random_numbers(JOINTS, 3, 1, frames, seed=3)
    return torch.cat([torch.tensor(turns).permute(0, 2, 3, 1), shifts], dim=2)


def assert_agree(found: Tensor, expected: Tensor, tolerance: float = 2e-6) -> None:
    """Compare with float64 in the largest error, direction and signed bias, all relative."""
    found = found.detach().cpu().double()
    assert found.shape == expected.shape
    if not expected.any():
        assert not found.any()
        return
    assert (found - expected).abs().max() < tolerance * expected.abs().max()
    assert 1 - torch.nn.functional.cosine_similarity(found.flatten(), expected.flatten(), dim=0) < 1e-11
    assert abs((found - expected).sum()) < 0.1 * tolerance * expected.abs().sum()


def reference(skin: SkinWeights, rest: Tensor, offsets: Tensor, weights: Tensor, matrices: Tensor) -> Tensor:
    """Skin influence by influence."""
    points = torch.cat([rest[:, :, None] + offsets, torch.ones_like(offsets[:, :1])], dim=1)
    moving = matrices[torch.tensor(skin.indices).long()]
    return torch.einsum("vi,viabn,vbn->van", weights, moving, points)


def on_device(*values: Tensor) -> list[Tensor]:
    """Return copies in float32, as leaves."""
    return [value.detach().float().to(DEVICE).requires_grad_(value.requires_grad) for value in values]


@pytest.mark.parametrize("frames, deformed", [(131, True), (3, False)], ids=["offsets", "rest"])
def test_skinning_and_its_gradients_equal_the_sum_over_influences(frames, deformed):
    skin = random_skin()
    rest, weights = random_numbers(VERTICES, 3), torch.tensor(skin.weights).requires_grad_()
    offsets = 0.1 * random_numbers(VERTICES, 3, frames, seed=1) * deformed
    matrices, upstream = random_matrices(frames).requires_grad_(), random_numbers(VERTICES, 3, frames, seed=4)
    offsets.requires_grad_(deformed)
    expected = reference(skin, rest, offsets, weights, matrices)
    expected.backward(upstream)
    module = Skinning(skin, range(FIRST_PROXY, JOINTS)).to(DEVICE)
    inputs = on_device(rest, offsets, weights, matrices)
    found = module(inputs[0], inputs[1] if deformed else None, *inputs[2:])
    found.backward(upstream.float().to(DEVICE))
    assert_agree(found, expected.detach())
    assert_agree(inputs[2].grad[module.weights > 0], weights.grad[torch.tensor(skin.weights > 0)])
    assert_agree(inputs[3].grad[FIRST_PROXY:], matrices.grad[FIRST_PROXY:])
    assert not inputs[3].grad[:FIRST_PROXY].any()
    if deformed:
        assert_agree(inputs[1].grad, offsets.grad)


def test_skinning_gives_the_same_bits_again():
    skin = random_skin()
    module = Skinning(skin, range(FIRST_PROXY, JOINTS)).to(DEVICE)
    results = []
    for _ in range(2):
        values = [random_numbers(VERTICES, 3, 5, seed=1), module.weights.cpu(), random_matrices(5)]
        inputs = on_device(*(value.requires_grad_() for value in values))
        found = module(random_numbers(VERTICES, 3).float().to(DEVICE), *inputs)
        (found**2).sum().backward()
        results.append([found, *(value.grad for value in inputs)])
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_without_trainable_joints_matrices_get_no_gradient():
    module = Skinning(random_skin()).to(DEVICE)
    rest, matrices = on_device(random_numbers(VERTICES, 3), random_matrices(2).requires_grad_())
    module(rest, None, module.weights, matrices).sum().backward()
    assert matrices.grad is None


def test_a_surface_turns_its_normals_with_the_blended_matrices():
    skin = random_skin()
    points, normals, matrices = random_numbers(VERTICES, 3), random_numbers(VERTICES, 3, seed=1), random_matrices(4)
    weights = torch.tensor(skin.weights)
    still = matrices.clone()
    still[:, :, 3] = 0
    none = torch.zeros(VERTICES, 3, 4).double()
    turned = reference(skin, normals, none, weights, still)
    found = Skinning(skin).to(DEVICE).surface(*on_device(points, normals, matrices))
    assert_agree(found[0], reference(skin, points, none, weights, matrices))
    assert_agree(found[1], turned / turned.norm(dim=1, keepdim=True))


def test_parts_hold_each_influence_of_a_trainable_joint_once():
    skin = random_skin()
    entries, starts = by_joint(skin.indices, skin.weights > 0, range(FIRST_PROXY, JOINTS))
    assert starts.shape == (JOINTS - FIRST_PROXY, PARTS + 1)
    np.testing.assert_array_equal(starts[1:, 0], starts[:-1, -1])
    for joint, (start, stop) in zip(range(FIRST_PROXY, JOINTS), starts[:, [0, -1]]):
        expected = np.flatnonzero((skin.indices == joint) & (skin.weights > 0))
        np.testing.assert_array_equal(entries[start:stop], expected)


def plain_proxies(values: Tensor, pivots: Tensor, parents: list[int], character: Tensor) -> Tensor:
    matrices = list(character)
    for turn, pivot, moved, parent in zip(rotation_from_six_d(values[:, :6]), pivots, values[:, 6:], parents):
        shift = pivot[:, None, None] - torch.einsum("abn,b->an", turn, pivot)[:, None]
        if len(moved):
            shift = shift + moved[:, None]
        matrices.append(compose(matrices[parent], torch.cat([turn, shift], dim=1)))
    return torch.stack(matrices)


TREES = {
    "chain": [2, 7, 8, 9],
    "star": [1, 1, 0, 6],
    "tree": [3, 7, 7, 8, 2, 11, 9],
    "none": [],
}


def proxies_on_device(tree: list[int], values: Tensor, character: Tensor, upstream: Tensor) -> list[Tensor]:
    """Return the fused matrices and gradient."""
    if loops.available(DEVICE):
        from ssilk_core.physics.loops.proxies import proxies_loop as composed
    else:
        from ssilk_core.physics.kernels.proxies import proxies_kernel as composed
    pivots, values, character, upstream = on_device(random_numbers(len(tree), 3), values, character, upstream)
    parents = torch.tensor(tree, dtype=torch.int32, device=DEVICE)
    found = composed(values.requires_grad_(), pivots, parents, character)
    found.backward(upstream)
    return [found, values.grad]


@pytest.mark.parametrize("size", [6, 9], ids=["turning", "moving"])
@pytest.mark.parametrize("tree, frames", [("chain", 3), ("star", 3), ("tree", 35), ("none", 3)])
def test_proxies_and_their_gradient_equal_the_composed_transforms(tree, frames, size):
    parents = TREES[tree]
    values = random_numbers(len(parents), size, frames, seed=1).requires_grad_()
    character = random_matrices(frames)
    upstream = random_numbers(JOINTS + len(parents), 3, 4, frames, seed=2)
    expected = plain_proxies(values, random_numbers(len(parents), 3), parents, character)
    if parents:
        expected.backward(upstream)
    found = proxies_on_device(parents, values, character, upstream)
    assert_agree(found[0], expected.detach())
    assert_agree(found[1], values.grad if parents else torch.zeros_like(values), tolerance=2e-5)
    again = proxies_on_device(parents, values, character, upstream)
    assert all(torch.equal(a, b) for a, b in zip(found, again))


@pytest.mark.parametrize("zero", [slice(0, 3), slice(3, 6), slice(0, 6)], ids=["first", "second", "both"])
def test_degenerate_six_d_rotations_are_clamped_as_the_reference_clamps_them(zero):
    six_d = random_numbers(2, 6, 3, seed=1)
    six_d[0, zero] = 0
    six_d.requires_grad_()
    upstream = random_numbers(JOINTS + 2, 3, 4, 3, seed=2)
    character = random_matrices(3)
    expected = plain_proxies(six_d, random_numbers(2, 3), [1, 7], character)
    expected.backward(upstream)
    found = proxies_on_device([1, 7], six_d, character, upstream)
    assert torch.isfinite(found[1]).all()
    assert_agree(found[0], expected.detach())
    assert_agree(found[1], six_d.grad)


@pytest.mark.parametrize("shapes, proxies, translations", [(4, 2, False), (4, 2, True), (0, 2, False), (4, 0, True)])
def test_a_decoder_trains_by_kernels_as_it_does_without(
    toy_scene, toy_motion, toy_model, monkeypatch, fused, shapes, proxies, translations
):
    from ssilk_core.scene.kinematics import centred_matrices

    scene = toy_scene(proxies=proxies)
    matrices, _ = centred_matrices(toy_motion(scene, 3), scene.character.skeleton)
    character = torch.tensor(matrices[:, :, :3].transpose(1, 2, 3, 0))
    output = 0.5 * random_numbers(3, shapes + (9 if translations else 6) * proxies)
    results = []
    for device, dtype, served in ((torch.device("cpu"), torch.float64, False), (DEVICE, torch.float32, True)):
        monkeypatch.setattr({"kernels": kernels, "loops": loops}[fused], "available", lambda device, s=served: s)
        decoder = toy_model(scene, shapes=shapes, translations=translations).decoder.to(device, dtype)
        given = output.clone().to(device, dtype).requires_grad_()
        x = decoder.vertices(given, character.to(device, dtype))
        (x**2).sum().backward()
        gradients = [given.grad, decoder.skin_offset.grad, *([decoder.shapes.grad] if shapes else [])]
        results.append([x.detach(), *gradients])
    for found, expected in zip(results[1], results[0]):
        assert_agree(found, expected, tolerance=2e-5)
