# SPDX-License-Identifier: Apache-2.0
"""Read scenes from USD stages and write them; the only package that knows USD (`pxr`).

Packages, each importing from those before it: `opening` opens files that may be hostile, `reading` turns stages into
the arrays of `ssilk_core.scene.assets`, `writing` writes such stages, `shots` writes bakes and plays them, `checking`
checks a written shot. `stages` holds the demo's body. `units` alone converts units and axes; `names` holds the names
of attributes. These two, `reading.polygons` and `shots.skinned` work without `pxr`.
"""
