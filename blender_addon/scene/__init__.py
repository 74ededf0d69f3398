# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's data: reading a dressed character from a scene, and putting classes and rigs into it."""
