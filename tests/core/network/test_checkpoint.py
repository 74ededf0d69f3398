# SPDX-License-Identifier: Apache-2.0
"""Model files: what goes in comes out, and whatever else is met is refused in one sentence."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, model_file, network, save_model
from ssilk_core.network.packing import MAX_INTEGER, narrowest
from ssilk_core.scene.fabrics import FABRICS


@pytest.fixture(scope="module")
def model(scene, toy_model):
    return toy_model(scene)


@pytest.fixture
def path(tmp_path, model) -> Path:
    target = tmp_path / "model.safetensors"
    save_model(target, model_file(model, FABRICS["silk"], {"seed": 3, "inputs": {"a.usd": "00"}}))
    return target


def header_of(path: Path) -> dict:
    size = int.from_bytes(path.read_bytes()[:8], "little")
    return json.loads(json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"]["ssilk"])


def rewrite(path: Path, change: Callable[[dict, dict], None]) -> None:
    tensors, document = load_file(path), header_of(path)
    change(tensors, document)
    save_file({k: np.ascontiguousarray(v) for k, v in tensors.items()}, path, {"ssilk": json.dumps(document)})


def assert_one_sentence(error: pytest.ExceptionInfo[SsilkError], path: Path) -> None:
    text = str(error.value)
    assert text.startswith((str(path), "/toy")), text
    assert text.endswith(".") and "\n" not in text and len(text) < 400, text


def test_a_round_trip_is_exact(path, model):
    read = load_model(path)
    assert read.config == model.config and read.fabric == FABRICS["silk"]
    assert read.provenance == {"seed": 3, "inputs": {"a.usd": "00"}}
    for name, value in model.state_dict().items():
        np.testing.assert_array_equal(read.parameters[name], value.numpy())
    for mine, theirs in (
        (read.scene.character.skeleton, model.scene.character.skeleton),
        (read.scene.garment.mesh, model.scene.garment.mesh),
        (read.scene.lbs_skin, model.scene.lbs_skin),
        (read.scene.rig, model.scene.rig),
        (read.scene.rig.skin, model.scene.rig.skin),
    ):
        for item in fields(mine):
            if item.name != "skin":
                np.testing.assert_array_equal(getattr(mine, item.name), getattr(theirs, item.name), err_msg=item.name)
    np.testing.assert_array_equal(read.scene.classes, model.scene.classes)
    assert read.scene.character.bodies == ()


def test_a_model_knows_the_colour_of_its_garment(path, tmp_path):
    file = load_model(path)
    assert file.scene.garment.colour is None and "colour" not in header_of(path)
    garment = replace(file.scene.garment, colour=(0.25, 0.5, 1.0))
    save_model(tmp_path / "dyed.safetensors", replace(file, scene=replace(file.scene, garment=garment)))
    assert load_model(tmp_path / "dyed.safetensors").scene.garment.colour == (0.25, 0.5, 1.0)


def test_a_model_knows_the_scales_of_its_joints(path, tmp_path):
    """Clips that stand alone have them, also where no stage is at hand, as in 'ssilk reduce'."""
    file = load_model(path)
    assert file.scene.character.skeleton.scales is None and "scales" not in header_of(path)
    skeleton = replace(file.scene.character.skeleton, scales=np.array([1.0, -1.0, 2.0]))
    scene = replace(file.scene, character=replace(file.scene.character, skeleton=skeleton))
    save_model(tmp_path / "scaled.safetensors", replace(file, scene=scene))
    np.testing.assert_array_equal(
        load_model(tmp_path / "scaled.safetensors").scene.character.skeleton.scales, [1, -1, 2]
    )


@pytest.mark.parametrize("colour", [[float("nan"), 0.0, 0.0], "123", [0.1, 0.2], {"0": 1.0, "1": 1.0, "2": 1.0}, 0.5])
def test_a_damaged_colour_is_refused(path, colour):
    rewrite(path, lambda tensors, document: document.update(colour=colour))
    with pytest.raises(SsilkError, match="incomplete or inconsistent"):
        load_model(path)


@torch.no_grad()
def test_a_read_model_computes_what_the_written_one_did(path, model):
    again = network(load_model(path))
    z = torch.randn(4, 8, generator=torch.Generator().manual_seed(0))
    character = torch.randn(3, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    assert torch.equal(again.vertices(z, character), model.vertices(z, character))
    assert not again.training


def test_saving_twice_gives_the_same_bytes(path, model, tmp_path):
    other = tmp_path / "other.safetensors"
    save_model(other, load_model(path))
    assert other.read_bytes() == path.read_bytes()


def test_a_byte_that_changed_anywhere_is_found(path):
    whole = path.read_bytes()
    load_model(path)
    for place in np.linspace(8, len(whole) - 1, 150).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(SsilkError, match="damaged"):
            load_model(path)


def test_a_model_that_another_program_rewrote_has_no_checksum_and_is_read(path):
    assert (
        "sha256"
        in json.loads(path.read_bytes()[8 : 8 + int.from_bytes(path.read_bytes()[:8], "little")])["__metadata__"]
    )
    rewrite(path, lambda tensors, document: None)
    assert load_model(path).provenance["seed"] == 3


@pytest.mark.parametrize("shapes, proxies", [(0, 2), (4, 0)])
def test_models_without_shapes_or_proxies_round_trip(toy_scene, toy_model, tmp_path, shapes, proxies):
    model = toy_model(toy_scene(proxies=proxies), shapes=shapes)
    save_model(tmp_path / "m.safetensors", model_file(model, FABRICS["silk"], {}))
    again = network(load_model(tmp_path / "m.safetensors"))
    assert again.deformer().shape_count == model.deformer().shape_count
    assert again.scene.rig.proxy_count == proxies


def test_a_packed_model_is_what_it_was_to_16_bits(path, model, tmp_path):
    small = tmp_path / "small.safetensors"
    save_model(small, load_model(path), pack=True)
    read = load_model(small)
    for name, value in model.state_dict().items():
        mine, found = value.numpy(), read.parameters[name]
        assert found.dtype == np.float32
        if value.ndim == 1:
            np.testing.assert_array_equal(found, mine)
        else:
            largest = np.abs(mine).max(axis=tuple(range(1, mine.ndim)), keepdims=True)
            # Half a step, and what single precision loses of a quotient of up to 32,767.
            assert (np.abs(found - mine) <= 0.505 * largest / MAX_INTEGER + 1e-30).all(), name
    for mine, found in ((model.scene.lbs_skin, read.scene.lbs_skin), (model.scene.rig.skin, read.scene.rig.skin)):
        np.testing.assert_array_equal(found.indices, mine.indices)
        np.testing.assert_allclose(found.weights, mine.weights, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(read.scene.garment.mesh.points, model.scene.garment.mesh.points)
    matrices = sum(value.numel() for value in model.state_dict().values() if value.ndim > 1)
    assert small.stat().st_size < path.stat().st_size - 1.5 * matrices


@torch.no_grad()
def test_a_packed_model_moves_as_the_whole_one_does(path, model, tmp_path):
    small = tmp_path / "small.safetensors"
    save_model(small, load_model(path), pack=True)
    z = torch.randn(4, 8, generator=torch.Generator().manual_seed(0))
    character = torch.randn(3, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    moved = (network(load_model(small)).vertices(z, character) - model.vertices(z, character)).abs().max()
    assert 0 < moved < 1e-4


def test_packing_what_was_packed_changes_nothing(path, tmp_path):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    save_model(first, load_model(path), pack=True)
    save_model(second, load_model(first), pack=True)
    again, once = load_model(second).parameters, load_model(first).parameters
    for name, value in once.items():
        np.testing.assert_allclose(again[name], value, rtol=0, atol=1e-6 * np.abs(value).max())


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([0, 255], np.uint8),
        ([0, 40_000], np.uint16),
        ([-1, 30], np.int16),
        ([-1, 70_000], np.int32),
        (np.zeros(0, np.int64), np.uint8),
        ([0.5, 0.25], np.float32),
        ([0.5, 0.1], np.float64),
        (np.float32([0.5, 0.1]), np.float32),
    ],
)
def test_arrays_are_stored_as_narrow_as_they_stay_exact(values, kind):
    stored = narrowest(np.asarray(values))
    assert stored.dtype == kind
    np.testing.assert_array_equal(stored, values)


def test_a_file_cut_short_anywhere_is_refused(path):
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for size in {0, 1, 7, 8, 9, header - 1, header, header + 1, *np.linspace(10, len(whole) - 1, 40).astype(int)}:
        path.write_bytes(whole[:size])
        with pytest.raises(SsilkError) as error:
            load_model(path)
        assert_one_sentence(error, path)


def test_a_file_with_any_one_byte_of_its_header_changed_never_ends_in_a_traceback(path):
    whole = bytearray(path.read_bytes())
    header = 8 + int.from_bytes(whole[:8], "little")
    for place in np.random.default_rng(0).choice(header, 150, replace=False):
        changed = whole.copy()
        changed[place] ^= 0x15
        path.write_bytes(changed)
        try:
            network(load_model(path))
        except SsilkError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    "content",
    [b"", b"not a model", b"\xff" * 64, b"PK\x03\x04" + b"\0" * 100, (1 << 40).to_bytes(8, "little") + b"{}"],
)
def test_what_is_no_safetensors_file_is_refused(tmp_path, content):
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(content)
    with pytest.raises(SsilkError) as error:
        load_model(path)
    assert_one_sentence(error, path)


def test_a_missing_file_a_folder_and_a_foreign_safetensors_file_are_refused(tmp_path):
    save_file({"weight": np.zeros(3)}, tmp_path / "foreign.safetensors")
    for name, words in (
        ("none.safetensors", "there is no such model file"),
        (".", "there is no such model file"),
        ("foreign.safetensors", "without SSILK's header"),
    ):
        with pytest.raises(SsilkError, match=words) as error:
            load_model(tmp_path / name)
        assert_one_sentence(error, tmp_path)


def test_a_header_nested_too_deep_is_refused(tmp_path):
    path = tmp_path / "deep.safetensors"
    save_file({"weight": np.zeros(3)}, path, {"ssilk": "[" * 100_000})
    with pytest.raises(SsilkError, match="header is damaged") as error:
        load_model(path)
    assert_one_sentence(error, path)


def set_tensor(name: str, value: object) -> Callable[[dict, dict], None]:
    return lambda tensors, document: tensors.__setitem__(name, np.asarray(value))


def set_header(name: str, value: object) -> Callable[[dict, dict], None]:
    return lambda tensors, document: document.__setitem__(name, value)


def poison(name: str) -> Callable[[dict, dict], None]:
    def change(tensors: dict, document: dict) -> None:
        tensors[name] = tensors[name].copy()
        tensors[name].reshape(-1)[0] = np.nan

    return change


def drop(name: str) -> Callable[[dict, dict], None]:
    return lambda tensors, document: (tensors if name in tensors else document).pop(name)


def configure(**changes: object) -> Callable[[dict, dict], None]:
    return lambda tensors, document: document["config"].update(changes)


DAMAGE = {
    "another format": (set_header("format", 99), "model format 99; this version reads format 6"),
    "an older format": (
        set_header("format", 5),
        "model format 5; this version reads format 6; train it again",
    ),
    "header is a list": (lambda tensors, document: document.clear(), "model format None"),
    "integers without their scale": (
        set_tensor("model.output.0.weight", np.ones((16, 8), np.int16)),
        "incomplete.*scale.model.output.0.weight",
    ),
    "NaN parameter": (poison("model.stepper.0.weight"), "'stepper.0.weight' holds NaN"),
    "NaN points": (poison("scene.mesh.points"), "NaN or infinity"),
    "no points": (drop("scene.mesh.points"), "incomplete.*scene.mesh.points"),
    "no joints": (drop("joints"), "incomplete.*joints"),
    "no config": (drop("config"), "incomplete.*config"),
    "scales of other joints": (set_header("scales", [1.0, 2.0]), "for 3 joints"),
    "scales in words": (set_header("scales", ["a", "b", "c"]), "incomplete"),
    "no paths": (drop("paths"), "incomplete.*paths"),
    "paths are a number": (set_header("paths", 3), "incomplete"),
    "a parameter missing": (drop("model.output.0.bias"), "do not fit its header"),
    "a parameter too many": (set_tensor("model.more", [1.0]), "do not fit its header"),
    "a parameter of another shape": (set_tensor("model.output.0.bias", np.zeros(3)), "do not fit its header"),
    "another size in the config": (configure(latent=9), "do not fit its header"),
    "half a size in the config": (configure(latent=32.5), "incomplete.*'latent' is 32.5, which is not of type int"),
    "a size in the config that is a float": (configure(latent=1e8), "incomplete.*'latent'"),
    "a size in the config that is true or false": (configure(shapes=True), "incomplete.*'shapes'"),
    "half a width": (configure(widths=[16.5]), "incomplete.*16.5"),
    "widths that are one number": (configure(widths=16), "incomplete.*'widths'"),
    "sizes beyond memory": (configure(latent=10**4, widths=[10**4, 10**4]), "do not fit its header"),
    "sizes beyond all memory": (configure(latent=10**9, widths=[10**18, 10**18]), "at most 65536"),
    "sizes beyond all integers": (configure(widths=[10**30]), "at most 65536"),
    "a scheme that is a list": (configure(scheme=["verlet"]), "incomplete.*'scheme'"),
    "an unknown setting": (configure(temperature=1), "incomplete.*temperature"),
    "an impossible setting": (configure(latent=-1), "latent"),
    "a setting of another type": (configure(latent="many"), "incomplete"),
    "an unknown scheme": (configure(scheme="magic"), "'magic'"),
    "an unknown fabric": (set_header("fabric", {"name": "f", "density": -1.0}), "density = -1.0"),
    "a density in words": (set_header("fabric", {"name": "f", "density": "1"}), "incomplete.*'density'"),
    "a fabric of no name": (set_header("fabric", {"name": None}), "incomplete.*'name'"),
    "provenance is a list": (
        set_header("provenance", [1]),
        r"incomplete.*'provenance' is \[1\], which is not of type dict",
    ),
    "a joint that is a number": (set_header("joint_names", ["a", 7, "b"]), "incomplete.*7, which is not of type str"),
    "joints that are one word": (set_header("joint_names", "abc"), "incomplete.*'joint_names'"),
    "a path that is a number": (
        set_header("paths", {"skeleton": "/a", "garment": 3, "rig": "/c"}),
        "incomplete.*3, which is not of type str",
    ),
    "fabric is a word": (set_header("fabric", "silk"), "incomplete"),
    "a cycle of joints": (set_tensor("scene.skeleton.parents", [1, 2, 0]), "precedes its parent"),
    "too few parents": (set_tensor("scene.skeleton.parents", [-1]), "1 parents for 3 joints"),
    "parents of two dimensions": (set_tensor("scene.skeleton.parents", np.zeros((3, 2))), "parent"),
    "faces past the points": (set_tensor("scene.mesh.faces", [[0, 1, 999]]), "outside 0 to 59"),
    "faces without corners": (set_tensor("scene.mesh.faces", [1, 2, 3]), "no faces"),
    "polygons that do not add up": (set_tensor("scene.mesh.polygon_counts", [3, 3]), "polygon"),
    "polygons past the points": (set_tensor("scene.mesh.polygon_indices", np.full(88 * 3, 60)), "polygon"),
    "classes of another garment": (set_tensor("scene.classes", [0, 1]), "2 vertex classes for 60 points"),
    "negative weights": (set_tensor("scene.rig.weights", -np.ones((60, 2))), "negative"),
    "weights without indices": (set_tensor("scene.rig.indices", [[0]]), "indices of shape"),
    "weights on no joint": (set_tensor("scene.rig.indices", np.full((60, 2), 77)), "outside 0 to 4"),
    "descriptors of no joint": (set_tensor("joints", [7]), "0 to 2"),
    "descriptors of joints in a table": (set_tensor("joints", [[0], [1], [2]]), "0 to 2"),
    "descriptors of part of a joint": (set_tensor("joints", [0.5]), "0 to 2"),
    "proxies before their parents": (set_tensor("scene.rig.parents", [4, 1]), "precedes its parent"),
    "bind transforms that scale": (
        set_tensor("scene.rig.bind_transforms", np.diag([2.0, 2, 2, 1])[None].repeat(2, 0)),
        "scale",
    ),
    "bind transforms of nothing": (set_tensor("scene.skeleton.bind_transforms", np.zeros(3)), "shape"),
}


@pytest.mark.parametrize("change, words", DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_is_named_in_one_sentence(path, change, words):
    rewrite(path, change)
    with pytest.raises(SsilkError) as error:
        network(load_model(path))
    assert_one_sentence(error, path)
    assert re.search(words, str(error.value)), error.value


def test_the_untouched_rewrite_is_fine(path):
    rewrite(path, lambda tensors, document: None)
    network(load_model(path))


def test_numbers_that_numpy_lacks_are_refused(tmp_path, path):
    from safetensors.torch import save_file as save_torch

    save_torch({"joints": torch.zeros(3, dtype=torch.bfloat16)}, path, {"ssilk": json.dumps(header_of(path))})
    with pytest.raises(SsilkError) as error:
        load_model(path)
    assert_one_sentence(error, path)


def test_a_full_disk_leaves_the_old_model_and_nothing_else(path):
    """A limit on file sizes stands in for a disk without space."""
    before = path.read_bytes()
    code = (
        "import resource, sys\n"
        "from ssilk_core.network.checkpoint import *; from ssilk_core.errors import SsilkError\n"
        "model = load_model(sys.argv[1]); resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "try: save_model(sys.argv[1], model)\n"
        "except SsilkError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{path}: writing failed") and done.stdout.count("\n") == 1
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]
