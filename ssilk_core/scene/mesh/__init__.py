# SPDX-License-Identifier: Apache-2.0
"""Topology, distances along the surface, stitches; each module stands alone."""
