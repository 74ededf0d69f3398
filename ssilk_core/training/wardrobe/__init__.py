# SPDX-License-Identifier: Apache-2.0
"""Trainings of a list of garments, side by side; open `training.py` first."""
