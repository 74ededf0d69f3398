# SPDX-License-Identifier: GPL-3.0-or-later
"""The hand-over: a USD stage with a dressed character; numpy, and Blender's own `pxr` in `write` and `read`."""
