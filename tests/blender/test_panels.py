# SPDX-License-Identifier: Apache-2.0
"""What panels draw, on a layout that only takes notes: no window is needed to see a wrong name."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate, add_mesh


class Layout:
    """A layout that notes labels, operators and properties, and refuses those that do not exist."""

    def __init__(self, notes: list[str] | None = None):
        self.notes: list[str] = [] if notes is None else notes

    def row(self, align: bool = False) -> Layout:
        return Layout(self.notes)

    column = row

    def label(self, text: str, icon: str = "NONE", translate: bool = True, icon_value: int = 0) -> None:
        self.notes.append(text)

    def template_icon(self, icon_value: int, scale: float) -> None:
        assert isinstance(icon_value, int)  # zero where there is no window

    def template_list(
        self, kind: str, _: str, data: object, name: str, active: object, index: str, rows: int
    ) -> None:
        import bpy

        assert hasattr(bpy.types, kind) and hasattr(data, name) and hasattr(active, index)
        self.notes.append(name)

    def prop(self, data: object, name: str, text: str = "", icon: str = "NONE", slider: bool = False) -> None:
        assert hasattr(data, name), name
        self.notes.append(name)

    def prop_search(self, data: object, name: str, source: object, items: str) -> None:
        assert hasattr(data, name) and hasattr(source, items), name
        self.notes.append(name)

    def operator(
        self, name: str, text: str = "", icon: str = "NONE", depress: bool = False, emboss: bool = True
    ) -> SimpleNamespace:
        module, _, function = name.partition(".")
        import bpy

        assert function in dir(getattr(bpy.ops, module)), name
        self.notes.append(name)
        return SimpleNamespace()

    def progress(self, factor: float, text: str) -> None:
        self.notes.append(f"{text} {factor:.0%}")


def drawn(kind, context, **fields) -> list[str]:
    layout = Layout()
    kind.draw(SimpleNamespace(layout=layout, **fields), context)
    return layout.notes


def test_without_a_python_the_way_to_one_is_shown(bpy, skirt):
    from blender_addon.panels import GarmentPanel

    notes = drawn(GarmentPanel, bpy.context)
    assert {"armature", "bodies", "ssilk.find_python"} <= set(notes)
    assert "No Python with ssilk is chosen; find one in the extension's preferences" in " ".join(notes)
    assert "ssilk.create_environment" in notes


def test_a_search_that_found_no_python_is_told_once(bpy, skirt, monkeypatch):
    from blender_addon.operators import environment, tasks
    from blender_addon.panels import GarmentPanel

    monkeypatch.setattr(environment.pythons, "find", lambda _: [])
    with pytest.raises(RuntimeError, match="No Python with ssilk was found"):
        bpy.ops.ssilk.find_python()
    told = " ".join(drawn(GarmentPanel, bpy.context))
    tasks.stop()
    assert told.count("No Python with ssilk") == 1 and "create an environment" in told


def test_a_preset_for_gpus_is_not_offered_on_a_processor(bpy, skirt, monkeypatch):
    from blender_addon.operators import training as operators
    from blender_addon.panels import training

    settings = skirt.ssilk.training
    for cpu, preset in ((False, "preview"), (True, "draft")):
        settings.property_unset("preset")
        monkeypatch.setattr(operators, "on_processor", lambda _, cpu=cpu: cpu)
        monkeypatch.setattr(training, "on_processor", lambda _, cpu=cpu: cpu)
        assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
        assert settings.preset == preset and not training.slow_line(bpy.context, skirt)
    settings.preset = "preview"
    assert "'Preview' is for a GPU" in training.slow_line(bpy.context, skirt)
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"} and settings.preset == "preview"
    settings.minutes = 10
    assert not training.slow_line(bpy.context, skirt)


def test_classes_are_counted_and_buttons_follow_the_mode(bpy, skirt):
    from blender_addon.panels import ClassesPanel

    bpy.ops.ssilk.paint_classes()
    notes = drawn(ClassesPanel, bpy.context)
    assert [note for note in notes if note.isdigit()] == ["0", "312", "0"]
    assert notes.count("ssilk.brush_class") == 3
    bpy.ops.object.mode_set(mode="EDIT")
    assert drawn(ClassesPanel, bpy.context).count("ssilk.fill_class") == 3


def test_pieces_that_fall_off_are_told_until_they_are_held(bpy, skirt):
    from blender_addon.panels import ClassesPanel
    from blender_addon.scene.classes import write_classes

    skirt.data.vertices.add(1)
    values = np.array([0] * 24 + [2] * 289, dtype=np.int32)
    write_classes(skirt.data, values)
    assert "1 vertex would fall off" in " ".join(drawn(ClassesPanel, bpy.context))
    values[-1] = 1
    write_classes(skirt.data, values)
    assert "fall off" not in " ".join(drawn(ClassesPanel, bpy.context))


def test_pieces_that_stitches_hold_do_not_fall_off(bpy):
    from blender_addon.panels.classes import adrift_line
    from blender_addon.scene.classes import write_classes

    square, sides = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2, 3]])
    places = [(1, (0, 0, 0)), (0.05, (0, 0, 0.004)), (0.03, (0, 0, 0.008)), (0.05, (1.053, 0, 0)), (0.05, (0, 0, 2))]
    points = np.concatenate([size * square + place for size, place in places])
    sheet = add_mesh(bpy, "Sheet", points, np.concatenate([sides + 4 * piece for piece in range(5)]))

    def falling(held: int) -> str:
        write_classes(sheet.data, np.where(np.arange(20) == 4 * held, 1, 2).astype(np.int32))
        return adrift_line(sheet).partition(" ")[0]

    # The second piece lies on the first and under the third. The fourth is beside the first, the fifth is far away.
    assert [falling(held) for held in range(5)] == ["8", "8", "8", "16", "16"]
    sheet.scale = (10, 10, 10)
    bpy.context.view_layer.update()
    assert falling(0) == "16"
    sheet.scale = (1, 1, 1)
    bpy.context.view_layer.update()
    for vertex in sheet.data.vertices[16:]:
        vertex.co.z = 0.006
    assert falling(0) == "4"


def test_sides_that_face_each_other_hold_nothing_unless_a_piece_lies_wholly_on_the_other(bpy):
    from blender_addon.panels.classes import adrift_line
    from blender_addon.scene.classes import write_classes

    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])

    def falling(size: float, shift: float, sides: list[int], held: int = 0) -> bool:
        points = np.concatenate([square, size * square + [shift, 0, 0.004]])
        name = f"Legs{size}{shift}{sides}{held}"
        legs = add_mesh(bpy, name, points, np.array([[0, 1, 2, 3], sides]))
        write_classes(legs.data, np.where(np.arange(8) == held, 1, 2).astype(np.int32))
        return "fall off" in adrift_line(legs)

    along, opposed = [4, 5, 6, 7], [7, 6, 5, 4]
    assert [falling(1, 1.5, sides) for sides in (along, opposed)] == [False, True]
    assert [falling(0.1, 0.0, sides, held) for sides in (along, opposed) for held in (0, 4)] == [False] * 4


def test_broken_classes_are_told_and_drawn_around(bpy, skirt):
    from blender_addon.panels import ClassesPanel

    skirt.data.attributes.new("ssilk:class", "FLOAT", "POINT")
    notes = drawn(ClassesPanel, bpy.context)
    assert any("is FLOAT on POINT" in note for note in notes)
    assert "ssilk.paint_classes" in notes


def test_the_rig_is_told_or_why_there_is_none(bpy, skirt):
    from blender_addon.panels import RigPanel
    from blender_addon.scene.classes import write_classes

    assert drawn(RigPanel, bpy.context)[0] == "No proxies yet on 'Rig'"
    write_classes(skirt.data, np.ones(len(skirt.data.vertices), dtype=np.int32))
    assert drawn(RigPanel, bpy.context)[0] == "Nothing is loose: no proxies"
    bpy.data.objects.remove(bpy.data.objects["Rig"])
    assert drawn(RigPanel, bpy.context)[0].startswith("There is no armature for 'Skirt'")


def test_panels_show_only_what_can_be_a_garment(bpy, skirt):
    from blender_addon.panels import ClassesPanel, GarmentPanel, RigPanel

    assert ClassesPanel.poll(bpy.context)
    activate(bpy, bpy.data.objects["Rig"])
    assert not ClassesPanel.poll(bpy.context)
    assert not RigPanel.poll(bpy.context)
    assert drawn(GarmentPanel, bpy.context)[0] == "Select the garment, a mesh, first"


def test_work_shows_its_progress_and_a_way_out(bpy, skirt, monkeypatch):
    from blender_addon.operators import tasks
    from blender_addon.panels import GarmentPanel

    current = SimpleNamespace(
        title="Rigging 'Skirt'", share="25%", cancelled=False, fraction=0.25, text="half way", close=int
    )
    monkeypatch.setattr(tasks, "current", current)
    assert drawn(GarmentPanel, bpy.context)[-4:] == ["Rigging 'Skirt'", "25% 25%", "ssilk.cancel", "half way"]


def test_preferences_show_the_python(bpy):
    from blender_addon.preferences import Preferences

    notes = drawn(Preferences, bpy.context, python="", source="", handshake="", stop_trainings=False)
    assert notes == [
        "python", "ssilk.find_python", "ssilk.check_python", "No Python with ssilk is chosen", "source",
        "ssilk.create_environment", "stop_trainings",
    ]  # fmt: skip


def test_garments_of_a_character_are_gone_through(bpy, skirt):
    from blender_addon.panels.garment import GarmentPanel

    skirt.modifiers.new("Armature", "ARMATURE").object = bpy.data.objects["Rig"]
    skirt.data.attributes.new("ssilk:class", "INT", "POINT")
    assert "ssilk.choose_garment" not in drawn(GarmentPanel, bpy.context)
    apron = skirt.copy()
    apron.name = "Apron"
    bpy.context.collection.objects.link(apron)
    assert drawn(GarmentPanel, bpy.context).count("ssilk.choose_garment") == 2
    assert bpy.ops.ssilk.choose_garment(garment="Apron") == {"FINISHED"}
    assert (bpy.context.object, bpy.context.selected_objects) == (apron, [apron])
    apron.hide_set(True)
    bpy.ops.ssilk.choose_garment(garment="Skirt")
    for name, reason in (("Apron", "'Apron' is hidden"), ("Hat", "'Hat' is not in this view layer")):
        with pytest.raises(RuntimeError, match=reason):
            bpy.ops.ssilk.choose_garment(garment=name)
