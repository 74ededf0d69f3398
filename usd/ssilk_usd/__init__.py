# SPDX-License-Identifier: Apache-2.0
"""Reads worlds from USD stages and writes them back; the only package that knows USD (`pxr`).

`read_character`, `read_garment`, `read_motion` and `read_scene` turn stages into the arrays of
`ssilk_core.assets`; `rig_io` reads and writes proxy rigs; `units` alone converts units and axes.
"""
