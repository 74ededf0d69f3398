# SPDX-License-Identifier: Apache-2.0
"""Baselines: pose-driven garment networks of other papers, trained on the same energies and motions.

`ncs` is Neural Cloth Simulation (Bertiche et al. 2022), `snug` is SNUG (Santesteban et al. 2022).
"""
