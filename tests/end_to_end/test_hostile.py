# SPDX-License-Identifier: Apache-2.0
"""Hostile and broken files: one sentence within seconds and in bounded memory, nothing executed, nothing fetched."""

from __future__ import annotations

import json
import os
import resource
import struct
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pxr import Sdf, Usd, UsdGeom, Vt
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from ssilk_usd.opening.memory import bounded_memory
from ssilk_usd.opening.trial import ending
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model

SETTINGS = settings(max_examples=60, deadline=None, derandomize=True, database=None,
                    suppress_health_check=list(HealthCheck))  # fmt: skip
REFUSED, READ = 2, 0


@pytest.fixture(autouse=True, scope="module")
def read_at_once() -> None:
    """Files are read in another process first, as users' are."""


@pytest.fixture(scope="module")
def files(toy, tmp_path_factory):
    """Valid files of each kind that is read."""
    folder = tmp_path_factory.mktemp("hostile")
    toy.copy(folder)
    for name in ("rigged", "clip"):
        Sdf.Layer.FindOrOpen(str(folder / f"{name}.usda")).Export(str(folder / f"{name}.usdc"))
    model = folder / "model.safetensors"
    with safe_open(model, "numpy") as stream:  # without its checksum, which would refuse any change at once
        words = {"ssilk": stream.metadata()["ssilk"]}
    save_file(load_file(model), model, words)
    return folder


def outcome(read: Callable[[], object]) -> int:
    """Read in this process, which must live on; return whether it is read or refused with one sentence."""
    try:
        read()
    except SsilkError as error:
        assert str(error).endswith(".")
        return REFUSED
    return READ


EDITS = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(["flip", "huge", "zero", "insert", "cut"]),
        st.integers(0, 255),
    ),
    min_size=1,
    max_size=6,
)


def edited(content: bytes, edits: list[tuple[float, str, int]]) -> bytes:
    damaged = bytearray(content)
    for where, kind, byte in edits:
        at = int(where * len(damaged))
        if kind == "flip":
            damaged[at : at + 1] = bytes([byte])
        elif kind == "huge":
            damaged[at : at + 8] = struct.pack("<Q", 10**9 << (byte % 8))
        elif kind == "zero":
            damaged[at : at + 16] = bytes(16)
        elif kind == "insert":
            damaged[at:at] = bytes([byte] * 4)
        else:
            del damaged[max(at, 1) :]
    return bytes(damaged)


@pytest.mark.parametrize("name", ["rigged.usdc", "rigged.usda", "clip.usdc", "clip.usda", "model.safetensors"])
def test_damaged_bytes_are_read_or_refused(files, tmp_path, name):
    content, path = (files / name).read_bytes(), tmp_path / name
    skeleton = read_character(files / "hero.usda").skeleton

    def read() -> object:
        if name.startswith("rigged"):
            return read_scene(path)
        return read_motion(path, skeleton) if name.startswith("clip") else load_model(path)

    @SETTINGS
    @given(edits=EDITS)
    def each(edits):
        path.write_bytes(edited(content, edits))
        assert outcome(read) in (READ, REFUSED)

    each()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=5,
)


@SETTINGS
@given(data=st.data())
def test_any_header_of_a_model_is_read_or_refused(files, data):
    content = (files / "model.safetensors").read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    document = json.loads(header["__metadata__"]["ssilk"])
    parent = data.draw(st.sampled_from([document, document["config"], document["fabric"], document["paths"]]))
    parent[data.draw(st.sampled_from(sorted(parent)))] = data.draw(VALUES)
    tensor = data.draw(st.sampled_from(sorted(header)))
    if tensor != "__metadata__":
        field = data.draw(st.sampled_from(["dtype", "shape", "data_offsets"]))
        header[tensor][field] = data.draw(st.sampled_from([
            "F64", "I64", "BF16", [1], [10**9, 10**9], [0], [0, 2**63], header[tensor][field]]))  # fmt: skip
    header["__metadata__"]["ssilk"] = json.dumps(document)
    text = json.dumps(header).encode()
    path = files / "mutated.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])
    try:
        load_model(path)
    except SsilkError as error:
        assert str(error).startswith(str(path)) and str(error).endswith(".")


STAGES = {
    "cycle of references": '(defaultPrim="A")\ndef "A" (references=@./STAGE@){}',
    "cycle of layers": "(\n subLayers = [@./STAGE@]\n)",
    "missing layer": '(defaultPrim="A")\ndef "A" (references=@./gone.usda@){}',
    "a file outside that is no USD": '(defaultPrim="A")\ndef "A" (references=@/etc/passwd@){}',
    "a path that climbs out": '(defaultPrim="A")\ndef "A" (payload=@../../../../../../etc/hosts@){}',
    "an address": '(defaultPrim="A")\ndef "A" (references=@http://127.0.0.1:9/x.usda@</A>){}',
    "a program for a name": '(defaultPrim="A")\ndef "A" (references=@$(touch owned).usda@){}',
    "deep nesting": "\n" + "".join(f'def "a{depth}" {{' for depth in range(3000)) + "}" * 3000,
    "no UTF-8": '\ndef "\udcff" {}',
    "a rate of nothing": "(timeCodesPerSecond = 0\n framesPerSecond = -1)\ndef SkelAnimation \"A\" {}",
    "prims that double 22 times": '(defaultPrim="A22")\ndef "A0" {}' + "".join(
        f'\ndef "A{n + 1}" {{\n def "x" (references=</A{n}>) {{}}\n def "y" (references=</A{n}>) {{}}\n}}'
        for n in range(22)
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STAGES)
def test_hostile_stages_are_refused(files, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SSILK_READ_SECONDS", "2")
    path = tmp_path / "stage.usda"
    text = f"#usda 1.0\n{STAGES[name].replace('STAGE', path.name)}\n"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    skeleton = read_character(files / "hero.usda").skeleton
    assert outcome(lambda: read_scene(path)) == REFUSED
    assert outcome(lambda: read_motion(path, skeleton)) == REFUSED
    assert sorted(item.name for item in tmp_path.iterdir()) == ["stage.usda"]


def test_what_would_crash_or_hang_does_so_where_it_harms_nobody(monkeypatch):
    """Stands for what USD does with some damaged bytes, which differ from version to version."""
    monkeypatch.setenv("SSILK_READ_SECONDS", "0.2")
    assert ending(os.abort) == "reading it ends the process by signal 6 (SIGABRT)"
    assert ending(sum, range(10**12)) == "reading it takes more than 0.2 s"
    assert ending(time.sleep, 60) == "reading it waits more than 0.2 s"
    assert ending(os._exit, 70) == ending(len, 70) == ending(len, "good") == ""
    monkeypatch.setenv("SSILK_READ_SECONDS", "-1")
    with pytest.raises(SsilkError, match="SSILK_READ_SECONDS: '-1'; a number of seconds is needed"):
        ending(len, "good")


def test_arrays_that_declare_a_thousand_million_elements_take_no_memory(files, tmp_path):
    """Found by damaging counts: USD took 4 GB and 12 s for each, and 2 GB where zeros of 1.6 GB are declared."""
    content = (files / "rigged.usdc").read_bytes()
    stage = Usd.Stage.Open(str(files / "rigged.usdc"))
    count = len(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get())
    found, at = [], content.find(struct.pack("<Q", count))
    while at >= 0:
        found.append(at)
        at = content.find(struct.pack("<Q", count), at + 1)
    assert found
    for at, declared in [*((at, 10**9) for at in found), (found[0], 4 * 10**8)]:
        path = tmp_path / f"{at}_{declared}.usdc"
        path.write_bytes(content[:at] + struct.pack("<Q", declared) + content[at + 8 :])
        code = (
            "import sys\n"
            "from ssilk_usd.reading.scene import read_scene\n"
            "from ssilk_core.errors import SsilkError\n"
            "try: read_scene(sys.argv[1])\nexcept SsilkError: pass\n"
            # Not what getrusage tells, which begins with what the process that started this one holds.
            "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60, check=True
        )
        assert int(done.stdout) < 1_000_000  # [kB]


def test_the_bound_on_memory_ends_with_the_reading():
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with pytest.raises(MemoryError), bounded_memory(0.25):
        bytearray(1 << 30)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before and len(bytearray(1 << 20)) == 1 << 20


def test_who_reads_larger_files_can_allow_it(files, tmp_path, monkeypatch):
    stage = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(files / "rigged.usdc")))
    zeros = Vt.IntArray.FromNumpy(np.zeros(60_000_000, np.int32))  # 240 MB in memory, less than one in the file
    UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetFaceVertexIndicesAttr().Set(zeros)
    stage.GetRootLayer().Export(str(tmp_path / "large.usdc"))
    monkeypatch.setenv("SSILK_READ_GIB", "0.05")
    with pytest.raises(SsilkError, match=r"with arrays of at most 0.05 GiB \(SSILK_READ_GIB\)"):
        read_scene(tmp_path / "large.usdc")
    monkeypatch.delenv("SSILK_READ_GIB")
    with pytest.raises(SsilkError, match="60000000"):  # it is read, and makes no sense
        read_scene(tmp_path / "large.usdc")
    monkeypatch.setenv("SSILK_READ_GIB", "much")
    with pytest.raises(SsilkError, match="SSILK_READ_GIB: 'much'; a number of GiB is needed"):
        read_scene(files / "rigged.usdc")


@pytest.mark.parametrize("name", ["a pipe", "a device", "a folder"])
def test_what_is_no_file_is_not_opened(tmp_path, name):
    path = tmp_path / "stage.usda"
    if name == "a pipe":
        os.mkfifo(path)
    elif name == "a device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    assert outcome(lambda: read_scene(path)) == REFUSED
    assert outcome(lambda: load_model(path)) == REFUSED
