# SPDX-License-Identifier: Apache-2.0
"""Cloth and body: energies, contact, the reference simulator, the skin that shows. No network is known here.

In: a `Scene`, and vertices and skinning matrices as tensors of shape (V, 3, N). Out: energies [J], contact planes,
simulated frames, figures of skin and of cloth through cloth.
Open `energy/garment.py` first: it has each term of the energy.
Public: `physics.energy`, `physics.collision`, `physics.simulate`, `physics.refine`.
"""
