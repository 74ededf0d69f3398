# SPDX-License-Identifier: GPL-3.0-or-later
"""Translations of the interface, one module for each language; messages about objects stay English."""

from __future__ import annotations

import bpy

from ..preferences import ROOT
from . import german

# A button of an operator is looked up in a context of its own, all else in the default one.
CONTEXTS = ("*", "Operator")
LANGUAGES = {"de_DE": german.WORDS, "de": german.WORDS}  # Blender has named German both ways


def register() -> None:
    """Let Blender use the translations."""
    messages = {
        language: {(context, english): own for english, own in words.items() for context in CONTEXTS}
        for language, words in LANGUAGES.items()
    }
    bpy.app.translations.register(ROOT, messages)


def unregister() -> None:
    """Remove the translations."""
    bpy.app.translations.unregister(ROOT)
