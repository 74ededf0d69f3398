# SPDX-License-Identifier: GPL-3.0-or-later
"""Motions: actions, tracks and files come in, sampled takes go out; keys go back.

Open `sources.py` first: which motions an armature has. `sampling` samples them, `simulated` the vertices of a garment
that Blender simulates. `keys` writes all keys of bakes. `demo` makes actions of the demo's motions.
"""
