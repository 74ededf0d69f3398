# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's data: reading a garment with its character, and applying classes, rigs and bakes."""
