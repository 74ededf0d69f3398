# SPDX-License-Identifier: Apache-2.0
"""Frames of a garment moved as little as it takes until no triangle intersects another and no covered skin shows.

In: posed cloth and bodies as numpy arrays (V, 3), from anywhere. Out: displacements, and what could not be freed.
Open `certifier.py` first: it goes over the frames. `faults` says what is wrong in one, `untangle` takes cloth out of
cloth and lifts it off skin, `settle` brings it back as near as contact lets it, by continuous tests of ipctk, and
`metric` says what a displacement costs.
"""
