# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxy rigs: a rig of `ssilk rig` comes in, bones, vertex groups and classes go out.

Open `apply.py` first. `proxies` makes the bones, and `edit_tracking` finds what an artist changed since, so that a
new rig keeps it. `adopt` recognises the rig of a garment that was imported from a stage.
"""
