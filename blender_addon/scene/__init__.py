# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's data: objects come in, arrays and stages go out, and little is changed.

Open `gather.py` first: a garment with its character, at rest. `handover.py` writes both for `ssilk rig`, `inspect`
and `train`, and reads the answer. All others are about one kind of data: `garment`, `armature`, `meshes`, `weights`,
`classes`, `modifiers`, `masks`, `objects`, `stitched`, `linked`, `other_bodies`; `overlay` draws the classes, and
`beside` shows copies.
"""
