# SPDX-License-Identifier: Apache-2.0
"""The posed body, and the distances of garment vertices to it.

Positions have the shape (V, 3, N): vertices, coordinates, frames.
"""
