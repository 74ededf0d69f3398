# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers without Blender: lists and arrays come in, arrays and sentences go out; no module here imports `bpy`.

Open `joints.py` first: bones as joints, in the order of a stage or a model. `classes` holds vertex classes and their
colours, `findings` what `ssilk inspect` found, `edits` what an artist changed of a rig, `heat` what heat maps show,
`curves` the plots of a training, `renamed` bones that were renamed since one, `enough` how many motions it needs,
and `try_on` other bodies of a family.
"""
