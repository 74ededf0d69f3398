# SPDX-License-Identifier: Apache-2.0
"""Every panel, list and button in every mode and state: Blender draws again and again whatever raises."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .test_panels import Layout

MODES = ("OBJECT", "EDIT", "SCULPT", "VERTEX_PAINT", "WEIGHT_PAINT", "TEXTURE_PAINT")
VALIDATION = {"total": 0.5, "collisions": 0.01, "dynamics": 0.02}
CURVE = {"lbs": {"total": 1.0}, "points": [{"iteration": 9, "validation": VALIDATION}]}
TERMS = [[1, {"stretch": 1.0, "bending": None}], [2, {"stretch": 0.5, "bending": None}]]


def classes(garment: Any, values: int | np.ndarray = 2) -> None:
    from blender_addon.scene.classes import write_classes

    write_classes(garment.data, np.broadcast_to(values, len(garment.data.vertices)))


def painted(garment: Any) -> None:
    from blender_addon.scene.classes import show_classes

    show_classes(garment.data)


def odd_attribute(kind: str, domain: str) -> Callable[[Any], None]:
    return lambda garment: garment.data.attributes.new("ssilk:class", kind, domain)


def out_of_range(garment: Any) -> None:
    classes(garment)
    garment.data.attributes["ssilk:class"].data[3].value = 7


def corner_colors(garment: Any) -> None:
    garment.data.color_attributes.new("SSILK Classes", "FLOAT_COLOR", "CORNER")


def proxies(garment: Any) -> None:
    from blender_addon.scene.armature import editing, made_collection

    classes(garment)
    rig = garment.ssilk.armature
    with editing(rig):
        bone = rig.data.edit_bones.new("proxy")
        bone.head, bone.tail, bone.parent = (0, 0, 0.8), (0, 0, 0.7), rig.data.edit_bones["Hips"]
        made_collection(rig.data, garment).assign(bone)


def no_armature(garment: Any) -> None:
    classes(garment)
    garment.ssilk.armature = None


def mirrored(garment: Any) -> None:
    proxies(garment)
    garment.ssilk.armature.scale.x = -1.0


def strange_bodies(bpy: Any) -> Callable[[Any], None]:
    def choose(garment: Any) -> None:
        chosen = bpy.data.collections.new("Bodies")
        chosen.objects.link(bpy.data.objects.new("Unbound", garment.data.copy()))
        garment.ssilk.bodies = chosen

    return choose


def training(folder: Path, validations: object = None, **state: Any) -> Callable[[Any], None]:
    """Return what gives a garment a training in a state, which has no armature any more."""

    def begin(garment: Any) -> None:
        folder.mkdir(exist_ok=True)
        if state:
            (folder / "state.json").write_text(json.dumps({"beat": time.time(), **state}))
        if validations:
            (folder / "model.curve.json").write_text(json.dumps(validations))
        garment.ssilk.training.folder, garment.ssilk.armature = str(folder), None

    return begin


def motions(garment: Any) -> None:
    for kind, name in (("TIMELINE", "Timeline"), ("ACTION", "gone"), ("STRIP", "gone"), ("FILE", "//gone.usd")):
        item = garment.ssilk.training.motions.add()
        item.kind, item.name = kind, name


def found(garment: Any) -> None:
    """Give a preflight whose garment has other vertices now, and one whose object is gone."""
    import bpy

    preflight = bpy.context.window_manager.ssilk_preflight
    preflight.garment = "Gone"
    for code, target in (("penetration", "Gone"), ("scale", ""), ("inside-out", garment.name)):
        item = preflight.findings.add()
        item.code, item.target, item.severity, item.elements, item["indices"] = code, target, code, "joints", (9999,)


def shown_heat(garment: Any) -> None:
    garment.ssilk.heat = "penetration"
    garment.data.attributes.new("ssilk:displacement", "FLOAT_VECTOR", "POINT")


def other_bodies(garment: Any) -> None:
    """Give a garment keys of bodies to try it on, which none has, a stage that is gone, and half of what shows it."""
    import bpy

    for name in ("", "Gone"):
        garment.ssilk.try_on.keys.add().key = name
    garment.ssilk.try_on.stage = "//gone.usd"
    shown = bpy.data.objects.new("on", None)
    shown["ssilk_tried_on"], shown.instance_type = garment, "COLLECTION"
    garment.ssilk.try_on.share = 0.3


def live(monkeypatch: Any, **fields: Any) -> Callable[[Any], None]:
    def play(garment: Any) -> None:
        from blender_addon.playback import playing

        played = SimpleNamespace(close=lambda: None, **fields)
        monkeypatch.setitem(playing._played, garment.session_uid, played)

    return play


def states(bpy: Any, monkeypatch: Any, folder: Path) -> Iterator[tuple[str, Callable[[Any], None]]]:
    """Yield what a garment may be like, and what makes it so."""
    yield "nothing", lambda garment: None
    yield "classes", classes
    yield "all tight", lambda garment: classes(garment, 1)
    yield "painted", painted
    yield "corner colors", corner_colors
    yield "out of range", out_of_range
    for kind, domain in (("FLOAT", "POINT"), ("INT8", "POINT"), ("INT", "FACE"), ("STRING", "POINT")):
        yield f"{kind} on {domain}", odd_attribute(kind, domain)
    yield "proxies", proxies
    yield "no armature", no_armature
    yield "mirrored", mirrored
    yield "strange bodies", strange_bodies(bpy)
    yield "motions", motions
    yield "other bodies", other_bodies
    yield "found", found
    yield "heat", shown_heat
    yield "reads", live(monkeypatch, done=0.5, stale=False, renewed=False, model_only=True, fabric_only=False)
    yield (
        "changes its fabric",
        live(monkeypatch, done=0.5, stale=False, renewed=False, model_only=False, fabric_only=True),
    )
    for name, fields in (
        ("stale", {"stale": True}),
        ("behind", {"behind": True}),
        ("unkeyed", {"unkeyed": "A strip of 'Rig' is being tweaked; leave tweak mode (Tab) first."}),
        ("not solved", {"wrong": "its process ended with code -9."}),
        ("starts to solve", {"solving": SimpleNamespace(started=False)}),
        ("solves", {"solving": SimpleNamespace(started=True, total=9, waits=True), "solved": 0}),
        ("solved in part", {"solving": SimpleNamespace(started=True, total=9, waits=True), "solved": 4}),
        ("solved", {"solving": SimpleNamespace(started=True, total=9, waits=False, lost={3}, failed=2), "solved": 9}),
    ):
        still = {
            "done": None, "stale": False, "behind": False, "unkeyed": "", "renewed": False, "wrong": "", "told": "",
            "solving": None, "first": 1,
        }  # fmt: skip
        yield name, live(monkeypatch, **(still | fields))
    yield "another drive", lambda garment: setattr(garment.ssilk, "model", __file__)
    yield "no folder", training(folder / "none")
    for state in ("waiting", "running", "done", "stopped", "failed", "unknown"):
        yield state, training(folder / state, state=state, total=9, done=2, curve=TERMS)
    yield "begins", training(folder / "begins", state="running")
    yield "lost", training(folder / "lost", state="running", beat=0.0)
    yield "all", training(folder / "validated", CURVE, state="running", total=9, done=9, curve=TERMS, checkpoint=9)
    still = {"lbs": {"total": 0.0}, "points": CURVE["points"]}
    yield "no energy", training(folder / "still", still, state="running", total=9)
    broken = {"lbs": {"total": None}, "points": [{"validation": {**VALIDATION, "total": None}}]}
    yield "not finite", training(folder / "broken", broken, state="running", total=9)


def draw_everything(context: Any) -> list[str]:
    """Draw each panel and ask each button whether it can be pressed; return what was raised."""
    from blender_addon.operators.reporting import RefusingOperator
    from blender_addon.operators.training import watch
    from blender_addon.panels import CLASSES, FindingList, MotionList
    from blender_addon.registration import CLASSES as EVERY

    raised = []

    def attempt(what: str, call: Callable[..., object], *arguments: object) -> object:
        try:
            return call(*arguments)
        except Exception as error:
            raised.append(f"{what}: {type(error).__name__}: {error}")
            return None

    for panel in (kind for kind in CLASSES if kind not in (FindingList, MotionList)):
        if attempt(f"{panel.__name__}.poll", getattr(panel, "poll", lambda _: True), context):
            attempt(panel.__name__, panel.draw, SimpleNamespace(layout=Layout()), context)
    for item in context.window_manager.ssilk_preflight.findings:
        attempt("finding", FindingList.draw_item, None, context, Layout(), None, item, None, None, None)
    settings = context.object.ssilk.training if context.object else None
    for number, item in enumerate(settings.motions if settings else ()):
        attempt("motion", MotionList.draw_item, None, context, Layout(), None, item, None, None, None, number)
    if settings:
        flags = SimpleNamespace(bitflag_filter_item=1)
        attempt("filter", MotionList.filter_items, flags, context, settings, "motions")
    for kind in EVERY:
        if issubclass(kind, RefusingOperator):
            attempt(kind.__name__, kind.refusal, context)
    attempt("watch", watch)
    return raised


@pytest.fixture
def copies(bpy, skirt) -> Iterator[Callable[[], Any]]:
    """What gives another skirt with an armature of its own, active, in place of the one before."""
    rig, made = bpy.data.objects["Rig"], []

    def copy() -> Any:
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        garment, armature = skirt.copy(), rig.copy()
        garment.data, armature.data = skirt.data.copy(), rig.data.copy()
        garment.ssilk.armature = armature
        for thing in (garment, armature):
            bpy.context.collection.objects.link(thing)
            made.append(thing)
        bpy.context.window_manager.ssilk_preflight.findings.clear()
        activate(bpy, garment)
        return garment

    return copy


@pytest.mark.parametrize("mode", MODES)
def test_nothing_raises_in_any_state(bpy, copies, monkeypatch, tmp_path, mode):
    raised = []
    for name, make in states(bpy, monkeypatch, tmp_path):
        garment = copies()
        make(garment)
        if mode != "OBJECT":
            bpy.ops.object.mode_set(mode=mode)
        raised += [f"{name}: {sentence}" for sentence in draw_everything(bpy.context)]
        assert bpy.context.object == garment and garment.mode == mode
    assert not raised, "\n".join(raised)


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT", "POSE"])
def test_nothing_raises_on_an_armature(bpy, copies, mode):
    proxies(copies())
    activate(bpy, bpy.context.object.ssilk.armature)
    bpy.ops.object.mode_set(mode=mode)
    assert not draw_everything(bpy.context)


def test_nothing_raises_without_a_garment(bpy, skirt):
    kinds = {"Lamp": bpy.data.lights.new("Lamp", "SUN"), "Line": bpy.data.curves.new("Line", "CURVE")}
    kinds |= {"Nothing": None, "Bare": bpy.data.meshes.new("Bare")}
    for name, content in kinds.items():
        thing = bpy.data.objects.new(name, content)
        bpy.context.collection.objects.link(thing)
        activate(bpy, thing)
        assert not draw_everything(bpy.context), name
    bpy.context.view_layer.objects.active = None
    assert not draw_everything(bpy.context)
