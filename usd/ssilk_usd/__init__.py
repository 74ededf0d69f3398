# SPDX-License-Identifier: Apache-2.0
"""Read scenes from USD stages and write them; the only package that knows USD (`pxr`).

`read_character`, `read_garment`, `read_motion` and `read_scene` turn stages into the arrays of
`ssilk_core.scene.assets`, and `write` writes such stages. `rig_io` reads and writes proxy rigs, `shot` writes bakes
and `read_shot` reads them. `units` alone converts units and axes, `names` holds the names of attributes; these two,
`read_polygons` and `skinned` work without `pxr`.
"""
