# SPDX-License-Identifier: Apache-2.0
"""Every string that the interface shows has a translation, and every translation is of a string in use."""

from __future__ import annotations

import ast
from types import SimpleNamespace

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import ROOT

UNSEEN = {"directory", "files", "index", "filter_glob"}  # set by the file browser and by buttons
NAMES = {"", "Baraff-Witkin", "St. Venant-Kirchhoff", "Python", "SSILK"}  # the same in every language


def of_properties(rna, own) -> set[str]:
    """What people read of the properties that a class declares."""
    found: set[str] = set()
    for prop in rna.properties:
        if prop.identifier in own - UNSEEN and not prop.is_hidden:
            found |= {prop.name, prop.description}
            if prop.type == "ENUM":
                found |= {text for item in prop.enum_items_static for text in (item.name, item.description)}
    return found


def declared(kind) -> set[str]:
    return {name for base in kind.__mro__ for name in getattr(base, "__annotations__", {})}


def registered_strings(bpy) -> set[str]:
    from blender_addon.registration import CLASSES
    from blender_addon.settings import preflight

    found: set[str] = set()
    for kind in CLASSES:
        if kind in preflight.CLASSES:
            continue  # never drawn as properties
        found.add(getattr(kind, "bl_label", ""))
        rna = kind.bl_rna
        if issubclass(kind, bpy.types.Operator):
            module, _, name = kind.bl_idname.partition(".")
            rna = getattr(getattr(bpy.ops, module), name).get_rna_type()
            found.add(rna.description)
        found |= of_properties(rna, declared(kind))
    return found | of_properties(bpy.types.PoseBone.bl_rna, {"ssilk_free", "ssilk_posed"})


def drawn_strings() -> set[str]:
    """The constant texts of what panels and preferences draw."""
    files = [*(ROOT / "blender_addon" / "panels").glob("*.py"), ROOT / "blender_addon" / "preferences.py"]
    trees = [ast.parse(path.read_text()) for path in files]
    given = [
        node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "text"
    ]
    return {node.value.value for node in given if isinstance(node.value, ast.Constant)}


def test_every_string_has_a_translation_and_none_is_left_over(bpy):
    from blender_addon.translations import LANGUAGES

    used = (registered_strings(bpy) | drawn_strings()) - NAMES
    assert len(used) > 100
    for language, words in LANGUAGES.items():
        assert sorted(used - set(words)) == [], language
        assert sorted(set(words) - used) == [], language
        assert not [english for english, own in words.items() if not own.strip()]
        # Blender ends tooltips with a full stop itself.
        assert not [own for own in words.values() if own.endswith(".")]


def test_blender_finds_them(bpy):
    from blender_addon.translations import german

    words = dict(german.WORDS)
    view = bpy.context.preferences.view
    known = [name for name in ("de_DE", "de") if name in bpy.app.translations.locales]
    if not known:
        pytest.skip("this Blender was built without languages")
    before = view.language
    view.language, view.use_translate_interface = known[0], True
    try:
        assert bpy.app.translations.pgettext_iface("Proxy Rig") == words["Proxy Rig"]
        assert bpy.app.translations.pgettext_iface("Generate Proxy Rig", "Operator") == words["Generate Proxy Rig"]
    finally:
        view.language = before


def test_blender_hears_of_every_language_and_that_it_goes(bpy, monkeypatch):
    from blender_addon import registration, translations

    heard: list[tuple[str, ...]] = []
    words = SimpleNamespace(
        register=lambda name, messages: heard.append((name, *messages)), unregister=lambda name: heard.append((name,))
    )
    monkeypatch.setattr(translations, "bpy", SimpleNamespace(app=SimpleNamespace(translations=words)))
    registration.unregister()
    registration.register()
    assert heard == [("blender_addon",), ("blender_addon", "de_DE", "de")]
