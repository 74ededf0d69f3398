# SPDX-License-Identifier: Apache-2.0
"""Cloth that passes through cloth: what it is, how it is found, and how much there is of it.

In: a `Scene`, and posed cloth as numpy arrays (V, 3). Out: `figures.SelfIntersections`, and pairs of triangles.
Open `figures.py` first: it defines the share, without any library. `pairs` finds pairs of triangles with libigl, in
one mesh or between two, and `cloth` counts them in frames of a garment, by joints. `layers` counts what
passes through another garment, and the inner one that shows. `contours` is the energy that
training has of them.
"""
