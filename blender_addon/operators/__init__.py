# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators, one module for each of the things an artist does."""
